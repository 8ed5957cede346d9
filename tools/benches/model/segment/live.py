"""Frames of a live sensor: how old a frame is when its labels are there, one by one and two at a time."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from bodyseg_data.machine import torch_threads
from bodyseg_data.rigs import Camera
from bodyseg_model.segmentation import FrameLabeller

RATE: Final = 30.0
"""Frames a second of the sensor, as most range sensors give."""

_ROUNDS: Final = 2


class Sensor:
    """Yields `count` frames, each the newest that there is when it is asked for, and none twice.

    frames: float32 [H, W] each, again from the first after the last. came: of each frame that was yielded, the time at
    which the sensor had it, seconds of `time.perf_counter`.
    """

    def __init__(self, frames: Sequence[NDArray[np.float32]], count: int, rate: float = RATE) -> None:
        self._frames, self._count, self._rate = frames, count, rate
        self.came: list[float] = []

    def __iter__(self) -> Iterator[NDArray[np.float32]]:
        start, last = time.perf_counter(), -1
        for number in range(self._count):
            newest = int((time.perf_counter() - start) * self._rate)
            if newest == last:
                newest += 1
                time.sleep(max(0.0, start + newest / self._rate - time.perf_counter()))
            last = newest
            self.came.append(start + newest / self._rate)
            yield self._frames[number % len(self._frames)]


def live(labeller: FrameLabeller, camera: Camera, frames: Sequence[NDArray[np.float32]]) -> dict[str, Any]:
    """Age of frames when their labels are there, ms, and frames a second, one by one and two at a time, in turns.

    Every frame is shown `_ROUNDS` times each way; the first of each round is left out. One by one, a frame has all of
    PyTorch's threads; of two, each has half of them.
    """
    threads = torch.get_num_threads()
    ages: dict[int, list[float]] = {1: [], 2: []}
    seconds = {1: 0.0, 2: 0.0}
    for _ in range(_ROUNDS):
        for at_once in ages:
            sensor = Sensor(frames, len(frames) + 1)
            with torch_threads(max(1, threads // at_once)):
                stream = labeller.stream(sensor, camera, at_once)
                next(stream)
                start = time.perf_counter()
                for number, _answer in enumerate(stream, 1):
                    ages[at_once].append(time.perf_counter() - sensor.came[number])
                seconds[at_once] += time.perf_counter() - start
    return {
        "sensor_rate": RATE,
        **{
            name: {
                "frames_per_second": round(len(ages[at_once]) / seconds[at_once], 2),
                "p50_ms": round(1000 * float(np.median(ages[at_once])), 1),
                "p95_ms": round(1000 * float(np.quantile(ages[at_once], 0.95)), 1),
            }
            for name, at_once in (("one by one", 1), ("two at once", 2))
        },
    }
