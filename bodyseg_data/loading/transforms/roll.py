"""Roll: the camera turned about its optical axis."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from bodyseg_data.core.randomness import unit
from bodyseg_data.loading.transforms.camera_image import CameraImage
from bodyseg_data.loading.transforms.checks import check_number
from bodyseg_data.loading.transforms.resampling import take_turned
from bodyseg_data.loading.transforms.transform import Transform


@dataclass(frozen=True)
class Roll(Transform):
    """The image as the camera takes it turned about its optical axis; what leaves the image is lost.

    largest_deg: largest angle either way, degrees, 0 to 180; the angle is drawn uniformly. Positive angles turn the
    camera clockwise as seen from behind it (`View.roll_deg`) and the body in the image the other way. Ranges are along
    the axis and stay as they are. Pixels take the value of the nearest one. Noise and shadows turn with the image, as
    if the projector were turned, too. Raises BadConfig for an angle out of range.
    """

    name = "roll"
    largest_deg: float = 15.0

    def __post_init__(self) -> None:
        check_number(self.name, "largest_deg", self.largest_deg, 0, 180)

    def __call__(self, image: CameraImage, random: np.random.Generator) -> CameraImage:
        """See `Transform`."""
        angle = self.largest_deg * (2 * unit(random) - 1)
        return turned(image, angle) if angle else image


def turned(image: CameraImage, angle_deg: float) -> CameraImage:
    """The image as a camera takes it that is turned by an angle about its axis, degrees, clockwise from behind."""
    return take_turned(image, math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg)))
