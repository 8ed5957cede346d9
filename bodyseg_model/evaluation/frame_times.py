"""Timing: of stages of a computation, and of a network for one frame, the paper's "processing time" (section 4.5)."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch

from bodyseg_data.core.errors import BadConfig
from bodyseg_model.networks.network import Network
from bodyseg_model.networks.registry import device_of, predict

_WARM_UP: Final = 3


@dataclass(frozen=True)
class FrameTimes:
    """Milliseconds for one frame. frames: number timed; threads: number torch may use; device: its name."""

    mean: float
    deviation: float
    median: float
    frames: int
    threads: int
    device: str


def time_frames(network: Network, frames: Sequence[torch.Tensor]) -> FrameTimes:
    """Time `predict` on single frames, float32 [1, 1, H, W] each, from a frame in memory to labels in memory.

    Loading, scoring and drawing are excluded; a few frames are predicted first, untimed. deviation: over frames,
    divisor n - 1, 0 for a single one. Raises BadConfig if there is no frame.
    """
    if not frames:
        raise BadConfig("timing a network needs at least one frame")
    device = device_of(network)

    def seconds(frame: torch.Tensor) -> float:
        start = time.perf_counter()
        predict(network, frame.to(device)).labels.cpu()  # on another device, this also waits for the labels
        return time.perf_counter() - start

    for number in range(_WARM_UP):
        seconds(frames[number % len(frames)])
    taken = np.array([1000 * seconds(frame) for frame in frames])
    deviation = float(taken.std(ddof=1)) if len(taken) > 1 else 0.0
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else "processor"
    return FrameTimes(
        float(taken.mean()), deviation, float(np.median(taken)), len(taken), torch.get_num_threads(), name
    )
