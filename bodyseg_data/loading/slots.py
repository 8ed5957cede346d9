"""Shared memory into which workers write whole batches, reused as soon as no reference to a batch is left.

No pixel is copied or sent between processes, and after the first few batches nothing is allocated and no page is
touched for the first time. The memory has no name, so that nothing is left behind; a small /dev/shm does not limit it.
"""

import itertools
import math
import mmap
import os
import tempfile
import weakref
from collections.abc import Iterable
from multiprocessing import reduction
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig
from bodyseg_data.shards import Stage

SPARE: Final = 3
"""Batches that a user may hold at once without a copy: the current one, the one before it, and one more."""


class Slots:
    """`in_flight` + SPARE slots of one batch each.

    A slot is free, acquired (a worker writes it), or lent (the user holds its tensors or views of them). With at most
    `in_flight` acquired at once, `acquire` always finds a free one: at most SPARE are lent, further batches copied.
    """

    def __init__(
        self, in_flight: int, batch_size: int, rows: int, columns: int, metres: bool, planes: Iterable[np.dtype[Any]]
    ) -> None:
        self._shape = (batch_size, rows, columns)
        self._dtypes = [np.dtype(np.float32 if metres else np.uint16), np.dtype(np.uint8), *planes]
        pages = [-(-batch_size * rows * columns * dtype.itemsize // mmap.PAGESIZE) for dtype in self._dtypes]
        self._offsets = [mmap.PAGESIZE * end for end in itertools.accumulate(pages, initial=0)]
        self._stride = self._offsets[-1]
        self._count = in_flight + SPARE
        self._size = self._count * (self._stride + 8 * len(Stage))
        self._free = list(range(self._count))
        self._lent: dict[int, tuple[weakref.ref[Any], ...]] = {}
        try:
            self._map(_anonymous_file(self._size))
        except OSError as error:
            gigabytes = self._size / 1e9
            raise BadConfig(
                f"{self._count} batches of {batch_size} samples take {gigabytes:.1f} GB, which cannot be allocated: "
                f"{error.strerror or error}; use a smaller batch_size, or fewer workers"
            ) from error

    def _map(self, file: int) -> None:
        self._file = file
        weakref.finalize(self, os.close, file)
        self._memory = mmap.mmap(file, self._size)

    def __getstate__(self) -> dict[str, Any]:
        """State for a process being started: the memory is passed on as an open file."""
        return {**self.__dict__, "_memory": None, "_lent": {}, "_file": reduction.DupFd(self._file)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._map(state["_file"].detach())

    def arrays(self, slot: int) -> list[NDArray[Any]]:
        """Return a slot's memory: range float32 or uint16 [B, 1, H, W], labels uint8 [B, H, W], planes [B, H, W]."""
        pixels, start = math.prod(self._shape), slot * self._stride
        ranges, *others = (
            np.frombuffer(self._memory, dtype, pixels, start + offset).reshape(self._shape)
            for dtype, offset in zip(self._dtypes, self._offsets, strict=False)
        )
        return [ranges[:, None], *others]

    def tallies(self) -> NDArray[np.float64]:
        """Tallies over all batches of each slot, float64 [slots, len(Stage)]."""
        count = self._count * len(Stage)
        return np.frombuffer(self._memory, np.float64, count, self._count * self._stride).reshape(self._count, -1)

    def acquire(self) -> int:
        """Return a free slot, which is then acquired."""
        self._reclaim()
        return self._free.pop()

    def release(self, slot: int) -> None:
        """Make an acquired slot free."""
        self._free.append(slot)

    def lend(self, slot: int, count: int, pin: bool = False) -> list[torch.Tensor]:
        """Return the first `count` images of an acquired slot as tensors: range, labels, planes.

        The slot becomes free again when no reference to the tensors is left. pin: copy to page-locked memory, which
        torch manages, since copies to a GPU may outlast their tensors.
        """
        self._reclaim()
        arrays = [array[:count] for array in self.arrays(slot)]
        tensors = [torch.from_numpy(array) for array in arrays]
        if not pin and len(self._lent) < SPARE:
            # Every tensor, array or view that shares the storage keeps exactly these objects alive.
            self._lent[slot] = tuple(weakref.ref(array) for array in arrays)
            return tensors
        copies = [tensor.pin_memory() if pin else tensor.clone() for tensor in tensors]
        self._free.append(slot)
        return copies

    def _reclaim(self) -> None:
        for slot in [slot for slot, held in self._lent.items() if all(each() is None for each in held)]:
            del self._lent[slot]
            self._free.append(slot)


def _anonymous_file(size: int) -> int:
    if hasattr(os, "memfd_create"):
        file = os.memfd_create("bodyseg-batches")
    else:
        with tempfile.TemporaryFile() as temporary:
            file = os.dup(temporary.fileno())
    os.ftruncate(file, size)
    return file
