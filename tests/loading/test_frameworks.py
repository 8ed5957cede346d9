"""Frameworks that share batches out to ranks: no sample is lost, or one line says what to give.

Their ways with samplers are imitated here; where the packages are installed, they themselves run on two ranks.
"""

from __future__ import annotations

import gc
import importlib.util
import json
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from processes import run_on_two_ranks
from torch.utils.data import BatchSampler, DataLoader, SequentialSampler
from torch.utils.data.distributed import DistributedSampler

from bodyseg_data import Mixture, RangeImages, loader
from bodyseg_data.core import BadConfig

SHARED_TWICE = (
    "batches are shared out to 2 ranks, and BatchSamplerShard would share them out again and lose samples: use "
    "batches(3, rank=0, world_size=1) or loader() there, or leave the loader out of Accelerate's prepare"
)


class BatchSamplerShard(BatchSampler):
    """As Accelerate wraps a loader's batch sampler: every n-th batch is this rank's."""

    def __init__(self, batch_sampler: Any, num_processes: int, process_index: int) -> None:
        self.batch_sampler, self.num_processes, self.process_index = batch_sampler, num_processes, process_index

    def __iter__(self) -> Iterator[Any]:
        for number, batch in enumerate(self.batch_sampler):
            if number % self.num_processes == self.process_index:
                yield batch


class DataLoaderDispatcher:
    """As Accelerate reads batches on one rank, whose parts it sends to all."""

    def __init__(self, base_dataloader: DataLoader[Any]) -> None:
        self.base_dataloader = base_dataloader

    def __iter__(self) -> Iterator[Any]:
        yield from self.base_dataloader.__iter__()


def sets(folder: Path) -> list[RangeImages | Mixture]:
    images = RangeImages(folder, "none", split="train", seed=0)
    return [images, Mixture([(images, 1.0)], seed=1)]


def test_batches_cannot_be_shared_out_twice(figures_set: Path) -> None:
    for images in sets(figures_set):
        keys = []
        for rank in (0, 1):
            order = BatchSamplerShard(images.batches(3, rank=rank, world_size=2), 2, rank)
            with pytest.raises(BadConfig) as caught:
                next(iter(DataLoader(images, batch_sampler=order)))
            assert str(caught.value) == SHARED_TWICE
            dispatched = DataLoader(images, batch_sampler=images.batches(3, rank=rank, world_size=2))
            with pytest.raises(BadConfig, match="DataLoaderDispatcher would share them out again"):
                next(iter(DataLoaderDispatcher(dispatched)))
            whole = BatchSamplerShard(images.batches(3, rank=0, world_size=1), 2, rank)
            keys += [key for batch in DataLoader(images, batch_sampler=whole) for key in batch["key"]]
        assert len(set(keys)) == len(keys) == len(images), "as the line says, every sample comes once"


def test_what_reads_batches_lets_go_of_what_it_deletes(figures_set: Path) -> None:
    for images in sets(figures_set):
        model = torch.nn.Linear(1, 1)
        freed = weakref.ref(model)
        for _ in DataLoader(images, batch_sampler=images.batches(3)):
            break
        del model
        gc.collect()
        assert freed() is None


def test_one_process_may_be_wrapped(figures_set: Path) -> None:
    for images in sets(figures_set):
        for rank, ranks in ((0, 1), (1, 2)):
            order = images.batches(3, rank=rank, world_size=ranks)
            assert sum(map(len, BatchSamplerShard(order, 1, 0))) == len(images) // ranks, "shared out once"


def test_a_sampler_put_before_batches_names_the_option(figures_set: Path) -> None:
    for images in sets(figures_set):
        order = images.batches(3)
        for sampler in (DistributedSampler(images, 2, 0), SequentialSampler(images)):  # fit, and predict
            with pytest.raises(BadConfig) as caught:  # as Lightning and Fabric make batch samplers anew
                type(order)(sampler, batch_size=3, drop_last=False)  # type: ignore[arg-type]
            assert "\n" not in str(caught.value) and "use_distributed_sampler=False" in str(caught.value)
            assert type(sampler).__name__ in str(caught.value)


def test_batches_made_before_the_process_group_are_refused(figures_set: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for images in sets(figures_set):
        order, own, whole = images.batches(3), images.batches(3, rank=0, world_size=1), loader(images, 3)
        with monkeypatch.context() as context:
            context.setattr(torch.distributed, "is_initialized", lambda: True)
            context.setattr(torch.distributed, "get_rank", lambda: 1)
            context.setattr(torch.distributed, "get_world_size", lambda: 2)
            for early in (order, whole):
                with pytest.raises(BadConfig, match="were made for 1 rank, before the process group of 2: create them"):
                    next(iter(early))
            assert sum(map(len, own)) == len(images), "the caller has said so"
            assert sum(map(len, BatchSamplerShard(order, 2, 1))) < len(images), "shared out once, afterwards"
            next(iter(loader(images, 3)))


def on_two_ranks(folder: Path, out: Path, framework: str, how: str) -> list[Any]:
    out.mkdir()
    run_on_two_ranks("framework_worker.py", str(out), str(folder), framework, how)
    return [json.loads((out / f"{rank}.json").read_text()) for rank in (0, 1)]


@pytest.mark.parametrize("framework", ["accelerate", "fabric", "lightning"])
def test_a_framework_on_two_ranks(framework: str, figures_set: Path, tmp_path: Path) -> None:
    package = "accelerate" if framework == "accelerate" else "lightning"
    if importlib.util.find_spec(package) is None:
        pytest.skip(f"{package} is not installed")
    images = RangeImages(figures_set, "none", split="train")
    for how in ("whole", "loader"):
        one, other = on_two_ranks(figures_set, tmp_path / how, framework, how)
        assert set(one) | set(other) == set(images.keys), how
        assert len(one) + len(other) <= len(images) + 2, "at most a batch filled up"
    for line in on_two_ranks(figures_set, tmp_path / "batches", framework, "batches"):
        assert line == SHARED_TWICE if framework == "accelerate" else "use_distributed_sampler=False" in line
