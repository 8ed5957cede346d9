"""Memory for arrays that live briefly, used again: fresh memory costs a page fault for every 4 kB written."""

from __future__ import annotations

import math
import mmap
import os
import weakref
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

_KEPT_BYTES: Final = 2**26
"""The most memory that is kept: for 60 items of 640 x 329 pixels."""


class ReusedMemory:
    """Gives out arrays; the memory of one is used again when neither it nor a view or tensor of it is left.

    Arrays beyond 64 MB in all have memory of their own. Threads may use it at once. Copies of the object, in forks and
    by pickle, have other memory.
    """

    def __init__(self) -> None:
        self._clear()

    def _clear(self) -> None:
        self._owner = os.getpid()
        self._free: dict[int, list[mmap.mmap]] = {}
        self._kept = 0

    def __getstate__(self) -> dict[str, Any]:
        return {}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self._clear()

    def empty(self, shape: tuple[int, ...], kind: type[np.generic]) -> NDArray[Any]:
        """Return a contiguous array of any content."""
        if self._owner != os.getpid():
            self._clear()
        size = math.prod(shape) * np.dtype(kind).itemsize
        free = self._free.setdefault(size, [])
        try:
            memory = free.pop()
        except IndexError:
            if self._kept + size > _KEPT_BYTES or not size:
                return np.empty(shape, kind)
            self._kept += size
            memory = mmap.mmap(-1, size)
        # Its base is no array, so that views and tensors of it keep exactly this object alive.
        found: NDArray[Any] = np.ndarray(shape, kind, memory)
        weakref.finalize(found, free.append, memory).atexit = False
        return found


SCRATCH: Final = ReusedMemory()
"""That of this process."""
