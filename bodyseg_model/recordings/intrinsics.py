"""Camera matrix and lens distortion of frames, in OpenCV's terms."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.rig import Camera
from bodyseg_data.core.rigs.distortion import Distortion
from bodyseg_model.recordings.cameras import FrameCamera

_SQUARE: Final = 0.01


@dataclass(frozen=True)
class Intrinsics:
    """Camera matrix and lens distortion of a frame as OpenCV gives them: pixels, pixel centres at whole numbers.

    size: (rows, columns) of the frame, None if the file does not say. where: the file, for messages. Raises BadConfig
    for focal lengths that differ by more than 1 %, which square pixels do not have.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: Distortion | None
    size: tuple[int, int] | None
    where: str

    def __post_init__(self) -> None:
        if abs(self.fx / self.fy - 1) > _SQUARE:
            raise BadConfig(f"{self.where}: pixels must be square, found 'fx' {self.fx:g} and 'fy' {self.fy:g}")

    def frame_camera(self, shape: tuple[int, int]) -> FrameCamera:
        """The camera of a frame of `shape` (rows, columns). Raises BadConfig for another size than the file's."""
        if self.size is not None and self.size != shape:
            expected, found = (" x ".join(map(str, size)) for size in (self.size, shape))
            raise BadConfig(f"{self.where}: the frame must have {expected} pixels, found {found}")
        centre, pose = (self.cx + 0.5, self.cy + 0.5), ((0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
        try:
            camera = Camera(*shape, math.sqrt(self.fx * self.fy), centre, *pose, distortion=self.distortion)
        except BadConfig as error:
            raise BadConfig(f"{self.where}: {error}") from None
        return FrameCamera(camera, f"file {self.where}")
