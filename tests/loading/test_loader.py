from __future__ import annotations

import gc
import json
import multiprocessing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader
from torchdata.stateful_dataloader import Stateful, StatefulDataLoader

from bodyseg_data import RangeImages, loader
from bodyseg_data.core import BadConfig, BadShard
from bodyseg_data.loading import Loader
from bodyseg_data.loading.slots import SPARE, Slots
from bodyseg_data.loading.workers import ProcessWorkers, ThreadWorkers

WAYS = [(0, "thread"), (2, "process"), (2, "thread")]
"""Numbers of workers, and their kind."""


def bits(batch: Any) -> tuple[list[str], bytes, bytes]:
    return batch["key"], batch["range"].numpy().tobytes(), batch["labels"].numpy().tobytes()


@pytest.fixture(scope="module")
def expected(small_set: Path) -> list[tuple[list[str], bytes, bytes]]:
    """Two passes over the train split in batches of 3: 12 batches."""
    batches = loader(RangeImages(small_set, "all", "train"), 3)
    return [bits(batch) for _ in range(2) for batch in batches]


@pytest.mark.parametrize(("workers", "method"), WAYS)
def test_a_batch_that_is_held_never_changes(
    small_set: Path, expected: list[tuple[list[str], bytes, bytes]], workers: int, method: Any
) -> None:
    batches = loader(RangeImages(small_set, "all", "train"), 3, workers, worker_method=method)
    held = [batch for _ in range(2) for batch in batches]
    for _ in range(2):
        for _ in batches:
            pass
    del batches
    gc.collect()
    assert [bits(batch) for batch in held] == expected


@pytest.mark.parametrize(("workers", "method"), WAYS)
def test_a_part_of_a_batch_is_held_too(
    small_set: Path, expected: list[tuple[list[str], bytes, bytes]], workers: int, method: Any
) -> None:
    batches = loader(RangeImages(small_set, "all", "train"), 3, workers, worker_method=method)
    kept: list[Any] = []
    for number, batch in enumerate(batches):
        ranges = batch["range"]
        kept.append((ranges[0], ranges.numpy()[0], memoryview(ranges.numpy()[0].reshape(-1)))[number % 3])
    del batch, ranges
    for _ in range(3):
        for batch in batches:
            batch["range"].fill_(-1)  # what a user does to a batch is nobody else's business
    for part, (_, whole, _) in zip(kept, expected, strict=False):
        image = np.asarray(part).tobytes()
        assert image == whole[: len(image)]


def test_a_forkserver_gives_the_same_bits(small_set: Path, expected: list[tuple[list[str], bytes, bytes]]) -> None:
    """As spawned workers do, which a program that changes its folder starts (test_arguments.py)."""
    images = RangeImages(small_set, "all", "train")
    batches = loader(images, 3, 1, worker_method="process", start_method="forkserver")
    assert [bits(batch) for batch in batches] == expected[:6]


@pytest.mark.parametrize(("workers", "method"), WAYS)
def test_sixteen_bits_are_the_same_ranges(small_set: Path, workers: int, method: Any) -> None:
    images = RangeImages(small_set, "all")
    pairs = zip(loader(images, 5, workers, metres=False, worker_method=method), loader(images, 5), strict=True)
    for steps, metres in pairs:
        assert steps["range"].dtype == torch.uint16
        assert torch.equal(steps["range"].to(torch.float32).mul_(images.step_m), metres["range"])
        assert torch.equal(steps["labels"], metres["labels"])


@pytest.mark.parametrize(
    ("workers", "method", "options", "ahead"),
    [
        (2, "thread", {}, 4),
        (2, "process", {}, 4),
        (3, "thread", {"prefetch_factor": 1}, 3),
        (1, "thread", {"prefetch_factor": 5}, 5),
    ],
)
def test_as_many_batches_are_asked_for_in_advance_as_the_prefetch_factor_says(
    small_set: Path, monkeypatch: pytest.MonkeyPatch, workers: int, method: Any, options: dict[str, Any], ahead: int
) -> None:
    """Two for each worker, as in PyTorch: more would take memory, and fewer let workers wait."""
    kind = {"thread": ThreadWorkers, "process": ProcessWorkers}[method]
    asked: list[Any] = []
    submit = kind.submit

    def counted(self: Any, request: Any) -> None:
        asked.append(request)
        submit(self, request)

    monkeypatch.setattr(kind, "submit", counted)
    batches = loader(RangeImages(small_set, "none", "train"), 1, workers, worker_method=method, **options)
    given = [len(asked) for _ in batches]
    assert given == [min(number + ahead, 16) for number in range(1, 17)]


def test_without_workers_a_batch_is_made_when_it_is_asked_for(small_set: Path) -> None:
    made: list[int] = []

    class Counted(RangeImages):
        def write(self, index: int, *where: Any) -> None:
            made.append(index)
            super().write(index, *where)

    for number, _ in enumerate(loader(Counted(small_set, "none", "train"), 3), start=1):
        assert len(made) == min(3 * number, 16)


def test_slots_come_back_when_nobody_holds_them() -> None:
    slots = Slots(2, 4, 5, 3, True, ())
    taken = [slots.acquire() for _ in range(2)]
    ranges, labels = slots.arrays(taken[0])
    assert (ranges.shape, ranges.dtype, labels.shape, labels.dtype) == ((4, 1, 5, 3), np.float32, (4, 5, 3), np.uint8)
    ranges[:], labels[:] = 7, 8
    lent = slots.lend(taken[0], 3)
    assert lent[0].shape == (3, 1, 5, 3)
    assert lent[0].data_ptr() == ranges.ctypes.data, "without a copy"
    seen: list[Any] = [lent]
    for _ in range(20):  # never out of slots, whatever is held; and what is held is never given to another
        slot = slots.acquire()
        others = slots.arrays(slot)[0]
        assert not np.shares_memory(others, ranges)
        others[:] = -1
        seen.append(slots.lend(slot, 4))
    assert (lent[0] == 7).all()
    assert (lent[1] == 8).all()
    pointers = {tensor.data_ptr() for tensor, _ in seen}
    assert len(pointers) == 21
    part = lent[1][1]
    del lent, seen
    free = {slots.acquire() for _ in range(2 + SPARE - 2)}
    assert taken[0] not in free, "a label is still held"
    del part
    assert slots.acquire() == taken[0]


def test_a_state_is_what_was_delivered_and_goes_on_anywhere(
    small_set: Path, expected: list[tuple[list[str], bytes, bytes]]
) -> None:
    images = RangeImages(small_set, "all", "train")
    first = loader(images, 3, 2, worker_method="process")
    assert isinstance(first, Stateful)
    states = [first.state_dict()]
    for _ in range(2):
        states.extend(first.state_dict() for _ in first)
    assert [(state["epoch"], state["position"]) for state in states[:8]] == [
        (0, 0), (0, 3), (0, 6), (0, 9), (0, 12), (0, 15), (0, 16), (1, 3),
    ]  # fmt: skip
    assert first.state_dict() == {**states[0], "epoch": 2}
    for done in (0, 2, 5, 6, 7, 12):
        again = loader(RangeImages(small_set, "all", "train"), 3, done % 2, worker_method="thread")
        again.load_state_dict(json.loads(json.dumps(states[done])))
        rest = [bits(batch) for _ in range(again.epoch, 2) for batch in again]
        assert rest == expected[done:]
    assert len(json.dumps(states[3])) < 700


def test_a_state_knows_what_it_belongs_to(figures_set: Path, small_set: Path) -> None:
    def fresh(variant: str = "all", split: Any = "train", shards: str = "*", **options: Any) -> Loader:
        seed = options.pop("seed", 0)
        return loader(RangeImages(figures_set / shards, variant, split, seed), 3, **options)

    state = fresh().state_dict()
    loader(RangeImages(small_set, "all", "train"), 3).load_state_dict(state)  # the same samples in other shards
    altered = fresh()
    record, *others = altered.images.manifest.shards
    spoiled = replace(record, crc32=(record.crc32[0] ^ 1, *record.crc32[1:]))
    altered.images.manifest = replace(altered.images.manifest, shards=(spoiled, *others))
    cases = (
        (fresh(shards="train-00000.tar"), "samples 16, here 5"),
        (altered, "set '[0-9a-f]{32}', here '[0-9a-f]{32}'"),
        (fresh("none"), "variant 'all', here 'none'"),
        (fresh(seed=1), "seed 0, here 1"),
        (fresh(shuffle=False), "shuffle True, here False"),
    )
    for other, message in cases:
        with pytest.raises(BadConfig, match=f"^the state belongs to another run: {message}$"):
            other.load_state_dict(state)
    for epoch, position in ((0, 17), (0, -1), (-1, 0), (0, 1.0)):
        said = f"a state's epoch and position must be whole numbers from 0 on, position at most 16, found {epoch} and"
        with pytest.raises(BadConfig, match=f"^{said} {position}$"):
            fresh().load_state_dict({**state, "epoch": epoch, "position": position})
    with pytest.raises(BadConfig, match="a state's 'skipped' must be a list of records"):
        fresh().load_state_dict({**state, "skipped": {}})
    for record in ({"epoch": 1}, {"epoch": "1", "key": "", "shard": "", "offset": 0, "why": ""}):
        with pytest.raises(BadConfig, match="a state's 'skipped' must be a list of records"):
            loader(RangeImages(figures_set, "all", "train"), 3).load_state_dict({**state, "skipped": [record]})


@pytest.mark.parametrize("workers", [0, 2])
def test_torch_loaders_go_by_the_same_order(
    small_set: Path, expected: list[tuple[list[str], bytes, bytes]], workers: int
) -> None:
    images = RangeImages(small_set, "all", "train")
    options: dict[str, Any] = {"num_workers": workers, "persistent_workers": workers > 0}
    order = images.batches(3)
    plain = DataLoader(images, batch_sampler=order, **options)
    assert len(plain) == 6
    passes = [bits(batch) for _ in range(2) for batch in plain]
    assert passes == expected, "the epoch travels with the request, so workers that live on draw anew"
    ended = order.state_dict()
    assert (ended["epoch"], ended["position"]) == (2, 0)
    again = images.batches(3)
    again.load_state_dict(order.state_dict(batches=4))
    assert [bits(batch) for batch in DataLoader(images, batch_sampler=again)] == expected[10:]


@pytest.mark.filterwarnings("ignore:'set_vital' is deprecated")  # torchdata calls it
@pytest.mark.parametrize("workers", [0, 2])
def test_a_stateful_dataloader_goes_on(
    small_set: Path, expected: list[tuple[list[str], bytes, bytes]], workers: int
) -> None:
    def fresh(every: int = 1) -> Any:
        images = RangeImages(small_set, "all", "train")
        order = images.batches(3)
        return StatefulDataLoader(images, batch_sampler=order, num_workers=workers, snapshot_every_n_steps=every)

    first = fresh()
    states = []
    for _ in range(2):
        states.extend(first.state_dict() for _ in first)
    for done in (4, 6) if workers else (1, 4, 6, 9):  # each with workers of its own
        again = fresh()
        again.load_state_dict(states[done - 1])
        found = [bits(batch) for batch in again]
        if done == 6:
            found = found or [bits(batch) for batch in again]
        end = 12 if done >= 6 else 6
        assert found == expected[done:end]
    for every in (4,) if workers else (1, 4, 100):
        ended = fresh(every)
        assert len(list(ended)) == 6
        again = fresh(every)
        again.load_state_dict(ended.state_dict())
        assert [bits(batch) for batch in again] == expected[6:12]


def test_indices_alone_draw_for_the_epoch_that_was_set(small_set: Path) -> None:
    images = RangeImages(small_set, "all", "train")
    later = images[2, 5]
    images.set_epoch(2)
    assert torch.equal(images[5]["range"], later["range"])
    with pytest.raises(IndexError, match="index 16 of 16 samples"):
        images[2, 16]


def test_bad_options_are_refused(figures_set: Path) -> None:
    images = RangeImages(figures_set)
    cases: list[tuple[dict[str, Any], str]] = [
        ({"on_error": "ignore"}, "on_error .*found 'ignore'"),
        ({"on_error": "skip"}, "skip_budget .*found 'skip' and None"),
        ({"skip_budget": 1}, "belong together, found 'stop' and 1"),
        ({"on_error": "skip", "skip_budget": -1}, "skip_budget must be a number of samples, or a share"),
        ({"on_error": "skip", "skip_budget": float("inf")}, "a share below 1, found inf"),
        ({"on_error": "skip", "skip_budget": True}, "a share below 1, found True"),
        ({"prefetch_factor": 0}, "prefetch_factor .*found 0"),
        ({"start_method": "thread"}, "start_method .*found 'thread'"),
        ({"worker_method": "fibre"}, "worker_method must be 'process' or 'thread', found 'fibre'$"),
        (
            {"worker_method": "thread", "start_method": "fork"},
            "^start_method is for worker_method='process', found 'fork'",
        ),
        ({"rank": 1, "world_size": 1}, "rank .*found 1 of 1"),
    ]
    for options, message in cases:
        with pytest.raises(BadConfig, match=message):
            loader(images, 4, **options)


def test_an_image_of_another_size_is_refused(figures_set: Path) -> None:
    images = RangeImages(figures_set, "none")
    small = np.zeros((10, 329), np.uint16), np.zeros((10, 329), np.uint8)
    with pytest.raises(
        BadShard, match=r"^train-00000.tar: offset 0: open-\S+: the image must be .* found .*\(10, 329\)"
    ):
        images.write(0, 0, *small)


def test_a_worker_process_has_no_workers(small_set: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(multiprocessing.current_process()._config, "daemon", True)  # type: ignore[attr-defined]
    batches: Loader = loader(RangeImages(small_set), 4, 1, worker_method="process")
    with pytest.raises(BadConfig, match="a worker process can have no processes of its own"):
        next(iter(batches))
