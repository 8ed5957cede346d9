"""Places in shared memory where workers put whole batches, used again as soon as nobody holds the batch any more.

No pixel is copied or sent, nothing is allocated, and no page is touched for the first time after the first few
batches. The memory has no name, so that nothing can be left behind; a small /dev/shm sets it no limit.
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
"""Batches that a user may hold at once without a copy: the one at hand, the one before it, and one more."""


class Slots:
    """`in_flight` + SPARE slots of one batch each.

    A slot is free, or taken (a worker writes it), or lent (somebody holds its tensors, or a view of them). With at
    most `in_flight` slots taken at once, one that is asked for is always free: at most SPARE are lent, and before
    another would be, its batch is copied instead.
    """

    def __init__(self, in_flight: int, batch_size: int, rows: int, columns: int, metres: bool) -> None:
        self._images = (batch_size, rows, columns)
        self._kind = np.dtype(np.float32 if metres else np.uint16)
        pixels = batch_size * rows * columns
        self._labels_at = _in_pages(pixels * self._kind.itemsize)
        self._stride = self._labels_at + _in_pages(pixels)
        self._count = in_flight + SPARE
        self._free = list(range(self._count))
        self._lent: dict[int, tuple[weakref.ref[Any], ...]] = {}
        try:
            self._map(_nameless_file(self._count * self._stride))
        except OSError as error:
            gigabytes = self._count * self._stride / 1e9
            raise BadConfig(
                f"{self._count} batches of {batch_size} samples take {gigabytes:.1f} GB, which cannot be had: "
                f"{error.strerror or error}; use a smaller batch_size, or fewer workers"
            ) from error

    def _map(self, file: int) -> None:
        self._file = file
        weakref.finalize(self, os.close, file)
        self._memory = mmap.mmap(file, self._count * self._stride)

    def __getstate__(self) -> dict[str, Any]:
        """Only for processes being started: the memory goes along as an open file."""
        return {**self.__dict__, "_memory": None, "_lent": {}, "_file": reduction.DupFd(self._file)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._map(state["_file"].detach())

    def arrays(self, slot: int) -> tuple[NDArray[Any], NDArray[np.uint8]]:
        """A slot as range float32 or uint16 [B, 1, H, W] and labels uint8 [B, H, W]."""
        count, rows, columns = self._images
        pixels, start = count * rows * columns, slot * self._stride
        ranges = np.frombuffer(self._memory, self._kind, pixels, start)
        labels = np.frombuffer(self._memory, np.uint8, pixels, start + self._labels_at)
        return ranges.reshape(count, 1, rows, columns), labels.reshape(self._images)

    def take(self) -> int:
        """A free slot, which is then taken."""
        self._see_what_came_back()
        return self._free.pop()

    def give_back(self, slot: int) -> None:
        """Make a taken slot free."""
        self._free.append(slot)

    def hand_over(self, slot: int, count: int, pin: bool = False) -> tuple[torch.Tensor, torch.Tensor]:
        """The first `count` images of a taken slot as (range, labels) that are the receiver's for as long as he likes.

        pin: copy them to page-locked memory, which torch manages, since copies to a GPU may outlast their tensors.
        """
        self._see_what_came_back()
        ranges, labels = (array[:count] for array in self.arrays(slot))
        tensors = torch.from_numpy(ranges), torch.from_numpy(labels)
        if not pin and len(self._lent) < SPARE:
            # Every tensor, array or view that shares the storage keeps exactly these two objects alive.
            self._lent[slot] = (weakref.ref(ranges), weakref.ref(labels))
            return tensors
        copies = tuple(tensor.pin_memory() if pin else tensor.clone() for tensor in tensors)
        self._free.append(slot)
        return copies[0], copies[1]

    def _see_what_came_back(self) -> None:
        for slot in [
            slot for slot, held in self._lent.items() if not any(reference() is not None for reference in held)
        ]:
            del self._lent[slot]
            self._free.append(slot)


def _in_pages(size: int) -> int:
    return -(-size // mmap.PAGESIZE) * mmap.PAGESIZE


def _nameless_file(size: int) -> int:
    if hasattr(os, "memfd_create"):
        file = os.memfd_create("bodyseg-batches")
    else:
        with tempfile.TemporaryFile() as temporary:
            file = os.dup(temporary.fileno())
    os.ftruncate(file, size)
    return file
