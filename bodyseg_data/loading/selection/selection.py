"""Selection of a set's samples by shard, split, key and description, from the manifest alone."""

from __future__ import annotations

import fnmatch
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.splits import READ_SPLITS, SPLITS, ReadSplit
from bodyseg_data.loading.selection.chosen_samples import ChosenSamples
from bodyseg_data.loading.selection.conditions import Condition, parse_conditions, texts_of
from bodyseg_data.loading.selection.sample_table import SampleTable
from bodyseg_data.loading.selection.validation import check_val_share, mark_val
from bodyseg_data.shards.manifest import Manifest


@dataclass(frozen=True)
class Selection:
    """Choice of samples of a set.

    pattern: of the shards' names. split: "train", "val", "test", or None for train and test. only: patterns as for file
    names; a sample's key must match one of them, if there are any. where: conditions, all of which a sample must meet.
    val_share: share of train that is read as "val" and not as "train" (docs/how-to/splits.md).
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

    def choose(self, manifest: Manifest, path: str) -> ChosenSamples:
        """Choose the samples of a set. The index of one that has it is read only where single samples are chosen.

        Raises BadConfig, naming `path`, if there is none, or if train cannot be divided.
        """
        stored = "train" if self.split == "val" else self.split
        counts = {
            number: len(shard)
            for number, shard in enumerate(manifest.shards)
            if stored in (None, shard.split) and (self.pattern == "*" or Path(shard.name).match(self.pattern))
        }
        chosen = ChosenSamples(tuple(counts), tuple(counts.values()))
        if counts and (self.where or self.only or self.divides_train):
            chosen = self._filtered(manifest, chosen.shards)
        if not len(chosen):
            held = ", ".join(f"{manifest.samples(name)} {name}" for name in SPLITS)
            wanted = " ".join((self.pattern, *self.only, *(condition.text for condition in self.where)))
            raise BadConfig(
                f"{path} has no sample of split {self.split!r} that matches {wanted!r}; the set holds {held}"
            )
        return chosen

    def _filtered(self, manifest: Manifest, numbers: Sequence[int]) -> ChosenSamples:
        """Choose the samples of some shards whose keys and descriptions fit, one shard after the other."""
        parts = self._parts_of_train(manifest) if self.divides_train else {}
        patterns = [re.compile(fnmatch.translate(pattern)).match for pattern in self.only]
        marks = []
        for number in numbers:
            shard = manifest.shards[number]
            own = parts.get(number, np.ones(len(shard), np.bool_))
            if self.where:
                table = SampleTable.of([shard])
                for condition in self.where:
                    own &= condition.marks(table)
            if patterns:
                for sample in np.flatnonzero(own).tolist():
                    own[sample] = any(match(shard.keys[sample]) for match in patterns)
            marks.append(own)
        return ChosenSamples.marked(numbers, marks)

    def _parts_of_train(self, manifest: Manifest) -> dict[int, NDArray[np.bool_]]:
        """Mark the samples of all shards of train that belong to the split: shard number -> bool [M]."""
        train = [number for number, shard in enumerate(manifest.shards) if shard.split == "train"]
        table = SampleTable.of(manifest.shards[number] for number in train)
        val = mark_val(table, np.ones(len(table.body), np.bool_), self.val_share)
        ends = np.cumsum([len(manifest.shards[number]) for number in train])
        return dict(zip(train, np.split(val == (self.split == "val"), ends[:-1]), strict=True))
