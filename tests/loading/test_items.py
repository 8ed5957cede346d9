"""Samples through PyTorch's own DataLoader: the bits of the loader, in memory that workers use again."""

from __future__ import annotations

import gc
import pickle
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader, default_collate
from wrapped_sets import Pairs

from bodyseg_data import RangeImages, loader
from bodyseg_data.loading.slots import ReusedMemory


class Mappings(Pairs):
    """Says how many shared memories the worker holds."""

    def __getitem__(self, index: int) -> Any:
        mapped = Path("/proc/self/maps").read_text().count("/torch_")
        return (*super().__getitem__(index), mapped)


def doubled(range_m: torch.Tensor) -> torch.Tensor:
    return range_m * 2


@pytest.fixture(scope="module")
def images(small_set: Path) -> RangeImages:
    return RangeImages(small_set, "all")


@pytest.fixture(scope="module")
def whole(images: RangeImages) -> tuple[torch.Tensor, torch.Tensor]:
    """All of the set, by the loader."""
    (batch,) = loader(images, len(images), shuffle=False)
    return batch["range"].clone(), batch["labels"].clone()


Whole = tuple[torch.Tensor, torch.Tensor]


def joined(batches: Sequence[Any]) -> Whole:
    return torch.cat([batch[0] for batch in batches]), torch.cat([batch[1] for batch in batches])


def equal(a: Whole, b: Whole) -> bool:
    return torch.equal(a[0], b[0]) and torch.equal(a[1], b[1])


# 12 batches of 1 from each worker are more than it keeps memory for.
@pytest.mark.parametrize("size", [1, 5])
def test_batches_that_are_kept_stay_as_they_are(images: RangeImages, whole: Whole, size: int) -> None:
    batches = list(DataLoader(Pairs(images), size, num_workers=2))
    assert [len(batch[0]) for batch in batches] == [size] * (24 // size) + [24 % size] * (24 % size > 0)
    assert equal(joined(batches), whole)
    assert all(type(tensor) is torch.Tensor for batch in batches for tensor in batch)


def test_memory_of_batches_that_are_done_with_is_used_again(images: RangeImages, whole: Whole) -> None:
    batches = DataLoader(Mappings(images), 2, num_workers=1, persistent_workers=True)
    for _ in range(3):
        mapped = []
        for number, (ranges, labels, count) in enumerate(batches):
            rows = slice(2 * number, 2 * number + 2)
            assert torch.equal(ranges, whole[0][rows]) and torch.equal(labels, whole[1][rows])
            mapped.append(int(count.max()))
        assert 0 < max(mapped) <= 2 * 5, "two made in advance, one on its way, one in use, and one before it"


@pytest.mark.parametrize("look", [lambda t: t[0], lambda t: t.numpy(), lambda t: t.view(-1)[7:].numpy()[2:]])
def test_a_view_keeps_its_batch(images: RangeImages, look: Callable[[torch.Tensor], Any]) -> None:
    views, copies = [], []
    for batch in DataLoader(images, 2, num_workers=1):
        views.append(look(batch["range"]))
        copies.append(np.asarray(views[-1]).copy())
    del batch
    gc.collect()
    assert all(np.array_equal(view, copy) for view, copy in zip(views, copies, strict=True))


def test_batches_may_be_written_to(images: RangeImages, whole: Whole) -> None:
    for _ in range(2):
        for number, batch in enumerate(DataLoader(images, 8, num_workers=1)):
            assert torch.equal(batch["range"], whole[0][8 * number : 8 * number + 8])
            batch["range"].zero_()


def alone(items: list[Any]) -> Any:
    return items


def half(items: list[Any]) -> Any:
    ranges, labels = default_collate(items)
    return ranges[:, :, ::2], labels[:, ::2].contiguous()


def twice(items: list[Any]) -> Any:
    ranges, labels = default_collate(items)
    return ranges, labels, ranges, labels


def turned(items: list[Any]) -> Any:
    ranges, labels = default_collate(items)
    return ranges.transpose_(2, 3), labels.add_(1)


def test_collate_functions_of_users_get_tensors_like_any(images: RangeImages, whole: Whole) -> None:
    def collated(function: Callable[[list[Any]], Any], alter: Any = None) -> list[Any]:
        return list(DataLoader(Pairs(images, alter), 6, num_workers=2, collate_fn=function))

    items = [item for batch in collated(alone) for item in batch]
    assert equal(joined([(ranges[None], labels[None]) for ranges, labels in items]), whole)
    assert equal(joined(collated(half)), (whole[0][:, :, ::2], whole[1][:, ::2]))
    both = collated(twice)
    assert equal(joined(both), whole) and equal(joined([batch[2:] for batch in both]), whole)
    assert equal(joined(collated(turned)), (whole[0].transpose(2, 3), whole[1] + 1))
    assert equal(joined(collated(default_collate, doubled)), (whole[0] * 2, whole[1]))


class KeepsItems(Pairs):
    """Keeps its items in the worker, as a cache does."""

    def __init__(self, images: RangeImages) -> None:
        super().__init__(images)
        self.kept: dict[int, Any] = {}

    def __getitem__(self, index: int) -> Any:
        if index not in self.kept:
            self.kept[index] = super().__getitem__(index)
        return self.kept[index]


def test_items_that_a_worker_keeps_stay_as_they_are(images: RangeImages, whole: Whole) -> None:
    batches = DataLoader(KeepsItems(images), 4, num_workers=1, persistent_workers=True)
    for _ in range(3):
        for number, (ranges, labels) in enumerate(batches):
            rows = slice(4 * number, 4 * number + 4)
            assert torch.equal(ranges, whole[0][rows]) and torch.equal(labels, whole[1][rows])
            ranges.zero_()


def test_a_pass_that_is_left_early_loses_no_memory(images: RangeImages, whole: Whole) -> None:
    batches = DataLoader(Mappings(images), 2, num_workers=1, persistent_workers=True)
    for _ in range(4):
        next(iter(batches))
    last = list(batches)
    assert equal(joined(last), whole)
    assert int(last[0][2].max()) <= 2 * 6


def test_other_ways_of_sharing_memory_work_as_well(images: RangeImages, whole: Whole) -> None:
    before = torch.multiprocessing.get_sharing_strategy()
    torch.multiprocessing.set_sharing_strategy("file_system")
    try:
        assert equal(joined(list(DataLoader(Pairs(images), 6, num_workers=1))), whole)
    finally:
        torch.multiprocessing.set_sharing_strategy(before)


def test_items_of_different_sizes_are_refused_as_by_torch(images: RangeImages) -> None:
    with pytest.raises(RuntimeError, match="stack expects each tensor to be equal size"):
        next(iter(DataLoader(Pairs(images, uneven), 6, num_workers=1)))


_made: list[int] = []


def uneven(range_m: torch.Tensor) -> torch.Tensor:
    _made.append(1)
    return range_m.unsqueeze_(0) if len(_made) == 2 else range_m


def test_memory_is_given_again_when_nothing_refers_to_it() -> None:
    memory = ReusedMemory()
    first = memory.empty((4, 5), np.uint16)
    place = first.ctypes.data
    assert first.shape == (4, 5) and first.dtype == np.uint16 and first.flags.carray
    row, tensor = first[1:], torch.from_numpy(first.view(np.int16))
    del first
    assert memory.empty((4, 5), np.uint16).ctypes.data != place
    del row
    assert memory.empty((4, 5), np.uint16).ctypes.data != place
    del tensor
    held = [memory.empty((20,), np.uint16) for _ in range(3)]
    assert place in [one.ctypes.data for one in held], "for any shape of as many bytes"
    assert pickle.loads(pickle.dumps(memory)).empty((2,), np.uint8).shape == (2,)


def test_memory_beyond_the_most_is_not_kept() -> None:
    memory = ReusedMemory()
    held = [memory.empty((2**25,), np.uint8) for _ in range(3)]
    assert [one.base is None for one in held] == [False, False, True]
    assert memory.empty((0, 3), np.float32).shape == (0, 3)
