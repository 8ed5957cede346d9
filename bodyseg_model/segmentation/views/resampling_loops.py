"""Resampling of a body, compiled; `resampling.py` has the NumPy forms of the same bits, and describes the mapping.

rotation: float64 [9], `resampling._numbers`. pixels: ascending flat indices of the frame; rows, columns: int [N], of
these.
"""

from __future__ import annotations

from functools import partial
from math import floor
from typing import Any, Final

import numpy as np

from bodyseg_data.core.kernels import compiled
from bodyseg_model.segmentation.views.resampling import LEAST_AHEAD

_CAMERA_X: Final = 0
_CAMERA_Y: Final = 1
_CAMERA_FOCAL: Final = 2
_VIEW_X: Final = 3
_VIEW_Y: Final = 4
_VIEW_FOCAL: Final = 5
_SINE: Final = 6
_COSINE: Final = 7
_SIGN: Final = 8
_kernel = partial(compiled, feature="the compiled form of the resampling of bodies")


@_kernel
def list_pixels(flat: Any, pixels: Any, width: Any, centre: Any, rows: Any, columns: Any, depths: Any) -> Any:
    """Write rows, columns and ranges of pixels, int [N] twice and float64 [N].

    Returns the least and greatest of their distances from the optical axis, to the right, times the focal length, and
    their first and last column. centre: column of the principal point.
    """
    row, row_end = 0, width
    least, greatest, first, last = np.inf, -np.inf, width, -1
    for i in range(pixels.size):
        pixel = pixels[i]
        while pixel >= row_end:
            row += 1
            row_end += width
        rows[i], columns[i], depths[i] = row, pixel - row_end + width, np.float64(flat[pixel])
        side = (np.float64(columns[i]) + 0.5 - centre) * depths[i]
        least, greatest = min(least, side), max(greatest, side)
        first, last = min(first, columns[i]), max(last, columns[i])
    return least, greatest, first, last


@_kernel
def turn_ranges(columns: Any, rotation: Any, depths: Any) -> None:
    """Replace ranges of pixels, float64 [N], by those after the rotation."""
    for i in range(columns.size):
        x = (np.float64(columns[i]) + 0.5 - rotation[_CAMERA_X]) / rotation[_CAMERA_FOCAL]
        depths[i] *= x * rotation[_SINE] + rotation[_COSINE]


@_kernel
def map_to_view(rows: Any, columns: Any, rotation: Any, down: Any, across: Any) -> Any:
    """Write the points of the view's image plane that pixels' centres are mapped to, float64 [N] each; returns the
    least and greatest of `down` and of `across`.
    """
    side = rotation[_SIGN] * rotation[_VIEW_FOCAL]
    top = left = np.inf
    bottom = right = -np.inf
    for i in range(columns.size):
        x = (np.float64(columns[i]) + 0.5 - rotation[_CAMERA_X]) / rotation[_CAMERA_FOCAL]
        y = (np.float64(rows[i]) + 0.5 - rotation[_CAMERA_Y]) / rotation[_CAMERA_FOCAL]
        ahead = x * rotation[_SINE] + rotation[_COSINE]
        down[i] = rotation[_VIEW_Y] + rotation[_VIEW_FOCAL] * y / ahead
        across[i] = rotation[_VIEW_X] + side * (x * rotation[_COSINE] - rotation[_SINE]) / ahead
        top, bottom = min(top, down[i]), max(bottom, down[i])
        left, right = min(left, across[i]), max(right, across[i])
    return top, bottom, left, right


@_kernel
def cut_out(rows: Any, columns: Any, ranges: Any, corner: Any, own: Any) -> None:
    """Write ranges of pixels, float64 [N], into `own`, float64 [h, w], a part of the frame that begins at `corner`."""
    for i in range(ranges.size):
        own[rows[i] - corner[0], columns[i] - corner[1]] = ranges[i]


@_kernel
def pick_ranges(own: Any, corner: Any, rotation: Any, start: Any, box: Any) -> None:
    """Write into `box`, float64 [h, w], whose first pixel of the view is `start`, the value of the frame's pixel that
    contains its centre. own: float64, the part of the frame that begins at `corner`, with a border of zeros.
    """
    last_row, last_column = own.shape[0] - 1, own.shape[1] - 1
    ahead, column_of = np.empty(box.shape[1]), np.empty(box.shape[1], np.intp)
    for i in range(box.shape[1]):
        x = (np.float64(start[1] + i) + 0.5 - rotation[_VIEW_X]) / rotation[_VIEW_FOCAL] * rotation[_SIGN]
        ahead[i] = max(rotation[_COSINE] - x * rotation[_SINE], LEAST_AHEAD)
        across = rotation[_CAMERA_FOCAL] * (x * rotation[_COSINE] + rotation[_SINE]) / ahead[i]
        column_of[i] = min(max(floor(rotation[_CAMERA_X] + across) - corner[1], 0), last_column)
    for row in range(box.shape[0]):
        y = rotation[_CAMERA_FOCAL] * ((np.float64(start[0] + row) + 0.5 - rotation[_VIEW_Y]) / rotation[_VIEW_FOCAL])
        for i in range(box.shape[1]):
            down = floor(rotation[_CAMERA_Y] + y / ahead[i]) - corner[0]
            box[row, i] = own[min(max(down, 0), last_row), column_of[i]]


@_kernel
def fill_lost(down: Any, across: Any, start: Any, ranges: Any, box: Any, corner: Any, width: Any, pixels: Any) -> None:
    """Write the pixel of the view that each point is in into `pixels`, int [N], row * width + column, from `corner` on.

    A pixel of `box`, which begins at `start`, that is 0 though points are in it gets the range of the one nearest to
    its centre, the last of equals.
    """
    flat, columns = box.ravel(), box.shape[1]
    cells = np.empty(pixels.size, np.intp)
    lost = 0
    for i in range(cells.size):
        row, column = floor(down[i]), floor(across[i])
        pixels[i] = (row - corner[0]) * width + column - corner[1]
        cells[i] = (row - start[0]) * columns + column - start[1]
        lost += flat[cells[i]] == 0
    if lost == 0:
        return
    nearest = np.full(flat.size, np.inf)
    chosen = np.full(flat.size, -1)
    for i in range(cells.size):
        cell = cells[i]
        if flat[cell] == 0:
            right, below = across[i] - floor(across[i]) - 0.5, down[i] - floor(down[i]) - 0.5
            distance = right * right + below * below
            if distance <= nearest[cell]:
                nearest[cell], chosen[cell] = distance, i
    for i in range(cells.size):
        if chosen[cells[i]] == i:
            flat[cells[i]] = ranges[i]


@_kernel
def move_ranges(box: Any, shift: Any, nearest: Any, farthest: Any, view: Any) -> None:
    """Write the ranges of `box` that are not 0, moved by `shift` and limited, into `view`, float32 of the same size."""
    for row in range(box.shape[0]):
        for i in range(box.shape[1]):
            if box[row, i] > 0:
                view[row, i] = np.float32(min(max(box[row, i] + shift, nearest), farthest))
