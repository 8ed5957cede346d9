"""Camera of an Azure Kinect's depth images, from the calibration in JSON that its recordings hold.

Its values are of the whole sensor, as shares of 1024 pixels; a mode shows a part of the sensor, or pairs of its pixels
(https://github.com/microsoft/Azure-Kinect-Sensor-SDK). Its lens has OpenCV's rational model: the radial factor is
(1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6). The five coefficients of `Distortion` are fitted to it
by least squares over the image.
"""

from __future__ import annotations

import json
import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig
from bodyseg_data.rigs import Distortion
from bodyseg_model.recordings.cameras import Intrinsics

CALIBRATION: Final = "calibration.json"
"""Name of the attachment."""

_LOCATION: Final = "CALIBRATION_CameraLocationD0"
_MODES: Final = {  # (rows, columns) of images: pixels across the whole sensor, first column, first row
    (288, 320): (512, 96, 90),
    (576, 640): (1024, 192, 180),
    (512, 512): (512, 0, 0),
    (1024, 1024): (1024, 0, 0),
}
_MOST_OFF_PX: Final = 1.0
_LATTICE: Final = 40

Floats = NDArray[np.float64]


def depth_camera(data: bytes, shape: tuple[int, int], where: str) -> Intrinsics | None:
    """Read the camera of depth images of `shape` (rows, columns) from a calibration's bytes.

    None for another calibration or size, and where the five coefficients are off by more than a pixel anywhere, as they
    are for the widest modes: the camera must then be given. where: name in messages.
    """
    if shape not in _MODES:
        return None
    across, column, row = _MODES[shape]
    try:
        cameras = json.loads(data.rstrip(b"\0"))["CalibrationInformation"]["Cameras"]
        found = next(camera["Intrinsics"]["ModelParameters"] for camera in cameras if camera["Location"] == _LOCATION)
        cx, cy, fx, fy, *radial, _, _, p2, p1 = (float(value) for value in found[:14])
        if len(radial) != 6 or not np.isfinite(found[:14]).all() or not min(fx, fy) > 0:
            return None
        cx, cy, fx, fy = cx * across - column - 0.5, cy * across - row - 0.5, fx * across, fy * across
        rows, columns = (np.linspace(0, side - 1, _LATTICE) for side in shape)
        x, y = np.meshgrid((columns - cx) / fx, (rows - cy) / fy)
        with np.errstate(all="ignore"):  # numbers beyond reason
            distortion, off = _fitted(x.ravel(), y.ravel(), radial, p1, p2)
        return Intrinsics(fx, fy, cx, cy, distortion, shape, where) if off * max(fx, fy) <= _MOST_OFF_PX else None
    except (ValueError, KeyError, TypeError, StopIteration, RecursionError, AttributeError, BadConfig):
        return None


def _fitted(x: Floats, y: Floats, radial: list[float], p1: float, p2: float) -> tuple[Distortion, float]:
    """Fit the five coefficients to the rational model at directions (x, y, 1); returns them and the largest error."""
    squared = x * x + y * y
    k1, k2, k3, k4, k5, k6 = radial
    upper = 1 + squared * (k1 + squared * (k2 + squared * k3))
    factor = upper / (1 + squared * (k4 + squared * (k5 + squared * k6)))
    powers = np.stack([squared, squared**2, squared**3], 1)
    # Weighted by the distance from the axis: an error of the factor moves a point in proportion to it.
    weight = np.sqrt(squared)
    if not (np.isfinite(factor).all() and np.isfinite(powers).all()):  # LAPACK would print lines of its own
        return Distortion(), math.inf
    fitted, *_ = np.linalg.lstsq(powers * weight[:, np.newaxis], (factor - 1) * weight, rcond=None)
    off = float(np.abs((1 + powers @ fitted - factor) * weight).max())
    return Distortion(float(fitted[0]), float(fitted[1]), p1, p2, float(fitted[2])), off
