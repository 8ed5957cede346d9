"""Loops of labels that are carried from frame to frame, compiled with numba: a body's cells, its motion, its evidence,
by the types of `carried_labels.py`.

A pixel has three slots of evidence, uint32: weight << 8 | label, in units of 1 / `UNIT`. The first slot is the label
shown, the others contend for its place. All arithmetic on evidence is of whole numbers.
"""

import math
from functools import partial
from typing import Any, Final

import numpy as np

from bodyseg_data.labels import BACKGROUND
from bodyseg_data.machine import compiled
from bodyseg_data.rigs import MAX_SIDE

_kernel = partial(compiled, feature="carrying labels through a video")

UNIT: Final = 4096
"""Evidence of one frame with confidence 1."""

SLOTS: Final = 3
"""Labels that a pixel has evidence for, at most; a new one replaces the weaker of those not shown."""

_EMPTY: Final = np.uint32(BACKGROUND)
_LABEL: Final = np.uint32(255)
_BITS: Final = np.uint32(8)
_SHARE_BITS: Final = np.uint32(10)
_HALF: Final = np.float32(0.5)
_UNIT: Final = np.float32(UNIT)
_NEAREST_M: Final = np.float32(0.1)  # least range at which a place is looked up
_SHIFT: Final = np.float32(MAX_SIDE)  # makes coordinates positive, so that truncation rounds down
_UNMOVED: Final = np.float32(0.005)  # weight of no displacement beyond the body's motion
_ROUNDS: Final = 2
_SWEEPS: Final = 4
_LEAST_FOR_NOISE: Final = 6  # fewest pixels of a cell whose ranges count for the frame's noise


@_kernel
def middle_of(values: Any) -> Any:
    """The upper median of float32 values of at least 0, [N], N > 0, found by its bits, which have the same order.

    To compile a sort takes two seconds, and `np.partition` ten more.
    """
    low, high, bits = 0, 0x7F800000, values.view(np.int32)
    while low < high:
        between = (low + high) // 2
        below = 0
        for value in bits:
            below += value <= between
        if below > len(values) // 2:
            high = between
        else:
            low = between + 1
    return np.int32(low).view(np.float32)


@_kernel
def cells_of(body: Any, lens: Any, jump: Any) -> Any:
    """Average a body's pixels in cells; returns the fields of `Cells` but normals and neighbours, and, second, where in
    the grid each cell is, int32 [M]. jump: ranges further apart, metres, are of two surfaces. Of large cells, every
    second, third ... row and column is used.
    """
    count, step, range_m = lens.across * lens.down, max(1, lens.side // 3), body.range_m
    cell_column = np.full(lens.columns, -1, np.int32)  # -1: a column that is not used
    for u in range(0, lens.columns, step):
        cell_column[u] = u // lens.side
    total, many = np.zeros(count, np.float32), np.zeros(count, np.int32)
    pixels, cells = np.empty(len(body.pixels), np.int32), np.empty(len(body.pixels), np.int32)
    rows = np.empty(len(body.pixels), np.int32)  # kept: a division takes longer than all else
    number, v, first, beyond, line, used = 0, np.int64(0), np.int64(0), np.int64(0), 0, False
    for pixel in body.pixels:
        if pixel >= beyond:
            v = pixel // lens.columns
            first, beyond = v * lens.columns, (v + 1) * lens.columns
            line, used = v // lens.side * lens.across, v % step == 0
        if used and cell_column[np.uint64(pixel - first)] >= 0:
            cell = np.uint64(line + cell_column[np.uint64(pixel - first)])
            total[cell] += range_m[np.uint64(pixel)]
            many[cell] += 1
            pixels[number], cells[number], rows[number] = pixel, cell, v
            number += 1
    grid, mean, found = np.full(count, -1, np.int32), np.zeros(count, np.float32), 0
    for filled in range(count):
        if many[filled]:
            mean[filled] = total[filled] / many[filled]
            grid[filled] = found
            found += 1
    # If a cell shows two surfaces, the pixel nearest to the mean range decides which one counts.
    middle, off, spread = np.empty(found, np.float32), np.full(found, np.float32(np.inf)), np.zeros(found, np.float32)
    labels, place = np.empty(found, np.uint8), np.empty(found, np.int32)
    for k in range(number):
        pixel, cell = np.uint64(pixels[k]), np.uint64(cells[k])
        m, z = np.uint64(grid[cell]), range_m[pixel]
        away = abs(z - mean[cell])
        spread[m] += away * away
        place[m] = cell
        if away < off[m]:
            off[m], middle[m], labels[m] = away, z, body.labels[pixel]
    deviations, known = np.empty(found, np.float32), 0
    for here in range(found):
        if many[place[here]] >= _LEAST_FOR_NOISE:
            deviations[known] = math.sqrt(spread[here] / (many[place[here]] - 1))
            known += 1
    noise = middle_of(deviations[:known]) if known else np.float32(0)
    kept, points = np.zeros(found, np.int32), np.zeros((found, 3), np.float32)
    reach = max(jump, 2 * noise)
    for k in range(number):
        m, z = np.uint64(grid[np.uint64(cells[k])]), range_m[np.uint64(pixels[k])]
        if abs(z - middle[m]) <= reach:
            kept[m] += 1
            points[m, 0] += pixels[k] - rows[k] * lens.columns
            points[m, 1] += rows[k]
            points[m, 2] += z
    for here in range(found):
        z = points[here, 2] / kept[here]
        points[here, 0] = (points[here, 0] / kept[here] + _HALF - lens.x) / lens.focal * z
        points[here, 1] = (points[here, 1] / kept[here] + _HALF - lens.y) / lens.focal * z
        points[here, 2] = z
    return grid, place, points, labels, noise


@_kernel
def cell_at(x: Any, y: Any, z: Any, cells: Any, lens: Any, gate: Any) -> Any:
    """Number of the cell that a point meets, metres: into which it projects, at most `gate` away in range; else -1."""
    if z < _NEAREST_M:
        return -1
    u = math.floor((x / z * lens.focal + lens.x) / lens.side)
    v = math.floor((y / z * lens.focal + lens.y) / lens.side)
    if not (0 <= u < lens.across and 0 <= v < lens.down):
        return -1
    found = cells.grid[int(v) * lens.across + int(u)]
    return found if found >= 0 and abs(cells.points[found, 2] - z) <= gate else -1


@_kernel
def cells_met(places: Any, cells: Any, lens: Any, gate: Any) -> Any:
    """`cell_at` of places, float32 [M, 3], int64 [M]."""
    found = np.empty(len(places), np.int64)
    for m in range(len(places)):
        found[m] = cell_at(places[m, 0], places[m, 1], places[m, 2], cells, lens, gate)
    return found


@_kernel
def smooth_field(places: Any, cells: Any, shifts: Any, weights: Any, old: Any, lens: Any, gate: Any, faith: Any) -> Any:
    """Smooth displacements of a body's cells onto the old surface, float32 [M, 3], metres (as Horn and Schunck 1981
    have for brightness, here with distances to planes).

    places: float32 [M, 3], the cells after the rigid motion. Starts from `shifts`, float32 [M, 3], of the cells' parts.
    Minimises `faith` times the squared distances to the planes of the cells met, plus the squared differences between
    neighbours, plus `weights`, float32 [M], times the squared difference from the shift, plus a little for no
    displacement; by Gauss-Seidel sweeps, back and forth; cells are met anew in each round.
    """
    count, neighbours = len(places), cells.neighbours
    field, plane = shifts.copy(), np.empty((count, 3), np.float32)
    goal, trust = np.empty(count, np.float32), np.empty(count, np.float32)
    for _ in range(_ROUNDS):
        for m in range(count):
            trust[m] = 0
            x, y, z = places[m, 0] + field[m, 0], places[m, 1] + field[m, 1], places[m, 2] + field[m, 2]
            o = cell_at(x, y, z, old, lens, gate)
            if o < 0:
                continue
            nx, ny, nz = old.normals[o, 0], old.normals[o, 1], old.normals[o, 2]
            away = nx * (old.points[o, 0] - x) + ny * (old.points[o, 1] - y) + nz * (old.points[o, 2] - z)
            plane[m, 0], plane[m, 1], plane[m, 2] = nx, ny, nz
            goal[m] = away + nx * field[m, 0] + ny * field[m, 1] + nz * field[m, 2]
            weight = max(1 - (away / gate) ** 2, np.float32(0))
            trust[m] = faith * weight * weight if nx * nx + ny * ny + nz * nz > 0 else 0
        for sweep in range(_SWEEPS):
            for k in range(count):
                m = k if sweep % 2 == 0 else count - 1 - k
                own = weights[m]
                near, x, y, z = _UNMOVED + own, own * shifts[m, 0], own * shifts[m, 1], own * shifts[m, 2]
                for side in range(4):
                    o = np.uint64(neighbours[m, side])
                    if o != np.uint64(m):
                        near += 1
                        x, y, z = x + field[o, 0], y + field[o, 1], z + field[o, 2]
                x, y, z = x / near, y / near, z / near
                if trust[m] > 0:
                    nx, ny, nz = plane[m, 0], plane[m, 1], plane[m, 2]
                    push = trust[m] * (goal[m] - (nx * x + ny * y + nz * z)) / (near + trust[m])
                    x, y, z = x + nx * push, y + ny * push, z + nz * push
                field[m, 0], field[m, 1], field[m, 2] = x, y, z
    return field


@_kernel
def shown_near(found: Any, label: Any, z: Any, old: Any, lens: Any, rule: Any) -> Any:
    """True if the old frame shows a label up to `rule.border` pixels from `found` each way, at the range z, metres."""
    row, column = found // lens.columns, found % lens.columns
    for v in range(max(row - rule.border, 0), min(row + rule.border + 1, lens.rows)):
        for u in range(max(column - rule.border, 0), min(column + rule.border + 1, lens.columns)):
            p = np.uint64(v * lens.columns + u)
            if old.shown[p] == label and old.range_m[p] > 0 and abs(old.range_m[p] - z) <= rule.tolerance_m:
                return True
    return False


@_kernel
def nearest(row: Any, column: Any, z: Any, old_range: Any, lens: Any, tolerance: Any, reach: Any, steps: Any) -> Any:
    """The first pixel, by `steps` up to `reach` from (row, column), whose old range is within `tolerance` of z, metres;
    -1 for none.
    """
    here = row * lens.columns + column
    inside = reach <= row < lens.rows - reach and reach <= column < lens.columns - reach
    for n in range(len(steps)):
        v, u = steps[n, 0], steps[n, 1]
        if inside or (0 <= row + v < lens.rows and 0 <= column + u < lens.columns):
            p = np.uint64(here + v * lens.columns + u)
            if (old_range[p] > 0) & (abs(old_range[p] - z) <= tolerance):
                return np.int64(p)
    return np.int64(-1)


@_kernel
def carry(body: Any, lens: Any, rigid: Any, field: Any, grid: Any, old: Any, rule: Any, new: Any) -> None:
    """Carry evidence to a body's pixels, add the new frame's, and show the labels that have most.

    rigid: float32 [3, 4], the body's motion back to the old frame; field: float32 [M, 3], further displacements of its
    cells, metres; grid: theirs. A pixel's point is sought at the pixel that both take it to, and at those around it,
    the nearest first, where the old range agrees within `rule.tolerance_m`; not found, evidence starts anew. The old
    weights are multiplied by `keep`; or by `border_keep` if another label than the new frame's is shown there, and the
    new one up to `border` pixels beside it: a border has moved, or its place is uncertain. The label shown changes if
    another has more evidence by more than `margin`. `new` (`Images`) is written at the body's pixels.
    """
    x_of, cell_of = np.empty(lens.columns, np.float32), np.empty(lens.columns, np.int32)
    focal, cx, cy = np.float32(lens.focal), np.float32(lens.x), np.float32(lens.y)
    for at in range(lens.columns):
        x_of[at], cell_of[at] = (np.float32(at) + _HALF - cx) / focal, at // lens.side
    range_m, labels, pixels, confidence = body.range_m, body.labels, body.pixels, body.confidence
    old_range, tolerance = old.range_m, rule.tolerance_m
    a, b, c, d = rigid[0]
    e, f, g, h = rigid[1]
    i, j, k, l = rigid[2]  # noqa: E741
    first, beyond, line, y_of = np.int64(0), np.int64(0), np.int64(0), np.float32(0)
    for n in range(len(pixels)):
        pixel = pixels[n]
        if pixel >= beyond:
            v = pixel // lens.columns
            first, beyond, line = v * lens.columns, (v + 1) * lens.columns, v // lens.side * lens.across
            y_of = (np.float32(v) + _HALF - cy) / focal
        p, u = np.uint64(pixel), np.uint64(pixel - first)  # int64 would be tested for negative indices
        z, label = range_m[p], np.uint32(labels[p])
        x, y, cell = x_of[u] * z, y_of * z, grid[np.uint64(line + cell_of[u])]
        px, py, pz = a * x + b * y + c * z + d, e * x + f * y + g * z + h, i * x + j * y + k * z + l
        if cell >= 0:
            m = np.uint64(cell)
            px, py, pz = px + field[m, 0], py + field[m, 1], pz + field[m, 2]
        found = np.int64(-1)
        if pz > _NEAREST_M:
            scale = focal / pz
            px, py = px * scale + cx, py * scale + cy
            if abs(px) < _SHIFT and abs(py) < _SHIFT:
                column, row = np.int64(px + _SHIFT) - np.int64(_SHIFT), np.int64(py + _SHIFT) - np.int64(_SHIFT)
                if 0 <= column < lens.columns and 0 <= row < lens.rows:
                    found = row * lens.columns + column
                    if not abs(old_range[np.uint64(found)] - pz) <= tolerance or old_range[np.uint64(found)] <= 0:
                        found = np.int64(-1)
                if found < 0:
                    found = nearest(row, column, pz, old_range, lens, tolerance, rule.reach, rule.steps)
        weight = np.uint32(confidence[n] * confidence[n] * _UNIT + _HALF)
        new.range_m[p] = z
        if found < 0:
            new.slots[p, 0], new.slots[p, 1], new.slots[p, 2] = (weight << _BITS) | label, _EMPTY, _EMPTY
            new.shown[p] = labels[p]
            continue
        o = np.uint64(found)
        one, two, three = old.slots[o, 0], old.slots[o, 1], old.slots[o, 2]
        n1, n2, n3 = one & _LABEL, two & _LABEL, three & _LABEL
        share = rule.border_keep if n1 != label and shown_near(found, label, pz, old, lens, rule) else rule.keep
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
