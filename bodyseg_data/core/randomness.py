"""Random numbers: all that is drawn, but who is in rooms, starts from a stream of this module.

A draw belongs to (seed, epoch, sample key, purpose) and to nothing else: not to a position in the stream, a worker, a
rank or a shard. So a sample gets the same bits however it is read, and an artifact draws the same in every variant.
"""

import hashlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadConfig, check_int

Stream = NDArray[np.uint64]
"""A purpose's stream of random words: the key of a Philox generator, uint64 [2]."""


def check_seed(seed: int) -> int:
    """`seed` as an int. Raises BadConfig unless it is a whole number from 0 to 2**63 - 1."""
    return check_int("a seed", seed, 0, 2**63 - 1)


def check_epoch(epoch: int) -> int:
    """`epoch` as an int. Raises BadConfig unless it is a whole number of at least 0."""
    return check_int("an epoch", epoch, 0)


def _fraction(word: int) -> float:
    """A word of 64 random bits as a multiple of 2**-53, uniform from 0 to below 1."""
    return (word >> 11) * 2.0**-53


def uniform(random: np.random.Generator) -> float:
    """The next number of a generator, uniform over the multiples of 2**-53 from 0 to below 1: from its raw words."""
    return _fraction(random.bit_generator.random_raw())


@dataclass(frozen=True)
class Draws:
    """The random numbers of one sample in one epoch. Each purpose has its own, whatever else is drawn.

    purposes: the only ones that may be drawn for; None for any. Raises BadConfig where another is drawn for.
    """

    seed: int
    epoch: int
    key: str
    purposes: tuple[str, ...] | None = None

    def _digest(self, purpose: str) -> bytes:
        if self.purposes is not None and purpose not in self.purposes:
            listed = ", ".join(map(repr, self.purposes)) or "none"
            raise BadConfig(f"random numbers are drawn for the purposes that an artifact lists, {listed}: {purpose!r}")
        identity = "\0".join((str(self.seed), str(self.epoch), self.key, purpose))
        return hashlib.blake2b(identity.encode(), digest_size=16, person=b"bodyseg").digest()

    def chance(self, purpose: str) -> float:
        """Return one number for a purpose that draws once a sample: a multiple of 2**-53, uniform from 0 to below 1."""
        return _fraction(int.from_bytes(self._digest(purpose)[:8], "little"))

    def stream(self, purpose: str) -> Stream:
        """Return the stream of random numbers of a purpose.

        Philox is counter-based (Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", 2011): any 128-bit key
        gives an independent stream at no set-up cost.
        """
        return np.frombuffer(self._digest(purpose), "<u8").astype(np.uint64)

    def pixels(self, purpose: str, count: int, kind: type[np.uint16] | type[np.uint32]) -> NDArray[Any]:
        """Draw one number a pixel, [count], uniform over all values of `kind`: raw words, cut up from their low end.

        NumPy guarantees the bits of raw words, but not those of its distributions.
        """
        each = 8 // np.dtype(kind).itemsize
        words = np.random.Philox(key=self.stream(purpose)).random_raw(-(-count // each)).astype("<u8")
        return words.view(np.dtype(kind).newbyteorder("<"))[:count].astype(kind)

    def generator(self, purpose: str) -> np.random.Generator:
        """Return the random generator of a purpose."""
        return np.random.Generator(np.random.Philox(key=self.stream(purpose)))
