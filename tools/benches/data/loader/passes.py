"""Passes of `bench loader`: every loader is opened, checked by a first pass, and run over their set again and again."""

from __future__ import annotations

import gc
import statistics
import time
import zlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from multiprocessing import active_children
from typing import Any, Final

import numpy as np

from benches.data.loader.baselines import STEP_M
from benches.data.loader.processes import private_mb, processor_seconds
from bodyseg_data.artifacts import RangeImage
from bodyseg_data.core import BadSample
from bodyseg_data.loading import Batch

_SEED: Final = 0

Opening = Callable[[], Iterable[Batch]]


@dataclass
class Passes:
    """Measurements of one loader. rates: samples a second, one a round. seconds: of processor, workers included,
    and samples: in all rounds together; seconds is None where the system does not provide it. worker_mb: `private_mb`.
    """

    rates: list[float] = field(default_factory=list)
    seconds: float | None = 0.0
    samples: int = 0
    worker_mb: float | None = None

    def samples_per_second(self) -> float:
        """The median of the rounds."""
        return round(statistics.median(self.rates), 1)

    def processor_ms_per_sample(self) -> float | None:
        """Milliseconds of processor for a sample."""
        return None if self.seconds is None else round(self.seconds / self.samples * 1e3, 4)


@dataclass
class _Open:
    batches: Iterable[Batch]
    processes: list[int]


def checksum(range_m: Any, labels: Any) -> int:
    """CRC-32 of one image's contiguous arrays, float32 metres and uint8 labels."""
    return zlib.crc32(labels, zlib.crc32(range_m))


def checksum_of(image: RangeImage) -> int:
    """CRC-32 of the arrays that a loader must deliver for `image`."""
    return checksum(image.range.astype(np.float32) * np.float32(STEP_M), image.labels)


def run_rounds(
    loaders: Mapping[str, Opening],
    workers: int,
    rounds: int,
    expected: Mapping[str, Mapping[str, int]],
    tick: Callable[[], None],
) -> dict[str, Passes]:
    """Open every loader, check its first pass, and run all of them `rounds` times, in a new order each time.

    loaders: name -> what opens it with `workers` worker processes. expected: name -> key -> `checksum_of` the image.
    Raises BadSample if a loader delivers anything else.
    """
    opened: dict[str, _Open] = {}
    for name, opens in loaders.items():
        others = {child.pid for child in active_children()}
        batches = opens()
        _check(name, batches, expected[name])
        opened[name] = _Open(batches, [c.pid for c in active_children() if c.pid not in others and c.pid is not None])
        tick()
    found = {name: Passes() for name in loaders}
    order = np.random.default_rng(_SEED)
    for _ in range(rounds):
        for name in order.permutation(list(loaders)).tolist():
            _run(opened[name], workers, found[name])
            tick()
    for name, one in opened.items():
        found[name].worker_mb = private_mb(one.processes)
    opened.clear()  # ends the workers
    gc.collect()
    return found


def _check(name: str, batches: Iterable[Batch], expected: Mapping[str, int]) -> None:
    """One pass, which must give exactly the expected images; the first batch is kept and must stay what it was."""
    seen: set[str] = set()
    first: Batch | None = None
    for batch in batches:
        first = batch if first is None else first
        _check_images(f"{name} delivers", batch, expected)
        for key in batch["key"]:
            if key in seen:
                raise BadSample(f"{name} delivers {key} twice in a pass")
            seen.add(key)
    if len(seen) != len(expected):
        raise BadSample(f"{name} delivers {len(seen)} of {len(expected)} samples in a pass")
    if first is not None:
        _check_images(f"{name} has overwritten a batch that is in use:", first, expected)


def _check_images(what: str, batch: Batch, expected: Mapping[str, int]) -> None:
    for key, image, labels in zip(batch["key"], batch["range"].numpy(), batch["labels"].numpy(), strict=True):
        if image.shape[0] != 1 or image.dtype != np.float32 or checksum(image, labels) != expected.get(key):
            raise BadSample(f"{what} {key}: {image.dtype} {image.shape} that is not what was stored")


def _run(one: _Open, workers: int, found: Passes) -> None:
    """One pass. The clock starts when each worker has delivered a batch."""
    before, main = processor_seconds(one.processes), time.process_time()
    count, timed, start = 0, 0, 0.0
    for number, batch in enumerate(one.batches, start=1):
        size = len(batch["key"])
        count += size
        if number > max(workers, 1):
            timed += size
        elif number == max(workers, 1):
            start = time.perf_counter()
    found.rates.append(timed / (time.perf_counter() - start))
    found.samples += count
    after, main = processor_seconds(one.processes), time.process_time() - main
    if found.seconds is not None:
        found.seconds = None if before is None or after is None else found.seconds + main + after - before
