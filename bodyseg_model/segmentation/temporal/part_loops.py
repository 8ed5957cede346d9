"""Shifts of a body's parts from one frame back to the frame before, by their labels, compiled with numba."""

from __future__ import annotations

import math
from functools import partial
from typing import Any, Final

import numpy as np

from bodyseg_data.core.kernels import compiled
from bodyseg_model.segmentation.temporal.motion_loops import cell_at

_kernel = partial(compiled, feature="carrying labels through a video")

_PARTS: Final = 256  # labels are bytes
_LABEL: Final = np.uint32(255)
_NEAREST_M: Final = 0.1  # before the camera
_LEAST_PIXELS: Final = 20  # of a part that is matched
_BETTER: Final = 0.02
"""Share of a part's pixels by which more must agree at another place than at the expected one."""


@_kernel
def mean_points(points: Any, labels: Any) -> Any:
    """Mean point of all cells, float64 [3], metres; those of the cells of every part by their areas, float64 [256, 3],
    metres; and these areas, float64 [256], cells times square metres of range.
    """
    middle, middles, areas = np.zeros(3), np.zeros((_PARTS, 3)), np.zeros(_PARTS)
    for m in range(len(points)):
        area, part = points[m, 2] * points[m, 2], labels[m]
        areas[part] += area
        for i in range(3):
            middle[i] += points[m, i]
            middles[part, i] += area * points[m, i]
    for part in range(_PARTS):
        if areas[part] > 0:
            middles[part] /= areas[part]
    return middle / max(len(points), 1), middles, areas


@_kernel
def part_shifts(motion: Any, middles: Any, areas: Any, old_middles: Any, old_areas: Any, least: Any, reach: Any) -> Any:
    """Shift of every part beyond the rigid motion, float32 [256, 3], metres, and its weight, float32 [256], 0 to 1: the
    square of the ratio of its two areas; 0 for a part that is smaller than `least` or would shift more than `reach`.
    """
    shifts, weights = np.zeros((_PARTS, 3), np.float32), np.zeros(_PARTS, np.float32)
    for part in range(_PARTS):
        if areas[part] > least and old_areas[part] > least:
            x, y, z = middles[part]
            squared = 0.0
            for i in range(3):
                place = motion[i, 0] * x + motion[i, 1] * y + motion[i, 2] * z + motion[i, 3]
                shifts[part, i] = old_middles[part, i] - place
                squared += shifts[part, i] ** 2
            if squared < reach * reach:
                ratio = min(areas[part], old_areas[part]) / max(areas[part], old_areas[part])
                weights[part] = ratio * ratio
            else:
                shifts[part] = 0
    return shifts, weights


@_kernel
def count_matches(
    range_m: Any, pixels: Any, labels: Any, old_range_m: Any, old_slots: Any, motion: Any, shifts: Any, lens: Any,
    tolerance: Any, reach: Any, step: Any,
) -> Any:  # fmt: skip
    """Count the pixels of each part that meet their label in the old frame, at the place that the motion and the part's
    shift give, and up to `reach` pixels from there along rows and columns.

    range_m, old_range_m: float32 [H * W], metres; labels: uint8 [H * W]; pixels: int64 [N], ascending; old_slots: as of
    `carry`, the labels shown. A pixel that meets its label, at a range within `tolerance`, metres, counts 1, one that
    meets another label there -1. Every `step`-th row and column is used. Returns int64 [256, 2 reach + 1, 2 reach + 1];
    the pixels that could be counted of every part, int64 [256]; and the sum of their old ranges, float64 [256], metres.
    """
    wide = 2 * reach + 1
    counts, used, depth = np.zeros((_PARTS, wide, wide), np.int64), np.zeros(_PARTS, np.int64), np.zeros(_PARTS)
    chosen = np.zeros(lens.columns, np.bool_)
    chosen[::step] = True
    v, first, beyond, skipped = np.int64(0), np.int64(0), np.int64(0), False
    for n in range(len(pixels)):
        pixel = pixels[n]
        if pixel >= beyond:
            v = pixel // lens.columns
            first, beyond, skipped = v * lens.columns, (v + 1) * lens.columns, v % step != 0
        u = pixel - first
        if skipped or not chosen[u]:
            continue
        part, z = labels[np.uint64(pixel)], range_m[np.uint64(pixel)]
        x, y = (u + 0.5 - lens.x) / lens.focal * z, (v + 0.5 - lens.y) / lens.focal * z
        px = motion[0, 0] * x + motion[0, 1] * y + motion[0, 2] * z + motion[0, 3] + shifts[part, 0]
        py = motion[1, 0] * x + motion[1, 1] * y + motion[1, 2] * z + motion[1, 3] + shifts[part, 1]
        pz = motion[2, 0] * x + motion[2, 1] * y + motion[2, 2] * z + motion[2, 3] + shifts[part, 2]
        if pz < _NEAREST_M:
            continue
        column, line = math.floor(px / pz * lens.focal + lens.x), math.floor(py / pz * lens.focal + lens.y)
        if not (reach <= column < lens.columns - reach and reach <= line < lens.rows - reach):
            continue
        used[part] += 1
        depth[part] += pz
        for i in range(wide):
            corner = np.uint64((line + i - reach) * lens.columns + column - reach)
            for j in range(np.uint64(wide)):
                old, agrees = old_range_m[corner + j], (old_slots[corner + j, 0] & _LABEL) == part
                meets = (old > 0) & (abs(old - pz) <= tolerance)
                counts[part, i, j] += np.int64(meets) * (2 * np.int64(agrees) - 1)
    return counts, used, depth


@_kernel
def match_parts(counts: Any, used: Any, depth: Any, focal: Any, shifts: Any, weights: Any) -> None:
    """Improve the shifts of parts, float32 [256, 3], metres, in place: each part is moved to where most of its pixels
    meet their label in the old frame; its weight is then 1.

    counts, used, depth: of `count_matches`. focal: pixels. Between pixels, a parabola through three counts has the
    place.
    """
    wide = counts.shape[1]
    reach = wide // 2
    for part in range(_PARTS):
        if used[part] < _LEAST_PIXELS:
            continue
        down, across = reach, reach
        best = counts[part, reach, reach] + int(_BETTER * used[part])
        for i in range(wide):
            for j in range(wide):
                if counts[part, i, j] > best:
                    best, down, across = counts[part, i, j], i, j
        pixel_m = depth[part] / used[part] / focal
        shifts[part, 0] += (across - reach + peak(counts[part, down], across)) * pixel_m
        shifts[part, 1] += (down - reach + peak(counts[part, :, across], down)) * pixel_m
        weights[part] = 1


@_kernel
def peak(counts: Any, at: Any) -> Any:
    """Place of the highest point of a parabola through the counts at `at` and beside it, -0.5 to 0.5 from `at`; 0 at
    the ends, and where the counts have no highest point.
    """
    if at == 0 or at == len(counts) - 1:
        return 0.0
    bow = counts[at - 1] + counts[at + 1] - 2 * counts[at]
    return min(max(0.5 * (counts[at - 1] - counts[at + 1]) / bow, -0.5), 0.5) if bow < 0 else 0.0


@_kernel
def gain_of_shifts(
    places: Any, labels: Any, shifts: Any, weights: Any, old_index: Any, old_points: Any, old_labels: Any, lens: Any,
    gate: Any,
) -> Any:  # fmt: skip
    """Gain of shifting the parts of places [M, 3], over the cells of parts that have a weight: the mean fall, metres,
    of the difference of range to the cells they meet, at most `gate`; and by how much the share of cells rises that
    meet one of their own label. 0 without any.
    """
    fall, more, cells = 0.0, 0, 0
    for m in range(len(places)):
        part = labels[m]
        if weights[part] > 0:
            x, y, z = places[m]
            for sign in (1, -1):
                o = cell_at(x, y, z, old_index, lens)
                away = min(abs(old_points[o, 2] - z), gate) if o >= 0 else gate
                fall += sign * away
                if away < gate and old_labels[o] == part:
                    more -= sign
                x, y, z = x + shifts[part, 0], y + shifts[part, 1], z + shifts[part, 2]
            cells += 1
    return fall / max(cells, 1), more / max(cells, 1)
