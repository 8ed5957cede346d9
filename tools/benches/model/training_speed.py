"""`bench training`: images a second of `bodyseg train` on the processor, by threads, processes and form of its loops.

The command runs as its users call it, all ways in turns. docs/how-to/training.md has the results.
"""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

from benches.environment import child_environment
from bodyseg_data.core import BadConfig, ProgressCallback, silent
from bodyseg_data.machine import processors
from bodyseg_data.machine.kernels import VARIABLE

STEPS: Final = 60
ROUNDS: Final = 3
"""Trainings of each way, of which the median counts."""

_WINDOWS: Final = 4  # of a training; the first one warms up
_BATCH: Final = 16  # images of a process in a step: the recipe's


@dataclass(frozen=True)
class Way:
    """One way to train. processes: of torchrun, or 1 without it. threads: of each. loops: for BODYSEG_KERNELS."""

    processes: int
    threads: int
    loops: str = "auto"

    def command(self, data: str, steps: int, out: Path) -> list[str]:
        """The training's command line, after the interpreter."""
        words = [
            "bodyseg_model",
            "train",
            "--data",
            data,
            "--variant",
            "all",
            "--network",
            "compact",
            "--device",
            "cpu",
        ]
        words += ["--steps", str(steps), "--batch-size", str(_BATCH * self.processes), "--threads", str(self.threads)]
        words += ["--num-workers", "1", "--log-every", str(steps // _WINDOWS), "--out", str(out)]
        several = ["torch.distributed.run", f"--nproc-per-node={self.processes}", "-m"] if self.processes > 1 else []
        return ["-m", *several, *words]


def ways(cores: int) -> dict[str, Way]:
    """Name -> way for a machine of so many processors, the default first."""
    found = {
        "default": Way(1, cores),
        "without numba": Way(1, cores, "numpy"),
        "one thread": Way(1, 1),
        "one thread, without numba": Way(1, 1, "numpy"),
    }
    return found | ({"a process each": Way(cores, 1)} if cores > 1 else {})


def bench_training(data: str, steps: int = STEPS, progress: ProgressCallback = silent) -> dict[str, Any]:
    """Images a second of every way, and the share of its time that a training waits for data.

    data: folder or address of a set, whose train split is trained on. steps: of each training. Raises BadConfig for too
    few steps, or a training that fails.
    """
    named = ways(processors())
    runs: dict[str, list[Mapping[str, float]]] = {name: [] for name in named}
    with TemporaryDirectory(prefix="bodyseg-training-") as folder:
        for number in range(ROUNDS * len(named)):
            name = [*named][number % len(named)]
            runs[name].append(_trained(named[name], data, steps, Path(folder) / str(number)))
            progress(number + 1, ROUNDS * len(named))
    return {
        "steps": steps,
        "images_a_process": _BATCH,
        **summary(named, runs),
    }


def summary(named: Mapping[str, Way], runs: Mapping[str, Sequence[Mapping[str, float]]]) -> dict[str, Any]:
    """The median of each way's trainings, and how many times as fast as the first way it is."""
    rates = {name: statistics.median(run["images_per_second"] for run in several) for name, several in runs.items()}
    default = rates[next(iter(named))]
    return {
        "ways": {
            name: {
                "processes": way.processes,
                "threads": way.threads,
                "loops": way.loops,
                "images_per_second": round(rates[name], 1),
                "all": [round(run["images_per_second"], 1) for run in runs[name]],
                "times_as_fast": round(rates[name] / default, 2),
                "data_wait": round(statistics.median(run["data_wait"] for run in runs[name]), 3),
            }
            for name, way in named.items()
        }
    }


def _trained(way: Way, data: str, steps: int, out: Path) -> dict[str, float]:
    """Medians over the windows of a quarter of a training's steps, without the first."""
    environment = child_environment() | {VARIABLE: way.loops, "OMP_NUM_THREADS": str(way.threads)}
    done = subprocess.run(
        [sys.executable, *way.command(data, steps, out)], env=environment, capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise BadConfig(f"a training failed: {done.stderr.strip().splitlines()[-1]}")
    later = [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()][1:]
    return {name: statistics.median(line[name] for line in later) for name in ("images_per_second", "data_wait")}
