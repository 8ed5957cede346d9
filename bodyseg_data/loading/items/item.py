"""Samples as items of a data set, and how PyTorch's `default_collate` makes batches of them in a worker."""

from __future__ import annotations

from collections.abc import Sequence
from multiprocessing.reduction import ForkingPickler
from typing import Any

import torch
from numpy.typing import NDArray
from torch.utils.data import default_collate, get_worker_info
from torch.utils.data._utils.collate import default_collate_fn_map  # to be extended, says `default_collate`

from bodyseg_data.loading.items.shared_batches import empty_batch


class ItemTensor(torch.Tensor):
    """One sample's range or labels in a worker of a DataLoader. What operations on it return are plain tensors.

    The class tells `default_collate` to stack such tensors by `_stacked`, also where a data set of the user's hands
    them on.
    """

    __torch_function__ = torch._C._disabled_torch_function_impl  # type: ignore[assignment]  # as torch.nn.Parameter


def item_tensor(array: NDArray[Any]) -> torch.Tensor:
    """Return an array as a tensor, uncopied: an `ItemTensor` in a worker, else a plain one."""
    tensor = torch.from_numpy(array)
    return tensor if get_worker_info() is None else tensor.as_subclass(ItemTensor)


def _stacked(batch: Sequence[torch.Tensor], *, collate_fn_map: Any = None) -> torch.Tensor:
    """Stack tensors as `default_collate` does, in memory that is used again."""
    plain = [tensor.as_subclass(torch.Tensor) for tensor in batch]
    shape, kind = plain[0].shape, plain[0].dtype
    if all(tensor.shape == shape and tensor.dtype == kind for tensor in plain):
        made = empty_batch(len(plain), tuple(shape), plain[0].numpy().dtype)
        if made is not None:
            torch.stack(plain, out=made.as_subclass(torch.Tensor))
            return made
    found: torch.Tensor = default_collate(plain)
    return found


def _reduce(tensor: ItemTensor) -> Any:
    return torch.Tensor.contiguous, (tensor.as_subclass(torch.Tensor),)  # by PyTorch's own way of sharing


default_collate_fn_map[ItemTensor] = _stacked
ForkingPickler.register(ItemTensor, _reduce)
