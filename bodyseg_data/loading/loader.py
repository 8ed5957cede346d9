"""Batches of range images, made in worker processes and delivered without a copy."""

from __future__ import annotations

import os
import weakref
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

from bodyseg_data.core.errors import BadConfig, BodysegError
from bodyseg_data.loading.batch_order import BatchOrder, Pass, flag, whole_number
from bodyseg_data.loading.range_images import Batch, RangeImages, metres
from bodyseg_data.loading.skipping import SKIPPABLE, OnError, SkipLedger, Skipped, checked_budget, checked_log
from bodyseg_data.loading.slots import Slots
from bodyseg_data.loading.workers import InlineWorkers, StartMethod, Workers

Fault = tuple[int, BodysegError]
"""(place in the batch, why it could not be filled): raised where the user is, not in a worker."""

_START_METHODS: Final = (None, "fork", "spawn", "forkserver")


@dataclass(frozen=True)
class LoaderOptions:
    """How batches are made, which changes none of their bits; see `loader`."""

    num_workers: int
    prefetch_factor: int
    metres: bool
    pin_memory: bool
    start_method: StartMethod | None

    def __post_init__(self) -> None:
        whole_number("num_workers", self.num_workers, 0)
        whole_number("prefetch_factor", self.prefetch_factor, 1)
        flag("metres", self.metres)
        flag("pin_memory", self.pin_memory)
        if self.start_method not in _START_METHODS:
            raise BadConfig(f"start_method must be fork, spawn, forkserver or None, found {self.start_method!r}")


@dataclass(frozen=True)
class _WorkerState:
    """Who makes batches, and where they put them. in_flight: the slots of what was asked for. owner: whose they are."""

    makers: InlineWorkers | Workers
    slots: Slots
    end: Callable[[], Any]
    owner: int
    in_flight: deque[int] = field(default_factory=deque)


@dataclass(frozen=True)
class _BatchMaker:
    """What runs in a worker: fills a slot. The images that could be made come first in it, in the order asked for."""

    images: RangeImages
    slots: Slots
    metres: bool
    strict: bool

    def __call__(self, request: tuple[int, int, list[int]]) -> list[Fault]:
        slot, epoch, indices = request
        ranges, labels = self.slots.arrays(slot)
        steps = np.empty(ranges.shape[2:], np.uint16)
        faults: list[Fault] = []
        for place, index in enumerate(indices):
            at = place - len(faults)
            try:
                self.images.write(index, epoch, steps if self.metres else ranges[at, 0], labels[at])
            except BodysegError as error:
                faults.append((place, type(error)(str(error))))
                if self.strict or not isinstance(error, SKIPPABLE):
                    break  # it ends the run, and every further sample might take as long to fail
            else:
                if self.metres:
                    metres(steps, ranges[at, 0])
        return faults


class Loader:
    """Iterates over batches, pass after pass; every pass is another epoch with another order and other draws.

    The first pass is the images' `epoch`. `images.set_epoch(n)` makes the next pass epoch n. Make one loader and use it
    for all epochs: a new one starts where `images.epoch` says, and starts its workers anew. One pass runs at a time.
    A batch belongs to whoever holds it and does not change, except in forks of his process. Workers end with the
    loader, or after an error.

    order: which samples make up which batch; see `BatchOrder`.
    """

    def __init__(self, images: RangeImages, order: BatchOrder, ledger: SkipLedger, options: LoaderOptions) -> None:
        self.images, self.order = images, order
        self._ledger, self._options = ledger, options
        self._workers = min(options.num_workers, len(order))
        self._ahead = max(1, min(self._workers * options.prefetch_factor, len(order)))
        self._passes = 0
        self._state: _WorkerState | None = None

    def __len__(self) -> int:
        """Batches of a whole pass, the same for every rank."""
        return len(self.order)

    @property
    def epoch(self) -> int:
        """The epoch of the next pass."""
        return self.order.epoch

    @property
    def skipped(self) -> list[Skipped]:
        """The samples left out so far, in the order in which they were missed."""
        return self._ledger.skipped

    def state_dict(self) -> dict[str, Any]:
        """What has been delivered, as plain JSON: epoch, position, skipped samples, and what they belong to."""
        return {**self.order.state_dict(), "skipped": self._ledger.state()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Make the next pass go on after what had been delivered, for any number of workers and ranks, any batch size.

        Raises BadConfig for a state of other images.
        """
        self.order.load_state_dict(state)
        self._ledger.load_state(state.get("skipped", []))

    def __iter__(self) -> Iterator[Batch]:
        plan = self.order.begin()
        self._passes += 1
        this = self._passes
        try:
            state = self._ready()
            for number in range(min(self._ahead, len(plan))):
                _ask(state, plan, number)
            for number in range(len(plan)):
                batch = self._deliver(state, plan, number)
                if number + self._ahead < len(plan):
                    _ask(state, plan, number + self._ahead)
                self.order.reach(number + 1)
                yield batch
                del batch  # or its slot would stay lent while the next batch is waited for
                if self._passes != this:
                    raise BadConfig("a loader gives one pass at a time, and a newer one has begun: make another loader")
            self.order.end()
        except GeneratorExit:
            raise  # what the workers are at is thrown away when the next pass begins
        except BaseException:
            if self._passes == this and self._state is not None:
                ending, self._state = self._state, None  # first, for ending it may be interrupted, too
                ending.end()
            raise

    def _ready(self) -> _WorkerState:
        """Makers with nothing to do."""
        if self._state is None or self._state.owner != os.getpid():
            self._state = self._new_state()
        in_flight = self._state.in_flight
        while in_flight:  # asked for by a pass that was left early
            self._state.makers.drop()
            self._state.slots.give_back(in_flight.popleft())
        return self._state

    def _new_state(self) -> _WorkerState:
        camera, options = self.images.manifest.rig.camera, self._options
        slots = Slots(self._ahead, self.order.largest, camera.rows, camera.columns, options.metres)
        maker = _BatchMaker(self.images, slots, options.metres, self._ledger.strict)
        self.images.augmentation.prepare()
        makers = Workers(maker, self._workers, options.start_method) if self._workers else InlineWorkers(maker)
        return _WorkerState(makers, slots, weakref.finalize(self, makers.close), os.getpid())

    def _deliver(self, state: _WorkerState, plan: Pass, number: int) -> Batch:
        faults: list[Fault] = state.makers.answer()
        slot = state.in_flight.popleft()
        places = [self.images.place(index) for index in plan.batch(number)]
        for at, error in faults:
            shard, key, offset = places[at]
            self._ledger.add(Skipped(plan.epoch, key, shard, offset, str(error)), error)
        missing = {at for at, _ in faults}
        keys = [key for at, (_, key, _) in enumerate(places) if at not in missing]
        pin = self._options.pin_memory and torch.cuda.is_available()
        ranges, labels = state.slots.hand_over(slot, len(keys), pin)
        return {"range": ranges, "labels": labels, "key": keys}


def _ask(state: _WorkerState, plan: Pass, number: int) -> None:
    slot = state.slots.take()
    state.in_flight.append(slot)
    state.makers.ask((slot, plan.epoch, plan.batch(number)))


def loader(
    images: RangeImages,
    batch_size: int,
    num_workers: int = 0,
    shuffle: bool | None = None,
    drop_last: bool = False,
    *,
    rank: int | None = None,
    world_size: int | None = None,
    on_error: OnError = "stop",
    skip_budget: float | None = None,
    skip_log: str | Path | None = None,
    metres: bool = True,
    pin_memory: bool = False,
    prefetch_factor: int = 2,
    start_method: StartMethod | None = None,
) -> Loader:
    """Batches of `images`, made in `num_workers` processes (0: in this one); see `Batch` for what a batch holds.

    shuffle: None shuffles the train split and nothing else. drop_last: leave out the last batch if it is not full.

    rank, world_size: which of how many processes this is, each of which gets batches of `batch_size`, and equally many;
    None asks torch.distributed, then torchrun's RANK and WORLD_SIZE.

    on_error: "stop" raises for a bad sample. "skip" leaves it out, which makes its batch shorter and maybe empty, never
    one batch less. skip_budget: how many samples a pass of this rank may lose so, or which share of the set (a float
    below 1). skip_log: a file to which each is appended as a line of JSON.

    metres: False leaves ranges as uint16 in steps of 0.1 mm, half the bytes, for a GPU to convert. pin_memory: deliver
    in page-locked memory, if CUDA is there. prefetch_factor: batches that each worker makes in advance, as in PyTorch:
    `num_workers * prefetch_factor` in all, and none with `num_workers=0`, where each is made when it is asked for.
    start_method: "fork", "spawn" or "forkserver"; None is Python's choice.

    Raises BadConfig.
    """
    if not isinstance(images, RangeImages):
        raise BadConfig(f"images must be RangeImages, found {type(images).__name__}")
    order = images.batches(batch_size, shuffle, drop_last, rank, world_size)
    budget = checked_budget(on_error, skip_budget, len(images))
    ledger = SkipLedger(budget, checked_log(on_error, skip_log))
    return Loader(images, order, ledger, LoaderOptions(num_workers, prefetch_factor, metres, pin_memory, start_method))
