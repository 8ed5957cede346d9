"""The only place that draws random numbers.

A draw belongs to (seed, epoch, sample key, purpose) and to nothing else: not to a position in the stream, a worker, a
rank or a shard. So a sample gets the same bits however it is read, and an artifact draws the same in every variant.
"""

from __future__ import annotations

import hashlib
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.errors import BadConfig

_LARGEST: Final = 2**63


def check_seed(seed: int) -> int:
    """`seed` as an int. Raises BadConfig unless it is a whole number from 0 to 2**63 - 1."""
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or not 0 <= seed < _LARGEST:
        raise BadConfig(f"a seed must be a whole number from 0 to 2**63 - 1, found {seed!r}")
    return int(seed)


def check_epoch(epoch: int) -> int:
    """`epoch` as an int. Raises BadConfig unless it is a whole number of at least 0."""
    if isinstance(epoch, bool) or not isinstance(epoch, int | np.integer) or epoch < 0:
        raise BadConfig(f"an epoch must be a whole number of at least 0, found {epoch!r}")
    return int(epoch)


def _bits(seed: int, epoch: int, key: str, purpose: str) -> np.random.Philox:
    """Philox is counter-based (Salmon et al. 2011): any 128-bit key gives an independent stream at no set-up cost."""
    identity = "\0".join((str(seed), str(epoch), key, purpose))
    digest = hashlib.blake2b(identity.encode(), digest_size=16, person=b"bodyseg").digest()
    return np.random.Philox(key=np.frombuffer(digest, "<u8"))


def generator(seed: int, epoch: int, key: str, purpose: str) -> np.random.Generator:
    """The random generator of one purpose for one sample in one epoch."""
    return np.random.Generator(_bits(seed, epoch, key, purpose))


def permutation(count: int, seed: int, epoch: int) -> NDArray[np.int64]:
    """The order of `count` samples in an epoch, int64 [count]: sorts raw Philox words, whose bits NumPy guarantees."""
    return np.argsort(_bits(seed, epoch, "", "order").random_raw(count), kind="stable")
