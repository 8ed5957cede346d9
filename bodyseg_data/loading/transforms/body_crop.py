"""Crop to the body: the window that holds it, scaled to one size."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodyseg_data.loading.transforms.camera_image import CameraImage
from bodyseg_data.loading.transforms.checks import check_number, check_size
from bodyseg_data.loading.transforms.resampling import take_grid
from bodyseg_data.loading.transforms.transform import Transform


@dataclass(frozen=True)
class BodyCrop(Transform):
    """The smallest window that holds the body with a margin, scaled to `rows` x `columns` pixels.

    margin: width of the border around the box of the labelled pixels, as a share of the box's height and width, 0 to 1.
    The window has the sides' ratio of the result, and the box's centre; outside of the image it holds background. Of
    an image without labels it holds all. Pixels take the value of the nearest one; ranges stay as they are, and the
    focal length in pixels grows with the scale. The box is that of the image with artifacts, so that the windows of two
    variants may differ slightly. Raises BadConfig for a size or a margin out of range.
    """

    name = "body_crop"
    rows: int
    columns: int
    margin: float = 0.1

    def __post_init__(self) -> None:
        check_size(self.name, self.rows, self.columns)
        check_number(self.name, "margin", self.margin, 0, 1)

    def shape(self, rows: int, columns: int) -> tuple[int, int]:
        """See `Transform`: that of the result."""
        return self.rows, self.columns

    def __call__(self, image: CameraImage, random: np.random.Generator) -> CameraImage:
        """See `Transform`."""
        top, bottom, left, right = image.body_box or (0, image.range.shape[0], 0, image.range.shape[1])
        larger = 1 + 2 * self.margin
        scale = min(self.rows / (larger * (bottom - top)), self.columns / (larger * (right - left)))
        first_row = (top + bottom) / 2 - self.rows / scale / 2
        first_column = (left + right) / 2 - self.columns / scale / 2
        x, y = image.centre_px
        return take_grid(
            image,
            first_row + (np.arange(self.rows) + 0.5) / scale,
            first_column + (np.arange(self.columns) + 0.5) / scale,
            focal_px=image.focal_px * scale,
            centre_px=((x - first_column) * scale, (y - first_row) * scale),
        )
