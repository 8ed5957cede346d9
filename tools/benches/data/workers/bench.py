"""Worker threads beside worker processes: speed, processor time, memory and start.

Each loader runs in a process of its own, so that its memory is its own, and all stay open. Every round asks each of
them for one pass, one after the other, in a new order, so that other work on the machine affects all alike.
"""

from __future__ import annotations

import multiprocessing
import statistics
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from benches.data.loader.baselines import Premade
from benches.data.loader.bench import BATCH, ROUNDS, packed_set
from benches.data.loader.passes import checksum_of
from benches.data.loader.processes import processor_seconds
from benches.data.workers import subject
from benches.data.workers.memory import process_tree, tree_mb
from benches.data.workers.subject import Pass, Setup
from benches.measuring import counter
from bodyseg_data.artifacts import VariantName
from bodyseg_data.core import BadSample, ProgressCallback, silent
from bodyseg_data.loading import RangeImages

VARIANTS: Final[tuple[VariantName, ...]] = ("all", "none")
START_METHOD: Final = "spawn"  # of the processes that hold a loader each
_WAIT_S: Final = 0.01
_SEED: Final = 0


@dataclass
class Measured:
    """Measurements of one loader. rates: samples a second, one a round.

    seconds: of processor, workers included, and samples: of all rounds. opening_ms: to the first batch of all, starting
    the workers. peak_mb: the most memory of the process and its workers during a pass; see `tree_mb`.
    """

    rates: list[float] = field(default_factory=list)
    seconds: float = 0.0
    samples: int = 0
    opening_ms: float = 0.0
    peak_mb: float | None = None


def bench_workers(
    views: int = 540, num_workers: Sequence[int] = (0, 2, 4), progress: ProgressCallback = silent
) -> dict[str, Any]:
    """Speed, processor time, peak memory and start of loaders with each number of threads and of processes.

    views: samples in all, rounded up to whole bodies of the open set. docs/results/loading_speed.md says what the keys
    hold. Raises BadConfig if there are too few samples for so many workers.
    """
    with packed_set(views, num_workers) as packed:
        return measure(packed, num_workers, progress=progress)


def measure(
    packed: Path,
    num_workers: Sequence[int] = (0, 2, 4),
    batch: int = BATCH,
    rounds: int = ROUNDS,
    progress: ProgressCallback = silent,
) -> dict[str, Any]:
    """`bench_workers` on the set in `packed`."""
    setups = [setup for variant in VARIANTS for setup in _setups(variant, num_workers)]
    tick = counter(progress, len(setups) * (rounds + 2))
    found: dict[Setup, Measured] = {}
    for variant in VARIANTS:
        expected = {image.key: checksum_of(image) for image in Premade(RangeImages(packed, variant))}
        of_variant = [setup for setup in setups if setup.variant == variant]
        found |= _rounds(packed, of_variant, batch, rounds, expected, tick)
    return {
        "rows": [_row(setup, one) for setup, one in found.items()],
        "thread_over_process": _ratios(found),
        "samples": len(RangeImages(packed)),
        "batch": batch,
        "rounds": rounds,
    }


def _setups(variant: VariantName, num_workers: Sequence[int]) -> Iterator[Setup]:
    """Loaders without workers, with threads and with processes; of the latter those of Python 3.14's default, too."""
    for count in num_workers:
        yield Setup(variant, "thread", count)
        if count:
            yield Setup(variant, "process", count, "fork")
            yield Setup(variant, "process", count, "forkserver")


@contextmanager
def _started(target: Callable[..., None], *arguments: Any) -> Iterator[tuple[Any, int]]:
    """A process of its own that gets a pipe and the arguments; yields our end of the pipe, and its id."""
    context: Any = multiprocessing.get_context(START_METHOD)
    ours, theirs = context.Pipe()
    process = context.Process(target=target, args=(theirs, *arguments))
    process.start()
    theirs.close()
    try:
        yield ours, process.pid or 0
    finally:
        ours.close()
        process.join()


def _rounds(
    packed: Path,
    setups: Sequence[Setup],
    batch: int,
    rounds: int,
    expected: Mapping[str, int],
    tick: Callable[[], None],
) -> dict[Setup, Measured]:
    found = {setup: Measured() for setup in setups}
    with ExitStack() as stack:
        opened = {}
        for setup in setups:
            pipe, process = stack.enter_context(_started(subject.serve, packed, setup, batch))
            stack.callback(pipe.send, None)  # before the process is waited for
            opened[setup] = pipe, process
            found[setup].opening_ms, delivered = pipe.recv()
            if delivered != expected:
                raise BadSample(f"{setup.num_workers} workers ({setup.method}) deliver other images than were stored")
            tick()
        order = np.random.default_rng(_SEED)
        for _ in range(rounds):
            for number in order.permutation(len(setups)).tolist():
                pipe, process = opened[setups[number]]
                _measured_pass(pipe, process, len(expected), found[setups[number]])
                tick()
        for setup, (pipe, process) in opened.items():
            found[setup].peak_mb = _peak_mb(pipe, process)
            tick()
    return found


def _measured_pass(pipe: Any, process: int, samples: int, into: Measured) -> None:
    before = processor_seconds(process_tree(process))
    pipe.send("pass")
    one: Pass = pipe.recv()
    after = processor_seconds(process_tree(process))
    into.rates.append(one.samples / one.seconds)
    into.samples += samples
    into.seconds += (after or 0.0) - (before or 0.0)


def _peak_mb(pipe: Any, process: int) -> float | None:
    """The most memory seen during a pass that is not timed, since looking takes time."""
    pipe.send("pass")
    seen = [tree_mb(process)]
    while not pipe.poll(_WAIT_S):
        seen.append(tree_mb(process))
    pipe.recv()
    known = [mb for mb in seen if mb is not None]
    return round(max(known), 1) if known else None


def _row(setup: Setup, one: Measured) -> dict[str, Any]:
    return {
        "variant": setup.variant,
        "method": setup.method if setup.num_workers else "none",
        "workers": setup.num_workers,
        "samples_per_second": round(statistics.median(one.rates), 1),
        "processor_ms_per_sample": round(1e3 * one.seconds / one.samples, 3),
        "peak_mb": one.peak_mb,
        "opening_ms": round(one.opening_ms),
        "rounds_of": [round(rate, 1) for rate in one.rates],
    }


def _ratios(found: Mapping[Setup, Measured]) -> dict[str, dict[str, float]]:
    """Samples a second of threads over those of forked processes: medians of the rounds' ratios."""
    ratios: dict[str, dict[str, float]] = {}
    for setup, one in found.items():
        if setup.method == "thread" and setup.num_workers:
            other = found[Setup(setup.variant, "process", setup.num_workers, "fork")]
            each = [above / below for above, below in zip(one.rates, other.rates, strict=True)]
            ratios.setdefault(setup.variant, {})[str(setup.num_workers)] = round(statistics.median(each), 3)
    return ratios
