"""Orders of samples: at once, or part by part as they are read, in memory for one part."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import Draws

_BLOCK_WORDS: Final = 1 << 18


def permutation(count: int, seed: int, epoch: int, purpose: str = "order") -> NDArray[np.int64]:
    """An order of `count` things in an epoch, int64 [count]: sorts raw Philox words, whose bits NumPy guarantees."""
    words = np.random.Philox(key=Draws(seed, epoch, "").stream(purpose)).random_raw(count)
    return np.argsort(words, kind="stable")


class Permutation:
    """The order of `permutation`, computed part by part as slices of it are read; a slice is int64.

    A part holds the things whose words share their highest bits. All words are drawn again for each, so the whole order
    takes longer than by `permutation`, and memory for one part and a block of words only. part_bits: parts
    hold 2**part_bits things, or half as many, on average.
    """

    def __init__(self, count: int, seed: int, epoch: int, purpose: str = "order", part_bits: int = 21) -> None:
        self._count, self._key = count, Draws(seed, epoch, "").stream(purpose)
        self._shared_bits = max(0, (count - 1).bit_length() - part_bits)
        self._held = (-1, np.empty(0, np.int64))

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, positions: slice) -> NDArray[np.int64]:
        first, end, _ = positions.indices(self._count)
        found = [np.empty(0, np.int64)]
        while first < end:
            part = int(np.searchsorted(self._ends, first, side="right"))
            start = int(self._ends[part - 1]) if part else 0
            if self._held[0] != part:
                self._held = (part, self._part(part))
            found.append(self._held[1][first - start : end - start])
            first += len(found[-1])
        return np.concatenate(found)

    @cached_property
    def _ends(self) -> NDArray[np.int64]:
        """Number of things up to the end of each part, int64 [P]."""
        counts = np.zeros(1 << self._shared_bits, np.int64)
        for _, words in self._blocks():
            counts += np.bincount(self._part_of(words), minlength=len(counts))
        return np.cumsum(counts)

    def _part(self, part: int) -> NDArray[np.int64]:
        things, own = [], []
        for start, words in self._blocks():
            inside = np.flatnonzero(self._part_of(words) == part)
            things.append(inside + start)
            own.append(words[inside])
        order: NDArray[np.int64] = np.concatenate(things)[np.argsort(np.concatenate(own), kind="stable")]
        return order

    def _part_of(self, words: NDArray[np.uint64]) -> NDArray[np.int64]:
        shift = np.uint64(64 - self._shared_bits)
        return (words >> shift).astype(np.int64) if self._shared_bits else np.zeros(len(words), np.int64)

    def _blocks(self) -> Iterator[tuple[int, NDArray[np.uint64]]]:
        """Yield all words, block by block, each with the number of its first thing."""
        words = np.random.Philox(key=self._key)
        for start in range(0, self._count, _BLOCK_WORDS):
            yield start, words.random_raw(min(_BLOCK_WORDS, self._count - start))
