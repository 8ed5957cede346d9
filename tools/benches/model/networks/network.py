"""`bench network`: how large, how quick and how accurate the networks are, measured in one run.

The images are in memory, on the device that computes, as in section 4.5 of the paper. docs/results/variants.md says how
to read the results.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from benches.model.chosen import parameters
from benches.model.networks.baselines import with_baselines
from benches.model.networks.network_frames import SENSOR_SIZE, body_rectangle, stretched, typical_frames
from benches.model.networks.network_times import Cell, Precision, Task, operations, timed
from bodyseg_data.core import BadConfig, MissingLibrary, ProgressCallback, silent
from bodyseg_data.files import read_json
from bodyseg_data.machine import processors
from bodyseg_model.networks import SHIPPED, Network, build, load_network
from bodyseg_model.networks.names import NETWORKS
from bodyseg_model.runtimes import on_backend

REFERENCE: Final = "compact"
FILLED: Final = "filled"
TYPICAL: Final = "typical"
SENSOR: Final = "sensor"

_TASKS: Final[tuple[Task, ...]] = ("scores", "labels")
_PRECISIONS: Final[tuple[Precision, ...]] = ("float32", "bfloat16")
_TOGETHER_ON_GPU: Final = (1, 16)


@dataclass(frozen=True)
class _Candidate:
    """kind: which of `NETWORKS`. run: the name of the folder or file its weights are from; None for new weights."""

    kind: str
    network: Network
    run: str | None


def bench_network(
    views: int = 12,
    runs: tuple[Path, ...] = (),
    scores: tuple[Path, ...] = (),
    progress: ProgressCallback = silent,
) -> dict[str, Any]:
    """Parameters, times and accuracy of every kind of network that is installed, fcn_alexnet at full width.

    Weights are those of the first of `runs` with such a network, else the shipped ones, else new; further runs are
    measured under their folders' names. views: how many typical frames to take turns with. scores: files of `bodyseg
    evaluate` on the test images of `all`, for accuracy_all.

    cpu_ms, gpu_ms: of `forward` on one frame of 640 x 329 pixels that a body fills, float32, all threads. Raises
    BadConfig for runs or scores that cannot be read or do not fit, MissingLibrary without Anny.
    """
    with with_baselines():
        candidates = _candidates([*NETWORKS], runs)
    accuracies = _accuracies(scores, candidates)
    typical = typical_frames(views)
    largest = max(typical, key=lambda frame: int((frame > 0).sum()))
    frames = {
        FILLED: [stretched(largest, *largest.shape)],
        TYPICAL: typical,
        SENSOR: [stretched(largest, *SENSOR_SIZE)],
    }
    networks = {name: on_backend(one.network) for name, one in candidates.items()}
    cells = _cells()
    times = []
    for done, cell in enumerate(cells, start=1):
        times.append(timed(cell, networks, frames[cell.frame], REFERENCE))
        progress(done, len(cells))
    return {
        "networks": {
            name: {
                "parameters": parameters(one.network),
                "cpu_ms": _headline(times, "cpu", name),
                "gpu_ms": _headline(times, "cuda", name),
                "accuracy_all": accuracies.get(name),
                "giga_operations": operations(one.network, frames[FILLED][0]),
                "weights": one.run,
            }
            for name, one in candidates.items()
        },
        "frames": {
            FILLED: {"rows": largest.shape[0], "columns": largest.shape[1], "count": 1},
            TYPICAL: {"rows": largest.shape[0], "columns": largest.shape[1], "count": views, **_boxes(typical)},
            SENSOR: {"rows": SENSOR_SIZE[0], "columns": SENSOR_SIZE[1], "count": 1},
        },
        "times": times,
        "reference": REFERENCE,
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "torch": torch.__version__,
    }


def _candidates(kinds: Sequence[str], runs: Sequence[Path]) -> dict[str, _Candidate]:
    given = [(path, load_network(path)) for path in runs]
    if SHIPPED.exists():
        given.append((SHIPPED, load_network(SHIPPED)))
    first: dict[str, _Candidate] = {}
    further: dict[str, _Candidate] = {}
    for path, trained in given:
        one = _Candidate(trained.card["network"], trained.network, path.name)
        if one.kind not in first:
            first[one.kind] = one
        elif path != SHIPPED:
            name = one.run or one.kind
            if name in further or name in kinds:
                raise BadConfig(f"further runs are called after their folders, found a second {name!r}: {path}")
            further[name] = one
    for kind in kinds:
        if kind not in first:
            try:
                first[kind] = _Candidate(kind, build(kind, seed=0).eval(), None)
            except MissingLibrary as error:
                sys.stderr.write(f"{kind} is left out: {error}\n")
    return {kind: first[kind] for kind in kinds if kind in first} | further


def _accuracies(files: Sequence[Path], candidates: dict[str, _Candidate]) -> dict[str, float]:
    """Name -> average per-class accuracy on the test images of `all`, from files of `bodyseg evaluate`."""
    found = {}
    for file in files:
        content = read_json(file)
        card = content.get("card")
        kind = card.get("network") if isinstance(card, dict) else None
        asked = {name: content.get(name) for name in ("variant", "split", "noise_mm", "missing")}
        if asked != {"variant": "all", "split": "test", "noise_mm": None, "missing": None} or kind is None:
            raise BadConfig(f"{file} must be what bodyseg evaluate found on the test images of all, found {asked}")
        run = content.get("run") or SHIPPED.name
        names = [name for name, one in candidates.items() if one.kind == kind and one.run in (run, None)]
        if not names:
            raise BadConfig(f"{file} has the scores of {run}, which is not among the networks measured")
        found[names[0]] = float(content["average_per_class_accuracy"])
    return found


def _cells() -> list[Cell]:
    """All cells that are timed, quick ones first."""
    threads = sorted({1, processors()})
    small = (FILLED, TYPICAL)
    cells = [
        Cell(frame, task, "cpu", count, precision)
        for frame in small
        for task in _TASKS
        for count in threads
        for precision in _PRECISIONS
    ]
    cells += [Cell(SENSOR, task, "cpu", threads[-1], precision) for task in _TASKS for precision in _PRECISIONS]
    if torch.cuda.is_available():
        cells += [
            Cell(frame, task, "cuda", threads[-1], precision, together)
            for frame in (*small, SENSOR)
            for task in _TASKS
            for precision in _PRECISIONS
            for together in (_TOGETHER_ON_GPU if frame != SENSOR else _TOGETHER_ON_GPU[:1])
        ]
    return cells


def _headline(times: Sequence[dict[str, Any]], device: str, name: str) -> float | None:
    for row in times:
        if (row["frame"], row["task"], row["device"], row["precision"]) == (FILLED, "scores", device, "float32") and (
            row["together"] == 1 and row["threads"] == processors()
        ):
            return float(row["networks"][name]["ms"])
    return None


def _boxes(frames: Sequence[NDArray[np.float32]]) -> dict[str, list[int]]:
    """Rows and columns of the body's rectangle: medians over the frames."""
    sizes = [body_rectangle(frame).shape for frame in frames]
    return {"median_body": [int(np.median([size[axis] for size in sizes])) for axis in (0, 1)]}
