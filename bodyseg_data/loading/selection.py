"""Selection of a set's samples by shard, split and key, from the manifest alone."""

from __future__ import annotations

import fnmatch
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.splits import SPLITS, Split
from bodyseg_data.shards.manifest import Manifest


@dataclass(frozen=True)
class Selection:
    """Which samples of a set to read.

    pattern: of the shards' names. split: "train", "test", or None for both. only: patterns as for file names; a
    sample's key must match one of them, if there are any. Raises BadConfig for an unknown split.
    """

    pattern: str
    split: Split | None
    only: tuple[str, ...]

    def __post_init__(self) -> None:
        if self.split is not None and self.split not in SPLITS:
            raise BadConfig(f"the split must be one of {', '.join(SPLITS)} or None, found {self.split!r}")

    def choose(self, manifest: Manifest, path: str) -> NDArray[np.int64]:
        """Shard number and index within it of the samples, in stored order, int64 [N, 2].

        Raises BadConfig, naming `path`, if there is none.
        """
        chosen = [
            (number, index)
            for number, shard in enumerate(manifest.shards)
            if self.split in (None, shard.split) and Path(shard.name).match(self.pattern)
            for index in range(len(shard))
        ]
        if self.only:
            fits = [re.compile(fnmatch.translate(pattern)).match for pattern in self.only]
            keys = (manifest.shards[number].keys[index] for number, index in chosen)
            chosen = [sample for sample, key in zip(chosen, keys, strict=True) if any(fit(key) for fit in fits)]
        if not chosen:
            held = ", ".join(f"{manifest.samples(name)} {name}" for name in SPLITS)
            wanted = " ".join((self.pattern, *self.only))
            raise BadConfig(
                f"{path} has no sample of split {self.split!r} that matches {wanted!r}; the set holds {held}"
            )
        return np.asarray(chosen, np.int64)
