"""Selection of a set's samples by shard, split, key and description, from the manifest alone."""

from __future__ import annotations

import fnmatch
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.splits import READ_SPLITS, SPLITS, ReadSplit
from bodyseg_data.loading.selection.conditions import Condition, parse_conditions, texts_of
from bodyseg_data.loading.selection.sample_table import SampleTable
from bodyseg_data.loading.selection.validation import check_val_share, mark_val
from bodyseg_data.shards.manifest import Manifest


@dataclass(frozen=True)
class Selection:
    """Choice of samples of a set.

    pattern: of the shards' names. split: "train", "val", "test", or None for train and test. only: patterns as for file
    names; a sample's key must match one of them, if there are any. where: conditions, all of which a sample must meet.
    val_share: share of train that is read as "val" and not as "train" (docs/splits.md).
    """

    pattern: str
    split: ReadSplit | None
    only: tuple[str, ...] = ()
    where: tuple[Condition, ...] = ()
    val_share: float = 0.0

    @classmethod
    def of(cls, pattern: str, split: Any, only: Any, where: Any, val_share: Any) -> Selection:
        """Check the options of a user. only, where: one text or several. Raises BadConfig."""
        if split is not None and split not in READ_SPLITS:
            raise BadConfig(f"the split must be one of {', '.join(READ_SPLITS)} or None, found {split!r}")
        share = check_val_share(val_share)
        if split == "val" and not share:
            raise BadConfig("the split 'val' is a share of train: give val_share, like 0.1")
        return cls(pattern, split, texts_of("only", only), parse_conditions(where), share)

    @property
    def divides_train(self) -> bool:
        """True if the split is a part of the stored train split, val or the rest."""
        return bool(self.val_share) and self.split in ("train", "val")

    def filters(self) -> dict[str, Any]:
        """Return the options that are given, besides the split, as plain JSON."""
        return {
            **({"only": list(self.only)} if self.only else {}),
            **({"where": [condition.text for condition in self.where]} if self.where else {}),
            **({"val_share": self.val_share} if self.divides_train else {}),
        }

    def choose(self, manifest: Manifest, path: str) -> NDArray[np.int64]:
        """Shard number and index within it of the samples, in stored order, int64 [N, 2].

        Raises BadConfig, naming `path`, if there is none, or if train cannot be divided.
        """
        shards = manifest.shards
        sizes = np.array([len(shard) for shard in shards])
        number = np.repeat(np.arange(len(shards)), sizes)
        index = np.arange(len(number)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
        stored = "train" if self.split == "val" else self.split
        fits = [stored in (None, shard.split) and Path(shard.name).match(self.pattern) for shard in shards]
        chosen = np.repeat(np.array(fits, np.bool_), sizes)
        if chosen.any() and (self.where or self.divides_train):
            chosen &= self._described(manifest, sizes)
        if self.only:
            patterns = [re.compile(fnmatch.translate(pattern)).match for pattern in self.only]
            keys = [key for shard in shards for key in shard.keys]
            for sample in np.flatnonzero(chosen).tolist():
                chosen[sample] = any(match(keys[sample]) for match in patterns)
        if not chosen.any():
            held = ", ".join(f"{manifest.samples(name)} {name}" for name in SPLITS)
            wanted = " ".join((self.pattern, *self.only, *(condition.text for condition in self.where)))
            raise BadConfig(
                f"{path} has no sample of split {self.split!r} that matches {wanted!r}; the set holds {held}"
            )
        return np.stack([number[chosen], index[chosen]], axis=1)

    def _described(self, manifest: Manifest, sizes: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Mark the samples whose descriptions fit, bool [N]."""
        table = SampleTable.of(manifest)
        marks = np.ones(len(table.body), np.bool_)
        for condition in self.where:
            marks &= condition.marks(table)
        if self.divides_train:
            train = np.repeat([shard.split == "train" for shard in manifest.shards], sizes)
            marks &= mark_val(table, train, self.val_share) == (self.split == "val")
        return marks
