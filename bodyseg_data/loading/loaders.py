"""Batches of range images, made by worker threads or processes and delivered without a copy."""

import os
import time
import weakref
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import MISSING, dataclass, field
from typing import Any

import numpy as np
import torch

from bodyseg_data.core import BadConfig, BodysegError, bounded, check_fields
from bodyseg_data.loading.image_set import Batch, BatchOrder, ImageSet, Pass, Request, Shuffle, check_bool
from bodyseg_data.loading.skipping import SKIPPABLE, OnError, SkipLedger, Skipped, checked_budget, with_text
from bodyseg_data.loading.slots import Slots
from bodyseg_data.loading.workers import (
    DEFAULT_WORKER_METHOD,
    InlineWorkers,
    ProcessWorkers,
    StartMethod,
    ThreadWorkers,
    WorkerLost,
    WorkerMethod,
    Workers,
)
from bodyseg_data.machine import use_compiled
from bodyseg_data.samples import metres
from bodyseg_data.shards import TALLY, LookAhead, Stage

Fault = tuple[int, BodysegError]
"""(index in the batch, error): returned by a worker and raised in the user's process."""


@dataclass(frozen=True)
class LoaderOptions:
    """Options of a loader that change none of its batches' bits; see `loader`."""

    metres: bool
    pin_memory: bool
    worker_method: WorkerMethod
    start_method: StartMethod | None
    num_workers: int = bounded(MISSING, 0)
    prefetch_factor: int = bounded(MISSING, 1)

    def __post_init__(self) -> None:
        check_fields(self)
        if self.start_method is not None and self.worker_method != "process":
            raise BadConfig(
                f"start_method is for worker_method='process', found {self.start_method!r} with {self.worker_method!r}"
            )


@dataclass(frozen=True)
class _WorkerState:
    """Workers and the memory that they fill. in_flight: slots of the batches requested so far, oldest first.

    close: ends the workers. owner: id of the process that they belong to.
    """

    workers: Workers
    slots: Slots
    close: Callable[[], Any]
    owner: int
    in_flight: deque[int] = field(default_factory=deque)


@dataclass(frozen=True)
class _BatchMaker:
    """Function that a worker runs: fills a slot with the images requested, in their order, and returns the faults.

    A sample that cannot be read leaves no gap: the next one takes its row.
    """

    images: ImageSet
    slots: Slots
    metres: bool
    strict: bool

    def __call__(self, batch: tuple[int, list[Request]]) -> list[Fault]:
        slot, requests = batch
        ranges, labels, *planes = self.slots.arrays(slot)
        TALLY.start(self.slots.tallies()[slot].data)
        steps = np.empty(ranges.shape[2:], np.uint16)
        faults: list[Fault] = []
        for number, (epoch, index) in enumerate(requests):
            row = number - len(faults)
            try:
                image = steps if self.metres else ranges[row, 0]
                self.images.write(index, epoch, image, labels[row], *(([p[row] for p in planes],) if planes else ()))
            except BodysegError as error:
                faults.append((number, with_text(error, str(error))))
                if self.strict or not isinstance(error, SKIPPABLE):
                    break  # this error ends the run, and every further sample might take as long to fail
            else:
                if self.metres:
                    metres(steps, self.images.step_m, ranges[row, 0])
                TALLY.lap(Stage.DELIVER)
            TALLY.end_sample()
        TALLY.count(Stage.SAMPLES, len(requests) - len(faults))
        TALLY.count(Stage.BATCHES)
        return faults


class Loader:
    """Iterates over batches, pass after pass; every pass is another epoch with another order and other draws.

    The first pass is the images' `epoch`; `images.set_epoch(n)` makes the next pass epoch n. Use one loader for all
    epochs: a new one starts at `images.epoch` and starts new workers. One pass runs at a time. A batch never changes
    while a reference to it is held, except in a fork of this process. Workers end with the loader, or after an error.
    From an address, a pass fetches ahead what it reads, in the order in which it is needed.

    order: assignment of samples to batches; see `BatchOrder`.
    """

    def __init__(self, images: ImageSet, order: BatchOrder, ledger: SkipLedger, options: LoaderOptions) -> None:
        self.images, self.order = images, order
        self._ledger, self._options = ledger, options
        self._workers = min(options.num_workers, len(order))
        self._prefetched = max(1, min(self._workers * options.prefetch_factor, len(order)))
        self._passes = 0
        self._state: _WorkerState | None = None
        self._tallied: list[Any] = [[0.0] * len(Stage)]
        """Rows of tallies besides those in the slots; the first is of this thread."""
        self._waited = self._taken = 0.0

    def __repr__(self) -> str:
        options = self._options
        return f"Loader({self.order!r}, num_workers={options.num_workers}, worker_method={options.worker_method!r})"

    def __len__(self) -> int:
        """Number of batches in a whole pass, the same for every rank."""
        return len(self.order)

    @property
    def epoch(self) -> int:
        """The epoch of the next pass."""
        return self.order.epoch

    @property
    def skipped(self) -> list[Skipped]:
        """Samples left out so far, in the order of their batches."""
        return self._ledger.skipped

    def stats(self) -> dict[str, float]:
        """Times and counts so far, name -> number, of all workers and passes together; at any time, from any thread.

        Seconds of workers: store (waiting for bytes), decode, artifacts, transform (with the label map), deliver (to
        metres, and hand-over). Other seconds: fetch (requests to a network), waited (by the loop, for batches).
        Counts: batches and samples made; bytes and requests fetched; hits and stalls, samples of a remote set whose
        bytes were at hand or had to be waited for; ready and in_flight, batches that are made or ordered now.
        """
        state = self._state
        rows = self._tallied if state is None else [*self._tallied, *state.slots.tallies()]
        found = dict(zip((each.name.lower() for each in Stage), np.sum(rows, axis=0).tolist(), strict=True))
        ready, in_flight = found["batches"] - self._taken, 0 if state is None else len(state.in_flight)
        return {**found, "waited": self._waited, "ready": max(0, ready), "in_flight": in_flight}

    def state_dict(self) -> dict[str, Any]:
        """Progress so far as plain JSON: epoch, position, skipped samples, and the identity of the images."""
        return {**self.order.state_dict(), "skipped": self._ledger.state()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Make the next pass continue after the last batch that `state` counts as delivered.

        Workers, world size and batch size may differ from the earlier run's. A state of other images raises BadConfig.
        """
        self.order.load_state_dict(state)
        self._ledger.load_state(state.get("skipped", []))

    def __iter__(self) -> Iterator[Batch]:
        plan = self.order.begin_pass()
        self._passes += 1
        this = self._passes
        ahead = LookAhead(plan.places(self.images), not self._workers or self._options.worker_method == "thread")
        try:
            state = self._idle_workers()
            ahead.start(images.reader.store for images in self.images.sets)
            self._tallied = [np.sum(self._tallied, axis=0), *ahead.rows]  # earlier passes are kept as one sum
            for number in range(min(self._prefetched, len(plan))):
                _submit(state, plan, number)
            for number in range(len(plan)):
                batch = self._deliver(state, plan, number)
                if number + self._prefetched < len(plan):
                    _submit(state, plan, number + self._prefetched)
                self.order.mark_delivered(number + 1)
                yield batch
                del batch  # otherwise its slot would stay lent while the next batch is waited for
                if self._passes != this:
                    raise BadConfig("a loader gives one pass at a time, and a newer one has begun: make another loader")
                if state.owner != os.getpid():
                    raise BadConfig("a pass goes on in the process that began it, not in a fork of it: begin another")
            self.order.end_pass()
        except GeneratorExit:
            raise  # the next pass discards the batches in flight
        except BaseException:
            ahead.close()  # before the workers, which might wait for it
            if self._passes == this and self._state is not None:
                self._end(self._state)
            raise
        finally:
            ahead.close()

    def _idle_workers(self) -> _WorkerState:
        """Return workers with no request pending, starting them if need be."""
        if self._state is None or self._state.owner != os.getpid():
            self._state = self._new_state()
        in_flight = self._state.in_flight
        try:
            while in_flight:  # requested by a pass that was left early
                self._state.workers.discard()
                self._state.slots.release(in_flight.popleft())
        except WorkerLost:  # with a batch that nobody will see
            self._end(self._state)
            self._state = self._new_state()
        self._taken = self.stats()["batches"]
        return self._state

    def _end(self, ending: _WorkerState) -> None:
        self._state = None  # before closing, which may be interrupted, too
        self._tallied.append(ending.slots.tallies().sum(0))
        ending.close()

    def _new_state(self) -> _WorkerState:
        options = self._options
        planes = self.images.planes.values()
        slots = Slots(self._prefetched, self.order.largest, *self.images.shape, options.metres, planes)
        maker = _BatchMaker(self.images, slots, options.metres, self._ledger.strict)
        workers: Workers
        if not self._workers:
            workers = InlineWorkers(maker)
        elif options.worker_method == "thread":
            workers = ThreadWorkers(maker, self._workers)
        else:
            use_compiled()  # which imports numba, here, for all processes that are forked
            workers = ProcessWorkers(maker, self._workers, options.start_method)
        return _WorkerState(workers, slots, weakref.finalize(self, workers.close), os.getpid())

    def _deliver(self, state: _WorkerState, plan: Pass, number: int) -> Batch:
        begun = time.perf_counter()
        faults: list[Fault] = state.workers.result()
        came = time.perf_counter()
        self._waited, self._taken = self._waited + came - begun, self._taken + 1
        slot = state.in_flight.popleft()
        requests = plan.batch(number)
        locations = [self.images.location(index) for _, index in requests]
        for index, error in faults:
            shard, key, offset = locations[index]
            self._ledger.add(Skipped(plan.epoch, key, shard, offset, str(error)), error)
        missing = {index for index, _ in faults}
        keys = [key for index, (_, key, _) in enumerate(locations) if index not in missing]
        made = [request for at, request in enumerate(requests) if at not in missing]
        pin = self._options.pin_memory and torch.cuda.is_available()
        ranges, labels, *planes = state.slots.lend(slot, len(keys), pin)
        batch: Batch = {
            "range": ranges,
            "labels": labels,
            "key": keys,
            "index": [index for _, index in made],
            "epoch": [epoch for epoch, _ in made],
        }
        if planes:
            batch["planes"] = dict(zip(self.images.planes, planes, strict=True))
        self._tallied[0][Stage.DELIVER] += time.perf_counter() - came
        return batch


def _submit(state: _WorkerState, plan: Pass, number: int) -> None:
    slot = state.slots.acquire()
    state.in_flight.append(slot)
    state.workers.submit((slot, plan.batch(number)))


def loader(
    images: ImageSet,
    batch_size: int,
    num_workers: int = 0,
    shuffle: Shuffle | None = None,
    drop_last: bool = False,
    *,
    rank: int | None = None,
    world_size: int | None = None,
    on_error: OnError = "stop",
    skip_budget: float | None = None,
    metres: bool = True,
    pin_memory: bool = False,
    prefetch_factor: int = 2,
    worker_method: WorkerMethod = DEFAULT_WORKER_METHOD,
    start_method: StartMethod | None = None,
) -> Loader:
    """Return a loader of batches of `images`; see `Batch`.

    images: `RangeImages` or a `Mixture`. num_workers: workers that make the batches; 0: the caller's thread does.
    shuffle: True for a permutation of all samples, "blocks" for one that reads few shards at a time
    (docs/how-to/remote.md); None is True with the train split, else False.
    drop_last: leave out the last batch if it is not full.

    rank, world_size: number of this process, and of all processes; each gets as many batches of `batch_size` as the
    others. None takes them from torch.distributed, then from torchrun's RANK and WORLD_SIZE.

    on_error: "stop" raises for a bad sample; "skip" leaves it out of its batch, which stays even if it becomes empty.
    skip_budget: the most samples that a pass of this rank may skip, as a number or as a share of the set (a float below
    1); `Loader.skipped` lists them.

    metres: False leaves ranges as uint16 in steps of `images.step_m`, half the bytes, for a GPU to convert.
    pin_memory: deliver in page-locked memory, if CUDA is available.
    prefetch_factor: batches that each worker makes in advance, as in PyTorch: `num_workers * prefetch_factor` in all.
    With `num_workers=0` none is; a batch is made when it is requested.
    worker_method: "thread" or "process". Threads call `images.write` at the same time.
    start_method: of worker processes, "fork", "spawn" or "forkserver"; None is Python's default.

    Raises BadConfig for an option out of its range.
    """
    if not isinstance(images, ImageSet):
        raise BadConfig(f"images must be RangeImages or a Mixture, found {type(images).__name__}")
    order = BatchOrder(images, batch_size, shuffle, drop_last, rank, world_size)
    ledger = SkipLedger(checked_budget(on_error, skip_budget, len(images)))
    flags = check_bool("metres", metres), check_bool("pin_memory", pin_memory)
    options = LoaderOptions(*flags, worker_method, start_method, num_workers, prefetch_factor)
    return Loader(images, order, ledger, options)
