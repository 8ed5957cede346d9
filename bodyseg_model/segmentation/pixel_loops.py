"""Odds of people, resampling of a body and painting of overlays, compiled, for `finder.py`, `views.py`, `pictures.py`.

For views: pixels: ascending flat indices of the frame; rows, columns: int [N], of these; mapping: a `Turn`. All ranges
are finite and in front of the view, so that no point is outside the box that is computed.

For overlays: flat: ranges of a frame, float32 [N], metres; near, scale: `pictures._shading`; table: uint8
[C + 3, S, 3], `pictures._table`; picture: sRGB uint8 [N, 3].
"""

from functools import partial
from math import exp, floor
from typing import Any, Final

import numpy as np

from bodyseg_data.machine import compiled

_LEAST_AHEAD: Final = 1e-9
"""Least range before the rotation, for a range of 1 after it: directions beside or behind the frame's camera are mapped
far outside the frame."""

AROUND: Final = 2
"""Cells to each side over which a pixel's odds are averaged."""

_WIDTH: Final = 1.5  # standard deviation of their weights, cells
_OTHER: Final = np.float32(0.05)  # share of a range by which that of another surface differs

_kernel = partial(compiled, feature="labelling frames", extra="segment")
_overlay_kernel = partial(compiled, feature="overlays", extra="segment")


# Odds.


@_kernel
def spread_odds(odds: Any, agreed: Any, range_m: Any, stride: Any, found: Any) -> None:
    """Write the probability of a person at every measured pixel, float32 [H, W], from the odds of cells of `stride`
    pixels, float32 [h, w]: its cell's; or, where cells up to `AROUND` away do not agree, bool [h, w], their mean by
    distance in image and range (joint bilateral upsampling, Kopf et al. 2007).
    """
    (rows, columns), (height, width) = odds.shape, range_m.shape
    metres, zero, one = np.empty_like(odds), np.float32(0), np.float32(1)
    for i in range(rows):
        for j in range(columns):
            metres[i, j] = range_m[min(i * stride + stride // 2, height - 1), min(j * stride + stride // 2, width - 1)]
    weights = np.empty((stride, 2 * AROUND + 1), np.float32)
    for place in range(stride):
        for k in range(2 * AROUND + 1):
            weights[place, k] = exp(-((((place + 0.5) / stride - 0.5 + AROUND - k) / _WIDTH) ** 2) / 2)
    for i in range(rows):
        for j in range(columns):
            own = one / (one + np.float32(exp(-odds[i, j])))
            for row in range(i * stride, min((i + 1) * stride, height)):
                for column in range(j * stride, min((j + 1) * stride, width)):
                    z = range_m[row, column]
                    if not 0 < z < np.inf:
                        continue
                    found[row, column] = own
                    if agreed[i, j]:
                        continue
                    total, weighed, scale = zero, zero, one / (_OTHER * max(z, one))
                    for k in range(max(i - AROUND, 0), min(i + AROUND + 1, rows)):
                        in_row = weights[row - i * stride, k - i + AROUND]
                        for m in range(max(j - AROUND, 0), min(j + AROUND + 1, columns)):
                            away = (metres[k, m] - z) * scale
                            near = max(one - away * away, zero)
                            weight = near * near * in_row * weights[column - j * stride, m - j + AROUND]
                            total += weight
                            weighed += weight * odds[k, m]
                    if total > 0:
                        found[row, column] = one / (one + np.float32(exp(-weighed / total)))


@_kernel
def take_nearest(range_m: Any, jump: Any, rows: Any, columns: Any, seen: Any, values: Any, found: Any) -> None:
    """Write into `found`, [H, W], at every measured pixel of a frame, float32 [H, W], the value of the sample that row
    and column name, int [H] and [W], of `seen`, float32 [h, w], and `values`, [h, w]. Where that one's range is not of
    the pixel's surface, the value of the neighbour of nearest range; nothing where none is either.

    jump: float32 [2], greatest difference on one surface: metres, or a share of the range if that is more.
    """
    last_row, last_column = seen.shape[0] - 1, seen.shape[1] - 1
    for i in range(range_m.shape[0]):
        for j in range(range_m.shape[1]):
            z = range_m[i, j]
            if z == 0:
                continue
            row, column, best = rows[i], columns[j], max(z * jump[1], jump[0])
            if abs(seen[row, column] - z) <= best:
                found[i, j] = values[row, column]
                continue
            for k in range(row - 1, row + 2):
                for m in range(column - 1, column + 2):
                    place = min(max(k, 0), last_row), min(max(m, 0), last_column)
                    away = abs(seen[place] - z)
                    if away < best:
                        best, found[i, j] = away, values[place]


# Views.


@_kernel
def map_to_view(rows: Any, columns: Any, mapping: Any, down: Any, across: Any) -> Any:
    """Write the places of pixels' centres in the view, float64 [N] each; returns the extremes of down and across."""
    side = mapping.sign * mapping.view_focal
    top = left = np.inf
    bottom = right = -np.inf
    for i in range(columns.size):
        x = (np.float64(columns[i]) + 0.5 - mapping.camera_x) / mapping.camera_focal
        y = (np.float64(rows[i]) + 0.5 - mapping.camera_y) / mapping.camera_focal
        ahead = x * mapping.sine + mapping.cosine
        down[i] = mapping.view_y + mapping.view_focal * y / ahead
        across[i] = mapping.view_x + side * (x * mapping.cosine - mapping.sine) / ahead
        top, bottom = min(top, down[i]), max(bottom, down[i])
        left, right = min(left, across[i]), max(right, across[i])
    return top, bottom, left, right


@_kernel
def pick_ranges(own: Any, corner: Any, mapping: Any, start: Any, box: Any) -> None:
    """Write into `box`, float64 [h, w], whose first pixel of the view is `start`, the value of the frame's pixel that
    contains its centre. own: float64, the part of the frame that begins at `corner`, with a border of zeros.
    """
    last_row, last_column = own.shape[0] - 1, own.shape[1] - 1
    ahead, column_of = np.empty(box.shape[1]), np.empty(box.shape[1], np.intp)
    for i in range(box.shape[1]):
        x = (np.float64(start[1] + i) + 0.5 - mapping.view_x) / mapping.view_focal * mapping.sign
        ahead[i] = max(mapping.cosine - x * mapping.sine, _LEAST_AHEAD)
        across = mapping.camera_focal * (x * mapping.cosine + mapping.sine) / ahead[i]
        column_of[i] = min(max(floor(mapping.camera_x + across) - corner[1], 0), last_column)
    for row in range(box.shape[0]):
        y = mapping.camera_focal * ((np.float64(start[0] + row) + 0.5 - mapping.view_y) / mapping.view_focal)
        for i in range(box.shape[1]):
            down = floor(mapping.camera_y + y / ahead[i]) - corner[0]
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
    nearest, chosen = np.empty(flat.size), np.empty(flat.size, np.intp)
    for i in range(flat.size):
        nearest[i], chosen[i] = np.inf, -1
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


# Overlays.


@_overlay_kernel
def _shade(range_m: Any, near: Any, scale: Any, shades: Any) -> Any:
    return np.intp(min(max((range_m - near) * scale + np.float32(0.5), np.float32(0)), np.float32(shades - 1)))


@_overlay_kernel
def paint_room(flat: Any, near: Any, scale: Any, table: Any, picture: Any) -> None:
    """Paint the room: its measured pixels in the shades of the table's first row, others in its last."""
    last, shades = table.shape[0] - 1, table.shape[1]
    for i in range(flat.size):
        row, shade = (0, _shade(flat[i], near, scale, shades)) if 0 < flat[i] < np.inf else (last, 0)
        for channel in range(3):
            picture[i, channel] = table[row, shade, channel]


@_overlay_kernel
def paint_body(flat: Any, labels: Any, pixels: Any, near: Any, scale: Any, table: Any, picture: Any) -> None:
    """Paint a body's measured pixels in the shades of their labels, uint8 [N]; those of no class in the row after."""
    classes, shades = table.shape[0] - 3, table.shape[1]
    for i in range(pixels.size):
        pixel = pixels[i]
        if 0 < flat[pixel] < np.inf:
            row, shade = 1 + min(np.intp(labels[pixel]), classes), _shade(flat[pixel], near, scale, shades)
            for channel in range(3):
                picture[pixel, channel] = table[row, shade, channel]
