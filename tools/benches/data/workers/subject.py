"""One loader in a process of its own, which `bench workers` starts and tells what to do over a pipe."""

from __future__ import annotations

import time
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

import torch

from benches.data.loader.passes import checksum
from bodyseg_data.artifacts import VariantName
from bodyseg_data.loading import Loader, RangeImages, WorkerMethod, loader
from bodyseg_data.loading.workers import StartMethod


@dataclass(frozen=True)
class Setup:
    """Options of a loader that is measured. start_method: of worker processes, None is Python's default."""

    variant: VariantName
    worker_method: WorkerMethod
    num_workers: int
    start_method: StartMethod | None = None

    @property
    def method(self) -> str:
        """Name of the kind of workers: process, thread, or the method by which processes start."""
        return self.start_method or self.worker_method


@dataclass(frozen=True)
class Pass:
    """One pass over the set. seconds: from the moment when each worker has delivered a batch to the last batch, which
    brings the pass to `samples` of them.
    """

    seconds: float
    samples: int


def serve(pipe: Connection, packed: Path, setup: Setup, batch: int) -> None:
    """Make a first pass and send what `_first_pass` gives; then a timed one for every request, until None."""
    torch.set_num_threads(1)
    images = RangeImages(packed, setup.variant)
    batches = loader(
        images,
        batch,
        setup.num_workers,
        shuffle=True,
        worker_method=setup.worker_method,
        start_method=setup.start_method,
    )
    pipe.send(_first_pass(batches))
    while pipe.recv() is not None:
        pipe.send(_timed_pass(batches, setup.num_workers))


def _first_pass(batches: Loader) -> tuple[float, dict[str, int]]:
    """Milliseconds until the first batch, which starts the workers, and key -> checksum of every image of the pass."""
    begin, start_ms = time.perf_counter(), 0.0
    found: dict[str, int] = {}
    for batch in batches:
        start_ms = start_ms or 1e3 * (time.perf_counter() - begin)
        arrays = zip(batch["key"], batch["range"].numpy(), batch["labels"].numpy(), strict=True)
        found |= {key: checksum(image, labels) for key, image, labels in arrays}
    return start_ms, found


def _timed_pass(batches: Loader, workers: int) -> Pass:
    start, timed = time.perf_counter(), 0
    for number, batch in enumerate(batches, start=1):
        if number == max(workers, 1):
            start = time.perf_counter()
        elif number > max(workers, 1):
            timed += len(batch["key"])
    return Pass(time.perf_counter() - start, timed)
