"""The samples of a set that a selection holds, in memory that grows with them only where single ones were chosen."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class ChosenSamples:
    """Samples of a set, in stored order.

    shards: numbers of the shards that hold any. counts: chosen samples of each. within: uint32 [N], indices of the
    chosen samples within their shards, shard by shard; None if all samples of these shards are chosen.
    """

    shards: tuple[int, ...]
    counts: tuple[int, ...]
    within: NDArray[np.uint32] | None = None

    @classmethod
    def marked(cls, numbers: Sequence[int], marks: Sequence[NDArray[np.bool_]]) -> ChosenSamples:
        """Return the samples that are marked. marks: bool [M], of the samples of each of the shards `numbers`."""
        chosen = [np.flatnonzero(each).astype(np.uint32) for each in marks]
        held = [(number, own) for number, own in zip(numbers, chosen, strict=True) if len(own)]
        within = np.concatenate([own for _, own in held]) if held else np.empty(0, np.uint32)
        return cls(tuple(number for number, _ in held), tuple(len(own) for _, own in held), within)

    def __len__(self) -> int:
        return self._ends[-1] if self._ends else 0

    def place(self, index: int) -> tuple[int, int]:
        """Return (shard number, index within the shard) of a sample, `index` of all chosen ones."""
        at = bisect_right(self._ends, index)
        within = index - self._ends[at] + self.counts[at] if self.within is None else int(self.within[index])
        return self.shards[at], within

    def by_shard(self) -> Iterator[tuple[int, list[int]]]:
        """Yield each shard's number and the indices of its chosen samples."""
        for shard, count, end in zip(self.shards, self.counts, self._ends, strict=True):
            yield shard, list(range(count)) if self.within is None else self.within[end - count : end].tolist()

    @cached_property
    def _ends(self) -> list[int]:
        """Number of samples up to the end of each shard."""
        return list(accumulate(self.counts))
