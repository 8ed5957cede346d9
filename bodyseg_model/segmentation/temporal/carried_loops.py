"""Loops of labels that are carried from frame to frame, compiled with numba: a body's cells, its motion, its evidence.

A pixel has three slots of evidence, uint32: weight << 8 | label, in units of 1 / `UNIT`. The first slot is the label
shown, the others contend for its place. All arithmetic on evidence is of whole numbers.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.kernels import compiled
from bodyseg_data.core.parts import BACKGROUND

_kernel = partial(compiled, feature="carrying labels through a video")

UNIT: Final = 4096
"""Evidence of one frame with confidence 1."""

SLOTS: Final = 3
"""Labels that a pixel has evidence for, at most; a new one replaces the weaker of those not shown."""

PARTS: Final = 256  # labels are bytes

_EMPTY: Final = np.uint32(BACKGROUND)
_LABEL: Final = np.uint32(255)
_BITS: Final = np.uint32(8)
_SHARE_BITS: Final = np.uint32(10)
_HALF: Final = np.float32(0.5)
_UNIT: Final = np.float32(UNIT)
_NEAREST_M: Final = np.float32(0.1)  # before the camera
_FARTHEST_PX: Final = np.float32(4000)  # outside the image that coordinates can be
_STILL: Final = 1.0  # weight of no shift in a rigid step, against one for every cell
_STILL_TURN: Final = 0.002  # of no turn, square metres
_LEAST_FOR_NOISE: Final = 6  # pixels of a cell whose ranges say how noisy the frame is


class Lens(NamedTuple):
    """Numbers of a camera, and the cells of its image: focal length and principal point (x, y) in pixels; columns and
    rows of the image; the side of a cell, pixels; columns and rows of cells.
    """

    focal: float
    x: float
    y: float
    columns: int
    rows: int
    side: int
    across: int
    down: int


class Frame(NamedTuple):
    """Images of a frame, flat: ranges, float32 [H * W], metres, 0 off the bodies; slots of evidence, uint32 [H * W,
    `SLOTS`]; the label shown, uint8 [H * W].
    """

    range_m: NDArray[np.float32]
    slots: NDArray[np.uint32]
    shown: NDArray[np.uint8]


class Body(NamedTuple):
    """A body in a new frame: its pixels, int64 [N], ascending, and its confidence at them, float32 [N]; the frame's
    ranges, float32 [H * W], metres, and labels, uint8 [H * W].
    """

    pixels: NDArray[np.intp]
    confidence: NDArray[np.float32]
    range_m: NDArray[np.float32]
    labels: NDArray[np.uint8]


class Cells(NamedTuple):
    """M cells of a body, in reading order. grid: int32 [down * across], a cell's number, -1 where the body has none.
    points: float32 [M, 3], metres, the mean of one surface. normals: float32 [M, 3], of unit length, 0 where neighbours
    lack. labels: uint8 [M], of one pixel of the cell. noise_m: median deviation of ranges within a cell, metres.
    """

    grid: NDArray[np.int32]
    points: NDArray[np.float32]
    normals: NDArray[np.float32]
    labels: NDArray[np.uint8]
    noise_m: float


class Rule(NamedTuple):
    """How evidence is carried; see `Carrying`. steps: int64 [S, 2], rows and columns to the pixels at which a point is
    sought, (0, 0) first; reach: the largest of them. tolerance_m: metres. keep, border_keep: shares in 1 / 1024.
    border: pixels. margin: in 1 / `UNIT`.
    """

    steps: NDArray[np.int64]
    reach: int
    tolerance_m: np.float32
    keep: np.uint32
    border_keep: np.uint32
    border: int
    margin: np.uint32


@_kernel
def cells_of(body: Any, lens: Any, jump: Any) -> Any:
    """Average a body's pixels in cells; returns the fields of `Cells`. jump: ranges further apart, metres, are of two
    surfaces. Of large cells, every second, third ... row and column is used.
    """
    count, step = lens.across * lens.down, max(1, lens.side // 3)
    total, many = np.zeros(count, np.float32), np.zeros(count, np.int32)
    chosen, number = np.empty((len(body.pixels), 3), np.int32), 0  # row, column and cell of the pixels that are used
    row, column, last = np.int64(0), np.int64(0), np.int64(-1)
    for pixel in body.pixels:
        column += pixel - last
        last = pixel
        if column >= lens.columns or pixel == body.pixels[0]:  # a division takes longer than all else
            row = pixel // lens.columns
            column = pixel - row * lens.columns
        if row % step == 0 and column % step == 0:
            cell = row // lens.side * lens.across + column // lens.side
            total[cell] += body.range_m[pixel]
            many[cell] += 1
            chosen[number, 0], chosen[number, 1], chosen[number, 2] = row, column, cell
            number += 1
    grid, found = np.full(count, -1, np.int32), 0
    for cell in range(count):
        if many[cell]:
            grid[cell] = found
            found += 1
    # The pixel nearest the mean range decides which of two surfaces in a cell is meant.
    middle, off, spread = np.empty(found, np.float32), np.full(found, np.float32(np.inf)), np.zeros(found, np.float32)
    labels, place = np.empty(found, np.uint8), np.empty(found, np.int32)
    for k in range(number):
        pixel, cell = chosen[k, 0] * lens.columns + chosen[k, 1], chosen[k, 2]
        m, z = grid[cell], body.range_m[pixel]
        away = abs(z - total[cell] / many[cell])
        spread[m] += away * away
        place[m] = cell
        if away < off[m]:
            off[m], middle[m], labels[m] = away, z, body.labels[pixel]
    deviations, known = np.empty(found, np.float32), 0
    for m in range(found):
        if many[place[m]] >= _LEAST_FOR_NOISE:
            deviations[known] = math.sqrt(spread[m] / (many[place[m]] - 1))
            known += 1
    noise = np.partition(deviations[:known], known // 2)[known // 2] if known else np.float32(0)
    kept, points = np.zeros(found, np.int32), np.zeros((found, 3), np.float32)
    for k in range(number):
        m, z = grid[chosen[k, 2]], body.range_m[chosen[k, 0] * lens.columns + chosen[k, 1]]
        if abs(z - middle[m]) <= max(jump, 2 * noise):
            kept[m] += 1
            points[m, 0] += chosen[k, 1]
            points[m, 1] += chosen[k, 0]
            points[m, 2] += z
    for m in range(found):
        z = points[m, 2] / kept[m]
        points[m, 0] = (points[m, 0] / kept[m] + _HALF - lens.x) / lens.focal * z
        points[m, 1] = (points[m, 1] / kept[m] + _HALF - lens.y) / lens.focal * z
        points[m, 2] = z
    return grid, points, normals_of(grid, place, points, lens, jump), labels, noise


@_kernel
def normals_of(grid: Any, place: Any, points: Any, lens: Any, jump: Any) -> Any:
    """Normals, float32 [M, 3], of cells: cross products of the differences of neighbours. place: int32 [M], where in the
    grid each cell is; jump: neighbours whose ranges are further apart, metres, are of two surfaces.
    """
    normals, beside = np.zeros((len(place), 3), np.float32), np.empty(4, np.int64)
    for m in range(len(place)):
        cell = place[m]
        column = cell % lens.across
        beside[0] = grid[cell - 1] if column > 0 else -1
        beside[1] = grid[cell + 1] if column < lens.across - 1 else -1
        beside[2] = grid[cell - lens.across] if cell >= lens.across else -1
        beside[3] = grid[cell + lens.across] if cell + lens.across < len(grid) else -1
        for k in range(4):
            if beside[k] < 0 or abs(points[beside[k], 2] - points[m, 2]) >= jump:
                beside[k] = m
        left, right, above, below = beside
        # One number at a time: a difference of two rows would be a new array for every cell.
        ax, bx = points[right, 0] - points[left, 0], points[below, 0] - points[above, 0]
        ay, by = points[right, 1] - points[left, 1], points[below, 1] - points[above, 1]
        az, bz = points[right, 2] - points[left, 2], points[below, 2] - points[above, 2]
        x, y, z = ay * bz - by * az, az * bx - bz * ax, ax * by - bx * ay
        length = math.sqrt(x * x + y * y + z * z)
        if length > 0:
            normals[m, 0], normals[m, 1], normals[m, 2] = x / length, y / length, z / length
    return normals


@_kernel
def move(motion: Any, x: Any, y: Any, z: Any) -> Any:
    """A point, metres, after a rigid motion, [3, 4]: three numbers."""
    return (
        motion[0, 0] * x + motion[0, 1] * y + motion[0, 2] * z + motion[0, 3],
        motion[1, 0] * x + motion[1, 1] * y + motion[1, 2] * z + motion[1, 3],
        motion[2, 0] * x + motion[2, 1] * y + motion[2, 2] * z + motion[2, 3],
    )


@_kernel
def rigid_step(points: Any, motion: Any, old: Any, lens: Any, gate: Any) -> Any:
    """Equations of a Gauss-Newton step, float64 [6, 7], right side last, for a turn about the mean of the moved points
    and a shift; and that mean, float64 [3].

    Distances of moved points, [M, 3], to the planes of the cells of `old` that they meet fall; those beyond `gate`,
    metres, do not count (Tukey's weights).
    """
    table, line, mean = np.zeros((6, 7)), np.zeros(7), np.zeros(3)
    for m in range(len(points)):
        x, y, z = move(motion, points[m, 0], points[m, 1], points[m, 2])
        mean[0] += x / len(points)
        mean[1] += y / len(points)
        mean[2] += z / len(points)
    for m in range(len(points)):
        x, y, z = move(motion, points[m, 0], points[m, 1], points[m, 2])
        if z < _NEAREST_M:
            continue
        u = math.floor((x / z * lens.focal + lens.x) / lens.side)
        v = math.floor((y / z * lens.focal + lens.y) / lens.side)
        if not (0 <= u < lens.across and 0 <= v < lens.down):
            continue
        o = old.grid[int(v) * lens.across + int(u)]
        if o < 0 or abs(old.points[o, 2] - z) > gate:
            continue
        nx, ny, nz = old.normals[o, 0], old.normals[o, 1], old.normals[o, 2]
        away = nx * (old.points[o, 0] - x) + ny * (old.points[o, 1] - y) + nz * (old.points[o, 2] - z)
        weight = max(1 - (away / gate) ** 2, 0.0) ** 2
        x, y, z = x - mean[0], y - mean[1], z - mean[2]
        line[0], line[1], line[2] = y * nz - z * ny, z * nx - x * nz, x * ny - y * nx
        line[3], line[4], line[5], line[6] = nx, ny, nz, away
        for i in range(6):
            share = weight * line[i]
            for j in range(7):
                table[i, j] += share * line[j]
    for i in range(6):
        table[i, i] += _STILL_TURN if i < 3 else _STILL
    return table, mean


@_kernel
def count_matches(cells: Any, motion: Any, old: Any, lens: Any, tolerance: Any, reach: Any) -> Any:
    """Count the cells of each part that meet their label in the old frame, `Frame`, at the place where the rigid motion
    puts them, and up to `reach` pixels from there along rows and columns.

    A cell that meets its label, at a range within `tolerance`, metres, counts 1, one that meets another label there -1.
    Returns int64 [PARTS, 2 reach + 1, 2 reach + 1], and the cells that could be counted of every part, int64 [PARTS].
    """
    wide = 2 * reach + 1
    counts, used = np.zeros((PARTS, wide, wide), np.int64), np.zeros(PARTS, np.int64)
    for m in range(len(cells.points)):
        x, y, z = move(motion, cells.points[m, 0], cells.points[m, 1], cells.points[m, 2])
        if z < _NEAREST_M:
            continue
        column, row = math.floor(x / z * lens.focal + lens.x), math.floor(y / z * lens.focal + lens.y)
        if not (reach <= column < lens.columns - reach and reach <= row < lens.rows - reach):
            continue
        part = cells.labels[m]
        used[part] += 1
        for i in range(wide):
            corner = np.uint64((row + i - reach) * lens.columns + column - reach)
            for j in range(np.uint64(wide)):
                meets = old.range_m[corner + j] > 0 and abs(old.range_m[corner + j] - z) <= tolerance
                counts[part, i, j] += np.int64(meets) * (2 * np.int64(old.shown[corner + j] == part) - 1)
    return counts, used


@_kernel
def shown_near(found: Any, label: Any, z: Any, old: Any, lens: Any, rule: Any) -> Any:
    """True if the old frame shows a label up to `rule.border` pixels from pixel `found` along each axis, at a range that
    agrees with z, metres.
    """
    row, column = found // lens.columns, found % lens.columns
    for v in range(max(row - rule.border, 0), min(row + rule.border + 1, lens.rows)):
        for u in range(max(column - rule.border, 0), min(column + rule.border + 1, lens.columns)):
            p = np.uint64(v * lens.columns + u)
            if old.shown[p] == label and old.range_m[p] > 0 and abs(old.range_m[p] - z) <= rule.tolerance_m:
                return True
    return False


@_kernel
def nearest(row: Any, column: Any, z: Any, old: Any, lens: Any, rule: Any) -> Any:
    """The first pixel, by `rule.steps` from (row, column), whose old range agrees with z, metres; -1 for none."""
    inside = rule.reach <= row < lens.rows - rule.reach and rule.reach <= column < lens.columns - rule.reach
    for n in range(len(rule.steps)):
        v, u = row + rule.steps[n, 0], column + rule.steps[n, 1]
        if inside or (0 <= v < lens.rows and 0 <= u < lens.columns):
            p = np.uint64(v * lens.columns + u)
            if old.range_m[p] > 0 and abs(old.range_m[p] - z) <= rule.tolerance_m:
                return np.int64(p)
    return np.int64(-1)


@_kernel
def carry(body: Any, lens: Any, motion: Any, shifts: Any, old: Any, rule: Any, new: Any) -> None:
    """Carry evidence to a body's pixels, add the new frame's, and show the labels that have most.

    motion: float32 [3, 4], from this frame to the old one. shifts: float32 [PARTS, 2], pixels, rows and columns, added
    to the place of a part's pixels. A pixel's point is sought at the pixel that it projects into, and at those around
    it, the nearest first, where the old range agrees within `rule.tolerance_m`; not found, evidence starts anew. The
    old weights are multiplied by `keep`; or by `border_keep` if another label than the new frame's is shown there, and
    the new one up to `border` pixels beside it: a border has moved, or its place is uncertain. The label shown changes
    if another has more evidence by more than `margin`. `new`, a `Frame`, is written at the body's pixels.
    """
    x_of = np.empty(lens.columns, np.float32)
    focal, cx, cy = np.float32(lens.focal), np.float32(lens.x), np.float32(lens.y)
    for u in range(lens.columns):
        x_of[u] = (np.float32(u) + _HALF - cx) / focal
    first, beyond, y_of = np.int64(0), np.int64(0), np.float32(0)
    for n in range(len(body.pixels)):
        pixel = body.pixels[n]
        if pixel >= beyond:
            v = pixel // lens.columns
            first, beyond = v * lens.columns, (v + 1) * lens.columns
            y_of = (np.float32(v) + _HALF - cy) / focal
        p = np.uint64(pixel)  # int64 would be tested for counting from the end
        z, label = body.range_m[p], np.uint32(body.labels[p])
        x, y, depth = move(motion, x_of[np.uint64(pixel - first)] * z, y_of * z, z)
        found = np.int64(-1)
        if depth > _NEAREST_M:
            column, row = x * focal / depth + cx + shifts[label, 1], y * focal / depth + cy + shifts[label, 0]
            if abs(column) < _FARTHEST_PX and abs(row) < _FARTHEST_PX:
                found = nearest(np.int64(math.floor(row)), np.int64(math.floor(column)), depth, old, lens, rule)
        weight = np.uint32(body.confidence[n] * body.confidence[n] * _UNIT + _HALF)
        new.range_m[p] = z
        if found < 0:
            new.slots[p, 0], new.slots[p, 1], new.slots[p, 2] = (weight << _BITS) | label, _EMPTY, _EMPTY
            new.shown[p] = body.labels[p]
            continue
        o = np.uint64(found)
        one, two, three = old.slots[o, 0], old.slots[o, 1], old.slots[o, 2]
        n1, n2, n3 = one & _LABEL, two & _LABEL, three & _LABEL
        share = rule.border_keep if n1 != label and shown_near(found, label, depth, old, lens, rule) else rule.keep
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
        if w2 > w1 + rule.margin:
            n1, w1, n2, w2 = n2, w2, n1, w1
        new.slots[p, 0], new.slots[p, 1], new.slots[p, 2] = (w1 << _BITS) | n1, (w2 << _BITS) | n2, (w3 << _BITS) | n3
        new.shown[p] = n1
