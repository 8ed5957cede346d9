"""Camera of an Azure Kinect's depth images, from the calibration in JSON that its recordings hold.

Its values are of the whole sensor, as shares of 1024 pixels; a mode shows a part of the sensor, or pairs of its pixels
(https://github.com/microsoft/Azure-Kinect-Sensor-SDK). Its lens has OpenCV's rational model: the radial factor is
(1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6), to which `driver_camera` fits five coefficients.
"""

import json
from typing import Final

import numpy as np

from bodyseg_data.core import BadConfig
from bodyseg_model.recordings.cameras import Intrinsics
from bodyseg_model.recordings.lenses import driver_camera

CALIBRATION: Final = "calibration.json"
"""Name of the attachment."""

_LOCATION: Final = "CALIBRATION_CameraLocationD0"
_MODES: Final = {  # (rows, columns) of images: pixels across the whole sensor, first column, first row
    (288, 320): (512, 96, 90),
    (576, 640): (1024, 192, 180),
    (512, 512): (512, 0, 0),
    (1024, 1024): (1024, 0, 0),
}


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
        k1, k2, k3, *lower = radial
        return driver_camera("rational_polynomial", (k1, k2, p1, p2, k3, *lower), (fx, fy, cx, cy), shape, where)
    except (ValueError, KeyError, TypeError, StopIteration, RecursionError, AttributeError, BadConfig):
        return None
