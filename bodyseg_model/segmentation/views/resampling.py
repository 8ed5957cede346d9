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
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.kernels import use_compiled
from bodyseg_data.core.rig import Camera, Rig
from bodyseg_data.core.sample import FARTHEST_STEPS
from bodyseg_model.segmentation.order_statistics import median

LARGEST_SIDE: Final = 2048
"""Greatest side that a body's view may need, pixels: 6.7 m at the stand-off of the paper's rig."""

MARGIN: Final = 64
"""Least number of empty pixels around the body in a view, so that a network sees the body's outline."""

LEAST_AHEAD: Final = 1e-9
"""Least range before the rotation, for a range of 1 after it: directions beside or behind the frame's camera are mapped
far outside the frame."""

STEP: Final = 64
"""Views larger than the trained camera's image are so by multiples of this, pixels: a runtime prepares for every size
that it meets, and views of one size go through a network together."""

USUAL_PEOPLE: Final = 3
"""Surfaces of one size that a frame may show a network, for which `usual_views` prepares it."""

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]


@dataclass(frozen=True)
class BodyView:
    """One body as the trained camera would see it from its stand-off.

    range_m: float32 [h, w], metres, 0 where nothing was measured; as large as the trained camera's image, or larger by
    multiples of `STEP` if the body needs it, with the body in the middle. corner: first row and column of the view in
    that image, which may be negative. view_pixels: int64 [N], for every pixel of the body in the frame the pixel of the
    view that contains its centre, row * w + column; all of these are measured. turn_rad: rotation of the view to the
    frame's right. median_range_m: the median range after the rotation, which becomes the stand-off. scale: view pixels
    for each frame pixel, on the frame's optical axis.
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
    form = _loops() if use_compiled() else _NumpyForm
    flat, depths = np.ascontiguousarray(range_m).ravel(), np.empty(len(pixels))
    rows, columns = np.empty_like(pixels), np.empty_like(pixels)
    centre = float(camera.centre_px[0])
    least, greatest, first, last = form.list_pixels(flat, pixels, range_m.shape[1], centre, rows, columns, depths)
    turn = turn_rad
    if turn is None:
        turn = math.atan2((least + greatest) / 2, median(depths) * camera.focal_px)
    form.turn_ranges(columns, _numbers(camera, rig.camera, 1.0, turn, mirrored), depths)
    median_m = median(depths)
    focal_px = rig.camera.focal_px / rig.stand_off_m * median_m
    rotation = _numbers(camera, rig.camera, focal_px, turn, mirrored)

    down, across = np.empty(len(pixels)), np.empty(len(pixels))
    ends = form.map_to_view(rows, columns, rotation, down, across)
    scale = focal_px / camera.focal_px
    top, left = (math.floor(end - scale / 2) for end in ends[::2])
    bottom, right = (math.ceil(end + scale / 2) for end in ends[1::2])
    needed = max(rig.camera.rows, bottom - top + 2 * MARGIN), max(rig.camera.columns, right - left + 2 * MARGIN)
    if max(needed) > LARGEST_SIDE:
        raise BadConfig(
            f"a body's view must be at most {LARGEST_SIDE} pixels wide and high, found {needed[1]} x {needed[0]} "
            f"for {len(pixels)} pixels at {median_m:.3g} m"
        )
    height, width = _in_steps(rig.camera.rows, needed[0]), _in_steps(rig.camera.columns, needed[1])
    corner = (top + bottom - height) // 2, (left + right - width) // 2

    # Only the body's boxes in frame and view are computed: most pixels of both are empty.
    begin = int(rows[0]) - 1, first - 1
    own = np.zeros((int(rows[-1]) - begin[0] + 2, last - begin[1] + 2))  # a border of empty pixels
    form.cut_out(rows, columns, depths, begin, own)
    box, view_pixels = np.zeros((bottom - top, right - left)), np.empty(len(pixels), np.intp)
    form.pick_ranges(own, begin, rotation, (top, left), box)
    form.fill_lost(down, across, (top, left), depths, box, corner, width, view_pixels)
    nearest, farthest = rig.range_step_m, float(FARTHEST_STEPS) * rig.range_step_m  # as training images have them
    view = np.zeros((height, width), np.float32)
    inside = view[top - corner[0] : bottom - corner[0], left - corner[1] : right - corner[1]]
    form.move_ranges(box, rig.stand_off_m - median_m, nearest, farthest, inside)
    return BodyView(view, corner, view_pixels, turn, median_m, scale)


def usual_views(rig: Rig, together: bool) -> Iterator[list[NDArray[np.float32]]]:
    """Views, as in `BodyView`, of the sizes and numbers that most frames give: of the trained camera's image and wider
    ones up to a square, each alone, and, for a network that takes several `together`, up to `USUAL_PEOPLE` of the
    first. All show a surface at the stand-off.
    """
    rows, columns = rig.camera.rows, rig.camera.columns
    for width in range(columns, max(rows, columns) + STEP, STEP):
        view = np.zeros((rows, width), np.float32)
        view[: rows // 4] = rig.stand_off_m
        most = USUAL_PEOPLE if together and width == columns else 1
        yield from ([view] * several for several in range(1, most + 1))


def _in_steps(trained: int, needed: int) -> int:
    """Side of a view, pixels: that of the trained camera's image, and as many times `STEP` as are needed."""
    return trained - (trained - needed) // STEP * STEP


@cache
def _loops() -> Any:
    """The compiled loops, in a module that needs numba."""
    return import_module("bodyseg_model.segmentation.views.resampling_loops")


def _numbers(camera: Camera, trained: Camera, focal_px: float, turn_rad: float, mirrored: bool) -> Floats:
    """The mapping between the image planes of a frame's camera and of a view from the same point, as float64 [9].

    The view is rotated to the frame's right by `turn_rad` and has focal length `focal_px` and the principal point of
    `trained`. A ray (x, y, 1) of the frame is (x cos - sin, y, x sin + cos) after the rotation.
    """
    view = *trained.centre_px, focal_px, math.sin(turn_rad), math.cos(turn_rad), -1.0 if mirrored else 1.0
    return np.array([*camera.centre_px, camera.focal_px, *view], np.float64)


class _NumpyForm:
    """The functions of `resampling_loops`, with the same bits."""

    @staticmethod
    def list_pixels(
        flat: NDArray[np.float32],
        pixels: Indices,
        width: int,
        centre: float,
        rows: Indices,
        columns: Indices,
        depths: Floats,
    ) -> tuple[float, float, int, int]:
        np.divmod(pixels, width, out=(rows, columns))
        depths[:] = flat[pixels]
        sides = (columns + 0.5 - centre) * depths
        return float(sides.min()), float(sides.max()), int(columns.min()), int(columns.max())

    @staticmethod
    def turn_ranges(columns: Indices, rotation: Floats, depths: Floats) -> None:
        centre, focal_px, sine, cosine = rotation[[0, 2, 6, 7]]
        depths *= (columns + 0.5 - centre) / focal_px * sine + cosine

    @staticmethod
    def map_to_view(
        rows: Indices, columns: Indices, rotation: Floats, down: Floats, across: Floats
    ) -> tuple[float, float, float, float]:
        centre_x, centre_y, focal_px, view_x, view_y, view_focal_px, sine, cosine, sign = rotation
        x, y = (columns + 0.5 - centre_x) / focal_px, (rows + 0.5 - centre_y) / focal_px
        ahead = x * sine + cosine
        down[:] = view_y + view_focal_px * y / ahead
        across[:] = view_x + sign * view_focal_px * (x * cosine - sine) / ahead
        return float(down.min()), float(down.max()), float(across.min()), float(across.max())

    @staticmethod
    def cut_out(rows: Indices, columns: Indices, ranges: Floats, corner: tuple[int, int], own: Floats) -> None:
        own[rows - corner[0], columns - corner[1]] = ranges

    @staticmethod
    def pick_ranges(
        own: Floats, corner: tuple[int, int], rotation: Floats, start: tuple[int, int], box: Floats
    ) -> None:
        centre_x, centre_y, focal_px, view_x, view_y, view_focal_px, sine, cosine, sign = rotation
        x = (np.arange(start[1], start[1] + box.shape[1]) + 0.5 - view_x) / view_focal_px * sign
        y = (np.arange(start[0], start[0] + box.shape[0])[:, None] + 0.5 - view_y) / view_focal_px
        ahead = np.maximum(cosine - x * sine, LEAST_AHEAD)
        points = centre_y + focal_px * y / ahead, centre_x + focal_px * (x * cosine + sine) / ahead
        row, column = (
            np.clip(np.floor(point) - first, 0, side - 1).astype(np.intp)
            for point, first, side in zip(points, corner, own.shape, strict=True)
        )
        box[:] = own.ravel()[row * own.shape[1] + column]

    @staticmethod
    def fill_lost(
        down: Floats,
        across: Floats,
        start: tuple[int, int],
        ranges: Floats,
        box: Floats,
        corner: tuple[int, int],
        width: int,
        pixels: Indices,
    ) -> None:
        row, column = np.floor(down).astype(np.intp), np.floor(across).astype(np.intp)
        pixels[:] = (row - corner[0]) * width + column - corner[1]
        flat, cells = box.ravel(), (row - start[0]) * box.shape[1] + column - start[1]
        lost = np.flatnonzero(flat[cells] == 0)
        right, below = across[lost] - column[lost] - 0.5, down[lost] - row[lost] - 0.5
        nearest_last = lost[np.argsort(-(right * right + below * below), kind="stable")]
        flat[cells[nearest_last]] = ranges[nearest_last]

    @staticmethod
    def move_ranges(box: Floats, shift: float, nearest: float, farthest: float, view: NDArray[np.float32]) -> None:
        np.copyto(view, np.clip(box + shift, nearest, farthest), where=box > 0, casting="same_kind")
