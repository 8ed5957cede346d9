"""`bench gpu`: loading into a GPU, times of networks on it, and training with it, measured in one run.

docs/results/loading_speed.md and docs/results/variants.md say how loaders and networks are timed on a processor.
"""

from __future__ import annotations

import itertools
import statistics
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from benches.measuring import counter
from benches.model.chosen import parameters
from benches.model.networks.network_frames import SENSOR_SIZE, stretched, typical_frames
from benches.model.networks.network_times import MOST_ROUNDS, Cell, Precision, Task, timed, wait_for
from bodyseg_data.core import BadConfig, ProgressCallback, silent
from bodyseg_data.loading import Batch, RangeImages, WorkerMethod, loader
from bodyseg_model.networks import SHIPPED, Network, build, load_network, predict
from bodyseg_model.training import Metrics, RunFolder, RunOptions, Training, recipe_for
from bodyseg_model.training.distributed import ProcessGroup

COMPACT: Final = "compact"
PAPERS: Final = "fcn_alexnet"
FILLED: Final = "filled"
SENSOR: Final = "sensor"

SAMPLES: Final = 2000
WORKERS: Final = (0, 8, 16)
STEPS: Final = 80
ROUNDS: Final = 3
"""Times that samples are loaded in each way, of which the median counts."""

_BATCH: Final = 20
_WINDOWS: Final = 4  # of a training; the first one warms up
_METHODS: Final[tuple[WorkerMethod, ...]] = ("thread", "process")
_TASKS: Final[tuple[Task, ...]] = ("scores", "labels")
_PRECISIONS: Final[tuple[Precision, ...]] = ("float32", "bfloat16")
_TOGETHER: Final = (1, 16)
_REAL_TIME: Final = 30.0
"""Frames a second of the paper's sensor."""


def bench_gpu(
    data: str,
    views: int = SAMPLES,
    num_workers: Sequence[int] = WORKERS,
    steps: int = STEPS,
    progress: ProgressCallback = silent,
) -> dict[str, Any]:
    """Samples a second into the GPU, milliseconds of `compact` and of the paper's network, and speed of their training.

    data: folder or address of a set, whose train split of `all` is loaded and trained on. views: samples of a pass.
    num_workers: of the loader. steps: of each training. Raises BadConfig without a GPU, or as `RangeImages`;
    MissingLibrary without Anny.
    """
    if not torch.cuda.is_available():
        raise BadConfig("bench gpu needs a GPU that PyTorch can use, found none: nothing was measured")
    largest = typical_frames(1)[0]
    frames = {FILLED: stretched(largest, *largest.shape), SENSOR: stretched(largest, *SENSOR_SIZE)}
    networks = {COMPACT: load_network(SHIPPED).network, PAPERS: build(PAPERS, seed=0).eval()}
    return {
        "gpu": torch.cuda.get_device_name(),
        "torch": torch.__version__,
        **measured(RangeImages(data, "all", "train"), networks, frames, "cuda", views, num_workers, steps, progress),
    }


def measured(
    images: RangeImages,
    networks: Mapping[str, Network],
    frames: Mapping[str, NDArray[np.float32]],
    device: str,
    samples: int,
    num_workers: Sequence[int],
    steps: int,
    progress: ProgressCallback = silent,
) -> dict[str, Any]:
    """All figures on any device. networks: by their kind, in evaluation mode. frames: `FILLED` and `SENSOR`, [H, W],
    metres.
    """
    on = torch.device(device)
    loads = [
        (workers, method, in_metres)
        for workers in num_workers
        for method in (_METHODS if workers else _METHODS[:1])
        for in_metres in (True, False)
    ]
    cells = _cells(device)
    total = len(loads) + len(cells) + len(networks) * (len(_PRECISIONS) + len(num_workers))
    advance = counter(progress, total)
    found: dict[str, Any] = {"device": device, "batch_size": _BATCH, "loading": [], "times": [], "training": []}
    for workers, method, in_metres in loads:
        rates = [loading_rate(images, on, workers, method, in_metres, samples) for _ in range(ROUNDS)]
        kind = {"workers": workers, "method": method if workers else None, "ranges": "metres" if in_metres else "steps"}
        found["loading"].append(kind | {"samples_per_second": round(statistics.median(rates), 1)})
        advance()
    for cell in cells:
        found["times"].append(timed(cell, networks, [frames[cell.frame]], COMPACT))
        advance()
    found["full_resolution"] = {name: {} for name in networks}
    for name, precision in itertools.product(networks, _PRECISIONS):
        found["full_resolution"][name][precision] = real_time(networks[name], frames[SENSOR], on, precision)
        advance()
    for name, workers in itertools.product(networks, num_workers):
        speed = training_speed(images, networks[name], name, on, workers, steps)
        found["training"].append({"network": name, "workers": workers, **speed})
        advance()
    return found | {
        "networks": {name: parameters(network) for name, network in networks.items()},
        "frames": {name: list(frame.shape) for name, frame in frames.items()},
        "samples": samples,
        "steps": steps,
    }


def loading_rate(
    images: RangeImages, device: torch.device, workers: int, method: WorkerMethod, in_metres: bool, samples: int
) -> float:
    """Samples a second that reach the device, once each worker has delivered a batch: passes over `images`, shuffled.

    in_metres: ranges are float32 metres; otherwise uint16 steps, half the bytes, which the device makes metres of.
    """
    pin = device.type == "cuda"
    data_loader = loader(images, _BATCH, workers, shuffle=True, metres=in_metres, pin_memory=pin, worker_method=method)
    batches: Iterator[Batch] = itertools.chain.from_iterable(itertools.repeat(data_loader))
    done, start = 0, 0.0
    for number, batch in enumerate(batches, start=1):
        ranges = batch["range"].to(device, non_blocking=True)
        batch["labels"].to(device, non_blocking=True)
        if not in_metres:
            ranges.to(torch.float32).mul_(images.step_m)
        if number == max(workers, 1):
            wait_for(device)
            start = time.perf_counter()
        elif number > max(workers, 1):
            done += len(batch["key"])
        if done >= samples:
            break
    wait_for(device)
    return done / (time.perf_counter() - start)


def real_time(
    network: Network, frame: NDArray[np.float32], device: torch.device, precision: Precision
) -> dict[str, Any]:
    """Milliseconds from a frame [H, W] in the processor's memory to its labels there, and whether 95 of 100 frames take
    no longer than 30 a second allow.
    """
    range_m = torch.from_numpy(frame)[None, None]
    range_m = range_m.pin_memory() if device.type == "cuda" else range_m
    taken = []
    with torch.autocast(device.type, torch.bfloat16, enabled=precision == "bfloat16"):
        for number in range(MOST_ROUNDS + 2):
            start = time.perf_counter()
            predict(network, range_m.to(device, non_blocking=True)).labels.cpu()
            if number >= 2:  # the first ones choose algorithms
                taken.append(1e3 * (time.perf_counter() - start))
    median, most = np.percentile(taken, (50, 95)).tolist()
    return {
        "ms": round(median, 3),
        "p95_ms": round(most, 3),
        "frames_per_second": round(1e3 / median, 2),
        "holds_30": bool(most <= 1e3 / _REAL_TIME),
    }


def training_speed(
    images: RangeImages, network: Network, name: str, device: torch.device, workers: int, steps: int
) -> dict[str, Any]:
    """Images a second of a training by its kind's recipe, and the share of its time that waits for data.

    Medians over the windows of a quarter of the steps, without the first. The network is trained in place. The loss
    has no weights of parts, which cost a pass over the set and no time in a step.
    """
    said: list[Metrics] = []
    recipe = recipe_for(name, steps=steps, balance=0.0)
    options = RunOptions(log_every=steps // _WINDOWS, checkpoint_every=steps, num_workers=workers)
    with TemporaryDirectory(prefix="bodyseg-gpu-") as folder:
        Training(
            network, name, images, recipe, RunFolder(Path(folder) / "run"), ProcessGroup(0, 1, device), 0, options
        ).run(False, said.append, {})
    later = said[1:]
    rate, waited = (
        statistics.median(values)
        for values in ([each.images_per_second for each in later], [each.data_wait for each in later])
    )
    sys.stderr.write(f"{name}, {workers} workers: {rate:g} images a second, {waited:.1%} of the time waiting\n")
    return {
        "images_per_second": rate,
        "data_wait": waited,
        "batch_size": recipe.batch_size * recipe.accumulate,
        "bf16": recipe.bf16,
    }


def _cells(device: str) -> list[Cell]:
    return [
        Cell(frame, task, device, torch.get_num_threads(), precision, together)
        for frame in (FILLED, SENSOR)
        for task in _TASKS
        for precision in _PRECISIONS
        for together in (_TOGETHER if frame == FILLED else _TOGETHER[:1])
    ]
