"""Frames without lens distortion, by a map from pixels to pixels that is computed once a camera."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.rig import Camera


class Undistortion:
    """Maps frames of a camera with lens distortion to the frames that it would take without.

    A pixel gets the value of the frame's pixel that contains the point where the lens draws its centre, 0 where that
    lies outside the frame. Values are never interpolated: between a body and the wall behind it there is no surface.
    A range along the optical axis is the same in both frames.

    camera: the camera without distortion, of equal size, focal length and principal point. Raises BadConfig for a
    camera that has no distortion.
    """

    def __init__(self, camera: Camera) -> None:
        if camera.distortion is None:
            raise BadConfig("frames of a camera without lens distortion need no undistortion")
        self.camera = replace(camera, distortion=None)
        x, y, _ = np.moveaxis(self.camera.pixel_rays(), -1, 0)
        across, down = camera.distortion.apply(x, y)
        column = np.floor(across * camera.focal_px + camera.centre_px[0])
        row = np.floor(down * camera.focal_px + camera.centre_px[1])
        inside = (row >= 0) & (row < camera.rows) & (column >= 0) & (column < camera.columns)
        self._outside = np.flatnonzero(~inside)
        self._source = np.where(inside, row * camera.columns + column, 0).astype(np.intp)

    def __call__(self, frame: NDArray[Any]) -> NDArray[Any]:
        """The frame [H, W], of any dtype, without distortion. Raises BadConfig for a frame of another size."""
        if frame.shape != self._source.shape:
            rows, columns = self._source.shape
            raise BadConfig(
                f"a frame must have the camera's size, {rows} x {columns}, found {' x '.join(map(str, frame.shape))}"
            )
        ideal = frame.ravel().take(self._source)
        ideal.ravel()[self._outside] = 0
        return ideal
