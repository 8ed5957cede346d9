"""Shared memory into which workers write whole batches, reused as soon as no reference to a batch is left.

No pixel is copied or sent between processes, and after the first few batches nothing is allocated and no page is
touched for the first time. The memory has no name, so that nothing is left behind; a small /dev/shm does not limit it.
"""

from __future__ import annotations

import mmap
import os
import tempfile
import weakref
from multiprocessing import reduction
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadConfig

SPARE: Final = 3
"""Batches that a user may hold at once without a copy: the current one, the one before it, and one more."""


class Slots:
    """`in_flight` + SPARE slots of one batch each.

    A slot is free, acquired (a worker writes it), or lent (the user holds its tensors or views of them). With at most
    `in_flight` slots acquired at once, `acquire` always finds a free one: at most SPARE are lent, and further batches
    are copied instead.
    """

    def __init__(self, in_flight: int, batch_size: int, rows: int, columns: int, metres: bool) -> None:
        self._shape = (batch_size, rows, columns)
        self._dtype = np.dtype(np.float32 if metres else np.uint16)
        pixels = batch_size * rows * columns
        self._labels_offset = _whole_pages(pixels * self._dtype.itemsize)
        self._stride = self._labels_offset + _whole_pages(pixels)
        self._count = in_flight + SPARE
        self._free = list(range(self._count))
        self._lent: dict[int, tuple[weakref.ref[Any], ...]] = {}
        try:
            self._map(_anonymous_file(self._count * self._stride))
        except OSError as error:
            gigabytes = self._count * self._stride / 1e9
            raise BadConfig(
                f"{self._count} batches of {batch_size} samples take {gigabytes:.1f} GB, which cannot be allocated: "
                f"{error.strerror or error}; use a smaller batch_size, or fewer workers"
            ) from error

    def _map(self, file: int) -> None:
        self._file = file
        weakref.finalize(self, os.close, file)
        self._memory = mmap.mmap(file, self._count * self._stride)

    def __getstate__(self) -> dict[str, Any]:
        """State for a process being started: the memory is passed on as an open file."""
        return {**self.__dict__, "_memory": None, "_lent": {}, "_file": reduction.DupFd(self._file)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._map(state["_file"].detach())

    def arrays(self, slot: int) -> tuple[NDArray[Any], NDArray[np.uint8]]:
        """Return a slot's memory as range float32 or uint16 [B, 1, H, W] and labels uint8 [B, H, W]."""
        count, rows, columns = self._shape
        pixels, start = count * rows * columns, slot * self._stride
        ranges = np.frombuffer(self._memory, self._dtype, pixels, start)
        labels = np.frombuffer(self._memory, np.uint8, pixels, start + self._labels_offset)
        return ranges.reshape(count, 1, rows, columns), labels.reshape(self._shape)

    def acquire(self) -> int:
        """Return a free slot, which is then acquired."""
        self._reclaim()
        return self._free.pop()

    def release(self, slot: int) -> None:
        """Make an acquired slot free."""
        self._free.append(slot)

    def lend(self, slot: int, count: int, pin: bool = False) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the first `count` images of an acquired slot as tensors (range, labels).

        The slot becomes free again when no reference to the tensors is left. pin: copy to page-locked memory, which
        torch manages, since copies to a GPU may outlast their tensors.
        """
        self._reclaim()
        ranges, labels = (array[:count] for array in self.arrays(slot))
        tensors = torch.from_numpy(ranges), torch.from_numpy(labels)
        if not pin and len(self._lent) < SPARE:
            # Every tensor, array or view that shares the storage keeps exactly these two objects alive.
            self._lent[slot] = (weakref.ref(ranges), weakref.ref(labels))
            return tensors
        copies = tuple(tensor.pin_memory() if pin else tensor.clone() for tensor in tensors)
        self._free.append(slot)
        return copies[0], copies[1]

    def _reclaim(self) -> None:
        for slot in [
            slot for slot, held in self._lent.items() if not any(reference() is not None for reference in held)
        ]:
            del self._lent[slot]
            self._free.append(slot)


def _whole_pages(size: int) -> int:
    return -(-size // mmap.PAGESIZE) * mmap.PAGESIZE


def _anonymous_file(size: int) -> int:
    if hasattr(os, "memfd_create"):
        file = os.memfd_create("bodyseg-batches")
    else:
        with tempfile.TemporaryFile() as temporary:
            file = os.dup(temporary.fileno())
    os.ftruncate(file, size)
    return file
