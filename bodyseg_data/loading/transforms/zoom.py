"""Zoom: the camera moved along its optical axis, or its focal length changed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import check_bool
from bodyseg_data.core.randomness import unit
from bodyseg_data.core.sample import FARTHEST_STEPS
from bodyseg_data.loading.transforms.camera_image import CameraImage
from bodyseg_data.loading.transforms.checks import check_number
from bodyseg_data.loading.transforms.resampling import take_grid
from bodyseg_data.loading.transforms.transform import Transform

_FARTHEST: Final = int(FARTHEST_STEPS)


@dataclass(frozen=True)
class Zoom(Transform):
    """The image magnified about the optical axis; pixels take the value of the nearest one.

    largest: largest magnification, 1 to 4; it is drawn from 1 / largest to largest, its logarithm uniformly.

    moves_camera: True moves the camera along its axis to or from a body at distance d: magnification m takes it to
    d / m, and every range changes by d / m - d, rounded to steps, so that the body keeps its size and its depth. The
    whole image is magnified as the body's centre is, which leaves out that nearer parts grow more: a point p metres in
    front of the centre would grow by (d - p) / (d / m - p) instead of m. d is that of the view, so all variants of a
    sample get the same. False changes the focal length: ranges stay, and the magnification is exact.

    Noise and lost pixels are magnified with the image, not drawn for the new distance. Raises BadConfig for a
    magnification out of range.
    """

    name = "zoom"
    largest: float = 1.25
    moves_camera: bool = True

    def __post_init__(self) -> None:
        check_number(self.name, "largest", self.largest, 1, 4)
        moves_camera = check_bool("transform 'zoom': moves_camera", self.moves_camera)
        object.__setattr__(self, "moves_camera", moves_camera)  # NumPy's bool is no JSON

    def __call__(self, image: CameraImage, random: np.random.Generator) -> CameraImage:
        """See `Transform`."""
        return magnified(image, self.largest ** (2 * unit(random) - 1), self.moves_camera)


def magnified(image: CameraImage, by: float, moves_camera: bool) -> CameraImage:
    """The image magnified about the optical axis, by a camera that moves or by its focal length; see `Zoom`."""
    (height, width), (x, y) = image.range.shape, image.centre_px
    rows, columns = (np.arange(height) + 0.5 - y) / by + y, (np.arange(width) + 0.5 - x) / by + x
    if not moves_camera:
        return take_grid(image, rows, columns, focal_px=image.focal_px * by)
    found = take_grid(image, rows, columns)
    distance_m = image.info.distance_cm / 100
    return replace(found, range=_farther(found.range, round((distance_m / by - distance_m) / image.step_m)))


def _farther(ranges: NDArray[np.uint16], steps: int) -> NDArray[np.uint16]:
    """Ranges with `steps` added, which may be negative; 0 stays 0, and so becomes what 16 bits do not hold."""
    change = min(abs(steps), _FARTHEST)
    moved: NDArray[np.uint16] = ranges + np.uint16(change) if steps > 0 else ranges - np.uint16(change)
    moved *= (ranges != 0) & (ranges <= _FARTHEST - change if steps > 0 else ranges > change)
    return moved
