"""Odds of people, resampling of a body, labels carried along and painting of overlays, compiled, for `finder.py`,
`views.py`, `carried_labels.py`, `pictures.py`.

For views: pixels: ascending flat indices of the frame; rows, columns: int [N], of these; mapping: a `Turn`. All ranges
are finite and in front of the view, so that no point is outside the box that is computed.

For labels that are carried along: a pixel has three slots of evidence, uint32: weight << 8 | label, in units of 1 /
`UNIT`. The first slot is the label shown, the others contend for its place. Evidence is of whole numbers.

For overlays: flat: ranges of a frame, float32 [N], metres; shading: `pictures.Shading`; table: uint8 [M, 3],
`pictures._table`; picture: sRGB uint8 [N, 3].
"""

from __future__ import annotations

from functools import partial
from math import exp, floor
from typing import Any, Final

import numpy as np

from bodyseg_data.labels import BACKGROUND
from bodyseg_data.machine import compiled

_LEAST_AHEAD: Final = 1e-9
"""Least range before the rotation, for a range of 1 after it: directions beside or behind the frame's camera are mapped
far outside the frame."""

AROUND: Final = 2
"""Cells each way that a pixel's odds are a mean of."""

_WIDTH: Final = 1.5  # standard deviation of their weights, cells
_OTHER: Final = np.float32(0.05)  # share of a range by which another surface's differs

UNIT: Final = 4096
"""Evidence of one frame with confidence 1."""

_EMPTY: Final = np.uint32(BACKGROUND)
_LABEL: Final = np.uint32(255)
_BITS: Final = np.uint32(8)
_SHARE_BITS: Final = np.uint32(10)
_HALF: Final = np.float32(0.5)
_UNIT: Final = np.float32(UNIT)
_NEAREST_M: Final = np.float32(0.1)  # before the camera
_SHIFT: Final = np.float32(4096)  # makes coordinates positive, so that cutting off decimals rounds down

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


# Views.


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
def map_to_view(rows: Any, columns: Any, mapping: Any, down: Any, across: Any) -> Any:
    """Write the points of the view's image plane that pixels' centres are mapped to, float64 [N] each; returns the
    least and greatest of `down` and of `across`.
    """
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


# Labels carried along.


@_kernel
def shown_near(found: Any, label: Any, z: Any, old: Any, lens: Any, border: Any, tolerance: Any) -> Any:
    """True if the old frame shows a label up to `border` pixels from pixel `found` along each axis, at a range within
    `tolerance` of z, metres.
    """
    row, column = found // lens.columns, found % lens.columns
    for v in range(max(row - border, 0), min(row + border + 1, lens.rows)):
        for u in range(max(column - border, 0), min(column + border + 1, lens.columns)):
            p = np.uint64(v * lens.columns + u)
            if old.shown[p] == label and old.range_m[p] > 0 and abs(old.range_m[p] - z) <= tolerance:
                return True
    return False


@_kernel
def nearest(row: Any, column: Any, z: Any, old_range: Any, lens: Any, tolerance: Any, steps: Any) -> Any:
    """The first pixel, by `steps` from (row, column), whose old range is within `tolerance` of z, metres; -1 for
    none.
    """
    for n in range(len(steps)):
        v, u = row + steps[n, 0], column + steps[n, 1]
        if 0 <= v < lens.rows and 0 <= u < lens.columns:
            p = np.uint64(v * lens.columns + u)
            if (old_range[p] > 0) & (abs(old_range[p] - z) <= tolerance):
                return np.int64(p)
    return np.int64(-1)


@_kernel
def carry(
    pixels: Any, confidence: Any, range_m: Any, labels: Any, lens: Any, motion: Any, old: Any, rule: Any, new: Any
) -> None:
    """Carry evidence to a body's pixels, int64 [N], add the new frame's, and show the labels that have most.

    confidence: float32 [N]. range_m, labels: of the new frame, flat. rule: a `Carrying`, the tolerance in range,
    metres, and steps, int64 [S, 2]. A pixel's point is sought at the pixel that `motion`, float32 [3, 4], takes it to,
    and by `steps` around it, where the old range agrees within the tolerance; not found, evidence starts anew. The old
    weights are multiplied by `keep`, and by `border_share` if another label than the new frame's is shown there, and
    the new one up to `border` pixels beside it: a border has moved, or its place is uncertain. The label shown changes
    if another has more evidence by more than `margin`. `new` (`Images`) is written at the body's pixels.
    """
    given, tolerance, steps = rule
    keep, margin = np.uint32(round(1024 * given.keep)), np.uint32(round(UNIT * given.margin))
    border_keep = np.uint32(round(1024 * given.border_share * given.keep))
    focal, cx, cy = np.float32(lens.focal), np.float32(lens.x), np.float32(lens.y)
    a, b, c, d = motion[0]
    e, f, g, h = motion[1]
    i, j, k, l = motion[2]  # noqa: E741
    for n in range(len(pixels)):
        p = np.uint64(pixels[n])  # int64 would be tested for counting from the end
        v = pixels[n] // lens.columns
        z, label = range_m[p], np.uint32(labels[p])
        x = (np.float32(pixels[n] - v * lens.columns) + _HALF - cx) / focal * z
        y = (np.float32(v) + _HALF - cy) / focal * z
        pz, found = i * x + j * y + k * z + l, np.int64(-1)
        if pz > _NEAREST_M:
            px, py = (a * x + b * y + c * z + d) * focal / pz + cx, (e * x + f * y + g * z + h) * focal / pz + cy
            if abs(px) < _SHIFT and abs(py) < _SHIFT:
                column, row = np.int64(px + _SHIFT) - np.int64(_SHIFT), np.int64(py + _SHIFT) - np.int64(_SHIFT)
                found = nearest(row, column, pz, old.range_m, lens, tolerance, steps)
        weight = np.uint32(confidence[n] * confidence[n] * _UNIT + _HALF)
        new.range_m[p] = z
        if found < 0:
            new.slots[p, 0], new.slots[p, 1], new.slots[p, 2] = (weight << _BITS) | label, _EMPTY, _EMPTY
            new.shown[p] = labels[p]
            continue
        one, two, three = old.slots[found, 0], old.slots[found, 1], old.slots[found, 2]
        n1, n2, n3 = one & _LABEL, two & _LABEL, three & _LABEL
        near = n1 != label and shown_near(found, label, pz, old, lens, given.border, tolerance)
        share = border_keep if near else keep
        w1 = ((one >> _BITS) * share) >> _SHARE_BITS
        w2 = ((two >> _BITS) * share) >> _SHARE_BITS
        w3 = ((three >> _BITS) * share) >> _SHARE_BITS
        if n1 == label:
            w1 += weight
        elif n2 == label:
            w2 += weight
        elif n3 == label:
            w3 += weight
        elif w3 <= w2:
            if weight >= w3:
                n3, w3 = label, weight
        elif weight >= w2:
            n2, w2 = label, weight
        if w3 > w2:
            n2, w2, n3, w3 = n3, w3, n2, w2
        if w2 > w1 + margin:
            n1, w1, n2, w2 = n2, w2, n1, w1
        new.slots[p, 0], new.slots[p, 1], new.slots[p, 2] = (w1 << _BITS) | n1, (w2 << _BITS) | n2, (w3 << _BITS) | n3
        new.shown[p] = n1


# Overlays.


@_overlay_kernel
def _shade(range_m: Any, shading: Any) -> Any:
    last = np.float32(shading.shades - 1)
    return np.intp(min(max((range_m - shading.near) * shading.scale + np.float32(0.5), np.float32(0)), last))


@_overlay_kernel
def paint_room(flat: Any, shading: Any, table: Any, picture: Any) -> None:
    """Paint the room: its measured pixels in the first shades of the table, others in the last."""
    nothing = table.shape[0] - 1
    for i in range(flat.size):
        colour = _shade(flat[i], shading) if 0 < flat[i] < np.inf else nothing
        for channel in range(3):
            picture[i, channel] = table[colour, channel]


@_overlay_kernel
def paint_body(flat: Any, labels: Any, pixels: Any, shading: Any, classes: Any, table: Any, picture: Any) -> None:
    """Paint a body's measured pixels in the shades of their labels, uint8 [N]; all labels from `classes` on alike."""
    for i in range(pixels.size):
        pixel = pixels[i]
        if 0 < flat[pixel] < np.inf:
            group = min(np.intp(labels[pixel]), classes)
            colour = (1 + group) * shading.shades + _shade(flat[pixel], shading)
            for channel in range(3):
                picture[pixel, channel] = table[colour, channel]
