"""Shared memory into which workers write whole batches, reused as soon as no reference to a batch is left.

`Slots` are the memory of `Loader`. No pixel is copied or sent between processes, and after the first few batches
nothing is allocated and no page is touched for the first time. The memory has no name, so that nothing is left behind;
a small /dev/shm does not limit it.

`item_tensor` and `empty_batch` serve PyTorch's own DataLoader, whose workers take new shared memory for every batch,
and to write to it for the first time takes longer than to make the images. Here a worker keeps the memory of its
batches. The last byte says whether a batch is in use: the worker sets it when it sends the batch, and the process that
receives it clears it when no tensor or view of it is left.
"""

from __future__ import annotations

import itertools
import math
import mmap
import os
import tempfile
import weakref
from collections.abc import Callable, Iterable, Sequence
from multiprocessing import reduction
from multiprocessing.reduction import ForkingPickler
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch.multiprocessing import get_sharing_strategy
from torch.utils.data import default_collate, get_worker_info
from torch.utils.data._utils.collate import default_collate_fn_map  # where the manual of `default_collate` extends it

from bodyseg_data.core import BadConfig
from bodyseg_data.shards import Stage

_KEPT_BYTES: Final = 2**26  # the most memory that is kept: for 60 items of 640 x 329 pixels


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


SPARE: Final = 3
"""Batches that a user may hold at once without a copy: the current one, the one before it, and one more."""

_MOST: Final = 8  # batches of one kind that a worker keeps memory for; any beyond them are left to PyTorch
_Reduced = tuple[Callable[..., torch.Tensor], tuple[Any, ...]]

_memories: dict[int, list[_SharedMemory]] = {}  # bytes of an item -> the memory of this worker's batches of such items


class Slots:
    """`in_flight` + SPARE slots of one batch each.

    A slot is free, acquired (a worker writes it), or lent (the user holds its tensors or views of them). With at most
    `in_flight` slots acquired at once, `acquire` always finds a free one: at most SPARE are lent, and further batches
    are copied instead.
    """

    def __init__(
        self,
        in_flight: int,
        batch_size: int,
        rows: int,
        columns: int,
        metres: bool,
        planes: Iterable[np.dtype[Any]] = (),
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
        """What was tallied over all batches of each slot, float64 [slots, len(Stage)]."""
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
        for slot in [
            slot for slot, held in self._lent.items() if not any(reference() is not None for reference in held)
        ]:
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


class _SharedMemory:
    """Shared memory for one batch at a time."""

    def __init__(self, size: int) -> None:
        self._whole = torch.empty(size + 1, dtype=torch.uint8).share_memory_()  # type: ignore[no-untyped-call]
        self._bytes = self._whole.numpy()
        self._array: weakref.ref[NDArray[Any]] | None = None
        self._sent = False

    @property
    def size(self) -> int:
        """Bytes that a batch may have."""
        return len(self._bytes) - 1

    @property
    def is_free(self) -> bool:
        """True if neither this process nor the one that has received the batch refers to it."""
        if self._array is not None and self._array() is not None:
            return False
        return not (self._sent and self._bytes[-1])

    def batch(self, shape: tuple[int, ...], kind: np.dtype[Any]) -> BatchTensor:
        """Return the memory as a batch of any content."""
        array = _shaped(self._bytes, shape, kind)
        self._array, self._sent = weakref.ref(array), False
        tensor = torch.from_numpy(array).as_subclass(BatchTensor)
        tensor.memory = self
        return tensor

    def reduced(self, batch: torch.Tensor) -> _Reduced | None:
        """Return what another process makes the batch of, once; None if it was sent before or has been altered."""
        if self._sent or not batch.is_contiguous() or batch.data_ptr() != self._whole.data_ptr():
            return None
        self._sent, self._bytes[-1] = True, 1
        return _received, (self._whole, tuple(batch.shape), batch.numpy().dtype.str)


class _Plain(torch.Tensor):
    """A tensor of a class of its own. What operations on it return are plain tensors."""

    @classmethod
    def __torch_function__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        with torch._C.DisableTorchFunctionSubclass():  # as PyTorch's manual, "Extending torch", writes it
            return func(*args, **(kwargs or {}))


class ItemTensor(_Plain):
    """One sample's range or labels in a worker of a DataLoader, also where a data set of the user's hands it on.

    The class tells `default_collate` to stack such tensors by `_stacked`.
    """


class BatchTensor(_Plain):
    """A batch in a worker's shared memory."""

    memory: _SharedMemory


# Batches of PyTorch's own DataLoader.


def item_tensor(array: NDArray[Any]) -> torch.Tensor:
    """Return an array as a tensor, uncopied: an `ItemTensor` in a worker, else a plain one."""
    tensor = torch.from_numpy(array)
    return tensor if get_worker_info() is None else tensor.as_subclass(ItemTensor)


def _stacked(items: Sequence[torch.Tensor], *, collate_fn_map: Any = None) -> torch.Tensor:
    """Stack tensors as `default_collate` does, in memory that is used again where it can be."""
    plain = [item.as_subclass(torch.Tensor) for item in items]
    shape, kind = plain[0].shape, plain[0].dtype
    if all(item.shape == shape and item.dtype == kind for item in plain):
        made = empty_batch(len(plain), tuple(shape), plain[0].numpy().dtype)
        if made is not None:
            torch.stack(plain, out=made.as_subclass(torch.Tensor))
            return made
    found: torch.Tensor = default_collate(plain)
    return found


def _shaped(memory: NDArray[np.uint8], shape: tuple[int, ...], kind: np.dtype[Any]) -> NDArray[Any]:
    return memory[: math.prod(shape) * kind.itemsize].view(kind).reshape(shape)


def _received(whole: torch.Tensor, shape: tuple[int, ...], kind: str) -> torch.Tensor:
    """Return the batch in the process that receives it, as a plain tensor."""
    memory = whole.numpy()
    array = _shaped(memory, shape, np.dtype(kind))
    # Every tensor, array or view that shares the storage keeps exactly this array alive.
    weakref.finalize(array, _release, memory, os.getpid()).atexit = False
    return torch.from_numpy(array)


def _release(memory: NDArray[np.uint8], owner: int) -> None:
    if os.getpid() == owner:  # a fork of the receiver may drop its reference first
        memory[-1] = 0


def _reduce(batch: BatchTensor) -> _Reduced:
    plain = batch.as_subclass(torch.Tensor)
    return batch.memory.reduced(plain) or (torch.Tensor.contiguous, (plain.clone(),))


def _reduce_item(tensor: ItemTensor) -> _Reduced:
    return torch.Tensor.contiguous, (tensor.as_subclass(torch.Tensor),)  # by PyTorch's own way of sharing


default_collate_fn_map[ItemTensor] = _stacked
ForkingPickler.register(BatchTensor, _reduce)
ForkingPickler.register(ItemTensor, _reduce_item)


def empty_batch(count: int, shape: tuple[int, ...], kind: np.dtype[Any]) -> BatchTensor | None:
    """Return a batch [count, *shape] of any content to fill and send, or None where PyTorch should make it.

    That is outside of a DataLoader's workers, with another way of sharing memory than by file descriptor, and when the
    batches in use are too many.
    """
    each = math.prod(shape) * kind.itemsize
    strategy = get_sharing_strategy()  # type: ignore[no-untyped-call]
    if get_worker_info() is None or strategy != "file_descriptor" or not count * each:
        return None
    kept = _memories.setdefault(each, [])
    free = [memory for memory in kept if memory.is_free]
    for memory in free:
        if memory.size >= count * each:
            return memory.batch((count, *shape), kind)
        kept.remove(memory)  # too small, as after a short batch
    if len(kept) >= _MOST:
        return None
    kept.append(_SharedMemory(count * each))
    return kept[-1].batch((count, *shape), kind)
