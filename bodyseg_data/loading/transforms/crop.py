"""Crop: a window of the image, in pixels as they are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.randomness import unit
from bodyseg_data.loading.transforms.camera_image import CameraImage
from bodyseg_data.loading.transforms.checks import check_size
from bodyseg_data.loading.transforms.resampling import take_window
from bodyseg_data.loading.transforms.transform import Transform

Place = Literal["axis", "body", "anywhere"]

_PLACES: Final = ("axis", "body", "anywhere")


@dataclass(frozen=True)
class Crop(Transform):
    """A window of `rows` x `columns` pixels, unscaled; what lies outside of the image is background.

    at: "axis" centres it on the optical axis, at which bodies are rendered. "body" centres it on the box of the
    labelled pixels, and on the axis if there are none; the box is that of the image with artifacts, so that the windows
    of two variants may differ by pixels lost at the body's outline. "anywhere" draws its place inside the image,
    uniformly; along a side longer than the image's, the place of the image inside the window. Ranges stay as they are.
    Raises BadConfig for a size or a place out of range.
    """

    name = "crop"
    rows: int
    columns: int
    at: Place = "axis"

    def __post_init__(self) -> None:
        check_size(self.name, self.rows, self.columns)
        if self.at not in _PLACES:
            raise BadConfig(f"transform 'crop': at must be one of {', '.join(_PLACES)}, found {self.at!r}")

    def shape(self, rows: int, columns: int) -> tuple[int, int]:
        """See `Transform`: the window's."""
        return self.rows, self.columns

    def __call__(self, image: CameraImage, random: np.random.Generator) -> CameraImage:
        """See `Transform`."""
        if self.at == "anywhere":
            height, width = image.range.shape
            top, left = _anywhere(unit(random), height - self.rows), _anywhere(unit(random), width - self.columns)
        else:
            x, y = image.centre_px
            if self.at == "body" and (box := image.body_box) is not None:
                x, y = (box[2] + box[3]) / 2, (box[0] + box[1]) / 2
            top, left = round(y - self.rows / 2), round(x - self.columns / 2)
        return take_window(image, top, left, self.rows, self.columns)


def _anywhere(drawn: float, spare: int) -> int:
    """A first pixel, from 0 to `spare`, the pixels that the image has more than the window; both may be negative."""
    place = int(drawn * (abs(spare) + 1))
    return place if spare >= 0 else -place
