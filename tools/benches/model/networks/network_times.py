"""Networks timed side by side, in turn, on the same images.

In every turn a network first runs untimed for `WARM_S`: the one before it has filled the processor's caches with its
own weights, of which FCN-AlexNet has 230 MB, and its threads still wait busily; a sensor's frames meet one network.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.flop_counter import FlopCounterMode

from benches.model.networks.network_frames import as_batch, body_rectangle
from bodyseg_data.machine import torch_threads
from bodyseg_model.networks import Network, device_of, predict

Task = Literal["scores", "labels"]
Precision = Literal["float32", "bfloat16"]

WARM_S: Final = 0.05
"""Seconds of every turn, at least, for which a network runs before it is timed."""

LEAST_ROUNDS: Final = 5
MOST_ROUNDS: Final = 25
BUDGET_S: Final = 20.0


@dataclass(frozen=True)
class Cell:
    """A cell of the table of times. frame: kind of image. task: "scores" is `forward` on the body's rectangle,
    "labels" all of `predict` on the whole image. threads: of the processor. together: images in a batch.
    """

    frame: str
    task: Task
    device: str
    threads: int
    precision: Precision
    together: int = 1


def time_cell(
    cell: Cell,
    networks: Mapping[str, Network],
    batches: Sequence[torch.Tensor],
    rounds: int,
    budget_s: float,
) -> dict[str, list[float]]:
    """Milliseconds of every round, network by network; they must be in evaluation mode and on the cell's device.

    batches: float32 [B, 1, H, W], there as well; rounds take them in turn. There are `rounds` of them, or fewer, but
    at least `LEAST_ROUNDS`, once they have taken `budget_s`.
    """
    found: dict[str, list[float]] = {name: [] for name in networks}
    device = torch.device(cell.device)
    names = list(networks)
    # Layers' weights are rounded once: autocast forgets the rounded ones where its context ends.
    with torch_threads(cell.threads), torch.autocast(device.type, torch.bfloat16, enabled=cell.precision == "bfloat16"):
        start = time.perf_counter()
        for number in range(rounds):
            if number >= LEAST_ROUNDS and time.perf_counter() - start > budget_s:
                break
            for turn in range(len(names)):
                name = names[(number + turn) % len(names)]
                job = _job(cell.task, networks[name], batches[number % len(batches)])
                warm_up(job)
                found[name].append(_milliseconds(job, device))
    return found


def summary(taken: Mapping[str, Sequence[float]], reference: str) -> dict[str, Any]:
    """Median and quartiles of each network's milliseconds, and how many times as long as `reference` it took.

    times_as_long: median of the rounds' quotients, since what else the machine does slows neighbours alike.
    """
    rows = {}
    for name, values in taken.items():
        low, median, high = np.percentile(values, (25, 50, 75)).tolist()
        ratios = [value / other for value, other in zip(values, taken[reference], strict=True)]
        rows[name] = {
            "ms": round(median, 3),
            "quartiles": [round(low, 3), round(high, 3)],
            "rounds": len(values),
            "times_as_long": round(statistics.median(ratios), 3),
        }
    return rows


def timed(
    cell: Cell, networks: Mapping[str, Network], frames: Sequence[NDArray[np.float32]], reference: str
) -> dict[str, Any]:
    """A row of the table of times: the cell's facts, and `summary` of the networks on frames [H, W], metres."""
    device = torch.device(cell.device)
    shown = [body_rectangle(frame) for frame in frames] if cell.task == "scores" else frames
    batches = [as_batch(frame, cell.together, device) for frame in shown]
    placed = {name: network.to(device) for name, network in networks.items()}
    rows = summary(time_cell(cell, placed, batches, MOST_ROUNDS, BUDGET_S), reference)
    for row in rows.values():
        row["frames_per_second"] = round(1e3 * cell.together / row["ms"], 2)
    return {**asdict(cell), "networks": rows}


def _job(task: Task, network: Network, batch: torch.Tensor) -> Callable[[], Any]:
    if task == "labels":
        return lambda: predict(network, batch)

    def scores() -> torch.Tensor:
        with torch.inference_mode():
            answer: torch.Tensor = network(batch)
            return answer

    return scores


def warm_up(job: Callable[[], Any]) -> None:
    """Do a job again and again for `WARM_S`, at least once."""
    start = time.perf_counter()
    job()
    while time.perf_counter() - start < WARM_S:
        job()


def _milliseconds(job: Callable[[], Any], device: torch.device) -> float:
    """Time until the result is there."""
    wait_for(device)
    start = time.perf_counter()
    answer = job()
    wait_for(device)
    taken = 1e3 * (time.perf_counter() - start)
    del answer  # freeing it is not part of the job
    return taken


def wait_for(device: torch.device) -> None:
    """Wait until a device has computed what it was asked for; only a GPU computes asynchronously."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def operations(network: Network, frame: NDArray[np.float32]) -> float:
    """Multiplications and additions of `forward` on a frame [H, W], in thousand millions."""
    with torch.inference_mode(), FlopCounterMode(display=False) as counter:
        network(as_batch(frame, 1, device_of(network)))
    return float(round(counter.get_total_flops() / 1e9, 6))
