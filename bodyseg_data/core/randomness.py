"""Random numbers: the only module that draws any.

A draw belongs to (seed, epoch, sample key, purpose) and to nothing else: not to a position in the stream, a worker, a
rank or a shard. So a sample gets the same bits however it is read, and an artifact draws the same in every variant.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadConfig, check_int

_LARGEST: Final = 2**63
_BLOCK_WORDS: Final = 1 << 18

Stream = NDArray[np.uint64]
"""A purpose's stream of random words: the key of a Philox generator, uint64 [2]."""


def check_seed(seed: int) -> int:
    """`seed` as an int. Raises BadConfig unless it is a whole number from 0 to 2**63 - 1."""
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or not 0 <= seed < _LARGEST:
        raise BadConfig(f"a seed must be a whole number from 0 to 2**63 - 1, found {seed!r}")
    return int(seed)


def check_epoch(epoch: int) -> int:
    """`epoch` as an int. Raises BadConfig unless it is a whole number of at least 0."""
    return check_int("an epoch", epoch, 0)


def _digest(seed: int, epoch: int, key: str, purpose: str) -> bytes:
    identity = "\0".join((str(seed), str(epoch), key, purpose))
    return hashlib.blake2b(identity.encode(), digest_size=16, person=b"bodyseg").digest()


def stream(seed: int, epoch: int, key: str, purpose: str) -> Stream:
    """The stream of one purpose for one sample in one epoch.

    Philox is counter-based (Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", 2011): any 128-bit key gives
    an independent stream at no set-up cost.
    """
    return np.frombuffer(_digest(seed, epoch, key, purpose), "<u8").astype(np.uint64)


def pixel_draws(stream: Stream, count: int, kind: type[np.uint16] | type[np.uint32]) -> NDArray[Any]:
    """One draw a pixel, uniform over all values of `kind`, [count]: the raw words, cut up from their low end.

    NumPy guarantees the bits of raw words, as it does not those of its distributions.
    """
    each = 8 // np.dtype(kind).itemsize
    words = np.random.Philox(key=stream).random_raw(-(-count // each)).astype("<u8")
    return words.view(np.dtype(kind).newbyteorder("<"))[:count].astype(kind)


def chance(seed: int, epoch: int, key: str, purpose: str) -> float:
    """One number for a purpose that draws once a sample, uniform over the multiples of 2**-53 from 0 to below 1."""
    return (int.from_bytes(_digest(seed, epoch, key, purpose)[:8], "little") >> 11) * 2.0**-53


def generator(seed: int, epoch: int, key: str, purpose: str) -> np.random.Generator:
    """The random generator of one purpose for one sample in one epoch."""
    return np.random.Generator(np.random.Philox(key=stream(seed, epoch, key, purpose)))


def unit(random: np.random.Generator) -> float:
    """The next number of a generator, uniform over the multiples of 2**-53 from 0 to below 1: from its raw words."""
    word: int = random.bit_generator.random_raw()
    return (word >> 11) * 2.0**-53


def units(random: np.random.Generator, count: int) -> NDArray[np.float64]:
    """The next `count` numbers of a generator as `unit` gives them, float64 [count]."""
    words = np.asarray(random.bit_generator.random_raw(count), np.uint64)
    return (words >> np.uint64(11)).astype(np.float64) * 2.0**-53


@dataclass(frozen=True)
class Draws:
    """The random numbers of one sample in one epoch: each purpose has its own, whatever else is drawn."""

    seed: int
    epoch: int
    key: str

    def chance(self, purpose: str) -> float:
        """One number for the sample; see `chance`."""
        return chance(self.seed, self.epoch, self.key, purpose)

    def stream(self, purpose: str) -> Stream:
        """The stream of a purpose; see `stream`."""
        return stream(self.seed, self.epoch, self.key, purpose)

    def pixels(self, purpose: str, count: int, kind: type[np.uint16] | type[np.uint32]) -> NDArray[Any]:
        """One draw a pixel, [count]; see `pixel_draws`."""
        return pixel_draws(self.stream(purpose), count, kind)

    def generator(self, purpose: str) -> np.random.Generator:
        """The random generator of a purpose; see `generator`."""
        return generator(self.seed, self.epoch, self.key, purpose)


def permutation(count: int, seed: int, epoch: int, purpose: str = "order") -> NDArray[np.int64]:
    """An order of `count` things in an epoch, int64 [count]: sorts raw Philox words, whose bits NumPy guarantees."""
    words = np.random.Philox(key=stream(seed, epoch, "", purpose)).random_raw(count)
    return np.argsort(words, kind="stable")


class Permutation:
    """The order of `permutation`, computed part by part as slices of it are read; a slice is int64.

    A part holds the things whose words share their highest bits. All words are drawn again for each, so the whole order
    takes longer than by `permutation`, and memory for one part and a block of words only. part_bits: parts
    hold 2**part_bits things, or half as many, on average.
    """

    def __init__(self, count: int, seed: int, epoch: int, purpose: str = "order", part_bits: int = 21) -> None:
        self._count, self._key = count, stream(seed, epoch, "", purpose)
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
