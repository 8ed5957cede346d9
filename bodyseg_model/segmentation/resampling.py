"""Resampling of a body from any camera's frame to the camera that a network was trained for, and of labels back.

The trained camera aims at the body from a fixed distance, the stand-off. So the view is first rotated about the
vertical axis towards the body, as if the frame's camera had turned on the spot. Then it is scaled: a camera of focal
length f shows a surface at range Z with f / Z pixels a metre, and the body's median range gets as many as the trained
camera has at its stand-off. Both steps are exact where only focal length and direction differ; where distances differ,
a body keeps its original perspective. Ranges are picked from the nearest pixel, never interpolated: between a body and
the wall behind it there is no surface.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.rig import Camera, Rig
from bodyseg_data.core.sample import FARTHEST_STEPS

LARGEST_SIDE: Final = 2048
"""Greatest side of a view, pixels: 6.7 m at the stand-off of the paper's rig."""

MARGIN: Final = 64
"""Least number of empty pixels around the body in a view, so that a network sees the body's outline."""

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class BodyView:
    """One body as the trained camera would see it from its stand-off.

    range_m: float32 [h, w], metres, 0 where nothing was measured; as large as the trained camera's image, or larger if
    the body needs it, with the body in the middle. corner: first row and column of the view in that image, which may be
    negative. view_pixels: int64 [N], for every pixel of the body in the frame the pixel of the view that contains its
    centre, row * w + column; all of these are measured. turn_rad: rotation of the view to the frame's right.
    median_range_m: the median range after the rotation, which becomes the stand-off. scale: view pixels for each frame
    pixel, on the frame's optical axis.
    """

    range_m: NDArray[np.float32] = field(repr=False)
    corner: tuple[int, int]
    view_pixels: NDArray[np.intp] = field(repr=False)
    turn_rad: float
    median_range_m: float
    scale: float

    def back(self, image: NDArray[Any]) -> NDArray[Any]:
        """Values of an image [h, w] of this view at every pixel of the body in the frame, [N]."""
        return image.ravel()[self.view_pixels]


def view_body(
    range_m: NDArray[np.float32],
    pixels: NDArray[np.intp],
    camera: Camera,
    rig: Rig,
    mirrored: bool = False,
    turn_rad: float | None = None,
) -> BodyView:
    """Resample one body of a frame to `rig.camera` at `rig.stand_off_m`.

    range_m: [H, W], metres, taken by `camera`, whose pose is not used. pixels: the body's, int64 [N], at least one,
    row * W + column, ascending; ranges there must not be 0. mirrored: True if the frame shows left for right.
    turn_rad: rotation of the view, -1.5 to 1.5; None turns it to the middle of the body's outline.

    A pixel of the view gets the range of the frame pixel that contains its centre. If that pixel is not the body's but
    the view pixel contains centres of the body's pixels, it gets the range of the nearest of these, so that thin parts
    are not lost where the view is coarser. Raises BadConfig if the view would be larger than `LARGEST_SIDE`.
    """
    rows, columns = np.divmod(pixels, range_m.shape[1])
    depths = range_m.ravel()[pixels].astype(np.float64)
    sides = (columns + 0.5 - camera.centre_px[0]) * depths
    turn = turn_rad
    if turn is None:
        turn = math.atan2((sides.min() + sides.max()) / 2, float(np.median(depths)) * camera.focal_px)
    ranges = depths * _Rotation(camera, rig.camera, 1.0, turn, False).ahead(columns + 0.5)
    median = float(np.median(ranges))
    turned = _Rotation(camera, rig.camera, rig.camera.focal_px / rig.stand_off_m * median, turn, mirrored)

    down, across = turned.to_view(rows + 0.5, columns + 0.5)
    scale = turned.focal_px / camera.focal_px
    top, bottom = math.floor(down.min() - scale / 2), math.ceil(down.max() + scale / 2)
    left, right = math.floor(across.min() - scale / 2), math.ceil(across.max() + scale / 2)
    height = max(rig.camera.rows, bottom - top + 2 * MARGIN)
    width = max(rig.camera.columns, right - left + 2 * MARGIN)
    if max(height, width) > LARGEST_SIDE:
        raise BadConfig(
            f"a body's view must be at most {LARGEST_SIDE} pixels wide and high, found {width} x {height} "
            f"for {len(pixels)} pixels at {median:.3g} m"
        )
    corner = (top + bottom - height) // 2, (left + right - width) // 2

    # Only the body's boxes in frame and view are computed: most pixels of both are empty.
    first_row, first_column = int(rows[0]), int(columns.min())
    own = np.zeros((int(rows[-1]) - first_row + 3, int(columns.max()) - first_column + 3))  # a border of empty pixels
    own[rows - (first_row - 1), columns - (first_column - 1)] = ranges
    points = turned.to_frame(np.arange(top, bottom)[:, None] + 0.5, np.arange(left, right) + 0.5)
    box = _pick(own, (first_row - 1, first_column - 1), *points)

    row, column = np.floor(down).astype(np.intp), np.floor(across).astype(np.intp)
    flat, in_box = box.ravel(), (row - top) * box.shape[1] + column - left
    lost = np.flatnonzero(flat[in_box] == 0)
    off_centre = np.hypot(across[lost] % 1 - 0.5, down[lost] % 1 - 0.5)
    nearest_last = lost[np.argsort(-off_centre, kind="stable")]
    flat[in_box[nearest_last]] = ranges[nearest_last]
    nearest, farthest = rig.range_step_m, float(FARTHEST_STEPS) * rig.range_step_m  # as training images have them
    view = np.zeros((height, width), np.float32)
    view[top - corner[0] : bottom - corner[0], left - corner[1] : right - corner[1]] = np.where(
        box > 0, np.clip(box + (rig.stand_off_m - median), nearest, farthest), 0
    )
    view_pixels = (row - corner[0]) * width + column - corner[1]
    return BodyView(view, corner, view_pixels, turn, median, scale)


@dataclass(frozen=True)
class _Rotation:
    """Mapping between the image planes of a frame's camera and of a view from the same point.

    The view is rotated to the frame's right by `angle` and has focal length `focal_px` and the principal point of
    `trained`. A ray (x, y, 1) of the frame is (x cos - sin, y, x sin + cos) after the rotation.
    """

    camera: Camera
    trained: Camera
    focal_px: float
    angle: float
    mirrored: bool

    def ahead(self, across: Floats) -> Floats:
        """Range after the rotation, for a range of 1 before it, at columns of the frame."""
        x = (across - self.camera.centre_px[0]) / self.camera.focal_px
        return x * math.sin(self.angle) + math.cos(self.angle)

    def to_view(self, down: Floats, across: Floats) -> tuple[Floats, Floats]:
        """Map points (down, across) of the frame's image plane to the view's, pixels."""
        x = (across - self.camera.centre_px[0]) / self.camera.focal_px
        y = (down - self.camera.centre_px[1]) / self.camera.focal_px
        ahead = self.ahead(across)
        sign = -1 if self.mirrored else 1
        return (
            self.trained.centre_px[1] + self.focal_px * y / ahead,
            self.trained.centre_px[0]
            + sign * self.focal_px * (x * math.cos(self.angle) - math.sin(self.angle)) / ahead,
        )

    def to_frame(self, down: Floats, across: Floats) -> tuple[Floats, Floats]:
        """Inverse of `to_view`; directions beside or behind the frame's camera are mapped far outside the frame."""
        x = (across - self.trained.centre_px[0]) / self.focal_px * (-1 if self.mirrored else 1)
        y = (down - self.trained.centre_px[1]) / self.focal_px
        ahead = np.maximum(math.cos(self.angle) - x * math.sin(self.angle), 1e-9)
        return (
            self.camera.centre_px[1] + self.camera.focal_px * y / ahead,
            self.camera.centre_px[0] + self.camera.focal_px * (x * math.cos(self.angle) + math.sin(self.angle)) / ahead,
        )


def _pick(image: Floats, corner: tuple[int, int], down: Floats, across: Floats) -> Floats:
    """Values of the pixels that contain points (down, across) of the image plane. image: a part of it that begins at
    `corner` (row, column), with a border of zeros, which points outside get, too.
    """
    row, column = (
        np.clip(np.floor(points) - start, 0, side - 1).astype(np.intp)
        for points, start, side in zip((down, across), corner, image.shape, strict=True)
    )
    picked: Floats = image.ravel()[row * image.shape[1] + column]
    return picked
