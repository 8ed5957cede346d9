"""Frames as they come, from any Python iterable."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bodyseg_model.recordings.cameras import Intrinsics
from bodyseg_model.recordings.recording import FLOAT_STEP_M, MILLIMETRE, ArrayFrames, Frame

Timed = NDArray[Any] | tuple[float | None, NDArray[Any]]
"""Pixels of a frame [H, W], or its time in seconds and its pixels."""


@dataclass(frozen=True, eq=False)
class LiveRecording:
    """A recording of arrays that `arrays` yields: uint16 in steps of `step_m` metres, or floating point in metres.

    Nothing is kept: a frame lives as long as its caller holds it. where: name in messages and of frames.
    """

    arrays: Iterable[Timed]
    camera: Intrinsics | None = None
    step_m: float = MILLIMETRE
    where: str = "live"

    def __iter__(self) -> Iterator[Frame]:
        for index, item in enumerate(self.arrays):
            time_s, pixels = item if isinstance(item, tuple) else (None, item)
            step_m = FLOAT_STEP_M if pixels.dtype.kind == "f" else self.step_m
            name = f"{self.where}-{index:06d}"
            held, within = ArrayFrames(pixels[np.newaxis]), ("", index)
            yield Frame(name, name, Path(self.where), str(index), held, within, 0, time_s, step_m, self.camera)
