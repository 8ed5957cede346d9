"""A body's surface in cells of a few pixels: mean points, normals and neighbours, compiled with numba."""

from __future__ import annotations

import math
from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.kernels import compiled

_kernel = partial(compiled, feature="carrying labels through a video")

_ZERO: Final = np.float32(0)
_HALF: Final = np.float32(0.5)
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


class Cells(NamedTuple):
    """M cells of a body, in reading order.

    grid: int32 [down * across], a cell's number, -1 where the body has none. place: int32 [M], the inverse. points:
    float32 [M, 3], metres, in the camera's frame, the mean of the nearer half of the ranges' spread. normals: float32
    [M, 3], of unit length, 0 where neighbours lack. neighbours: int32 [M, 4], left, right, above, below, -1 for none.
    labels: uint8 [M], of one pixel of the cell. noise_m: median spread of ranges within a cell, metres.
    """

    grid: NDArray[np.int32]
    place: NDArray[np.int32]
    points: NDArray[np.float32]
    normals: NDArray[np.float32]
    neighbours: NDArray[np.int32]
    labels: NDArray[np.uint8]
    noise_m: float


@_kernel
def average_cells(range_m: Any, pixels: Any, labels: Any, lens: Any, jump: Any) -> Any:
    """Average a body's pixels in cells. range_m: float32 [H * W], metres; pixels: int64 [N], ascending; labels: uint8
    [H * W]; jump: ranges further apart, metres, are of two surfaces. A cell has the points near its middle range alone.

    Returns index, place, points, labels and noise of `Cells`. Of large cells, every second, third ... row and column is
    used.
    """
    count = lens.across * lens.down
    step = max(1, lens.side // 3)
    column = np.full(lens.columns, -1, np.int32)
    for u in range(0, lens.columns, step):
        column[u] = u // lens.side
    chosen, cell, number = np.empty(len(pixels), np.int64), np.empty(len(pixels), np.int32), 0
    total, many = np.zeros(count, np.float32), np.zeros(count, np.int32)
    line = np.empty(len(pixels), np.int32)  # of the pixels chosen: kept, as a division takes longer than all else
    v, first, beyond, row, used = np.int64(0), np.int64(0), np.int64(0), 0, False
    for i in range(len(pixels)):
        pixel = pixels[i]
        if pixel >= beyond:
            v = pixel // lens.columns
            first, beyond = v * lens.columns, (v + 1) * lens.columns
            row, used = (v // lens.side) * lens.across, v % step == 0
        if used and column[np.uint64(pixel - first)] >= 0:
            c = row + column[np.uint64(pixel - first)]
            total[np.uint64(c)] += range_m[np.uint64(pixel)]
            many[np.uint64(c)] += 1
            chosen[number], cell[number], line[number] = pixel, c, v
            number += 1
    index, mean = np.full(count, -1, np.int32), np.zeros(count, np.float32)
    found = 0
    for c in range(count):
        if many[c]:
            mean[c] = total[c] / many[c]
            index[c] = found
            found += 1
    place, points, named = np.empty(found, np.int32), np.zeros((found, 3), np.float32), np.empty(found, np.uint8)
    # The pixel nearest the mean range decides which of two surfaces in a cell is meant.
    middle, off, spread = np.empty(found, np.float32), np.full(found, np.float32(np.inf)), np.zeros(found, np.float32)
    for k in range(number):
        place_of, z = np.uint64(cell[k]), range_m[np.uint64(chosen[k])]
        away, own = abs(z - mean[place_of]), np.uint64(index[place_of])
        spread[own] += away * away
        place[own] = place_of
        if away < off[own]:
            off[own], middle[own], named[own] = away, z, labels[np.uint64(chosen[k])]
    deviations, known = np.empty(found, np.float32), 0
    for m in range(found):
        if many[place[m]] >= _LEAST_FOR_NOISE:
            deviations[known] = math.sqrt(spread[m] / (many[place[m]] - 1))
            known += 1
    noise = np.partition(deviations[:known], known // 2)[known // 2] if known else _ZERO
    reach = max(jump, 2 * noise)
    kept = np.zeros(found, np.int32)
    for k in range(number):
        own, pixel = np.uint64(index[np.uint64(cell[k])]), chosen[k]
        z = range_m[np.uint64(pixel)]
        if abs(z - middle[own]) <= reach:
            kept[own] += 1
            points[own, 0] += pixel - np.int64(line[k]) * lens.columns
            points[own, 1] += line[k]
            points[own, 2] += z
    for m in range(found):
        z = points[m, 2] / kept[m]
        points[m, 0] = (points[m, 0] / kept[m] + _HALF - lens.x) / lens.focal * z
        points[m, 1] = (points[m, 1] / kept[m] + _HALF - lens.y) / lens.focal * z
        points[m, 2] = z
    return index, place, points, named, noise


@_kernel
def link_cells(index: Any, place: Any, points: Any, lens: Any, jump: Any) -> Any:
    """Neighbours, int32 [M, 4], and normals, float32 [M, 3], of `Cells`. jump: neighbours whose ranges are further
    apart, metres, are of two surfaces. A normal is the cross product of the differences of neighbours.
    """
    neighbours, normals = np.full((len(place), 4), -1, np.int32), np.zeros((len(place), 3), np.float32)
    for m in range(len(place)):
        c, z = place[m], points[m, 2]
        column = c % lens.across
        if column > 0:
            neighbours[m, 0] = index[c - 1]
        if column < lens.across - 1:
            neighbours[m, 1] = index[c + 1]
        if c >= lens.across:
            neighbours[m, 2] = index[c - lens.across]
        if c + lens.across < len(index):
            neighbours[m, 3] = index[c + lens.across]
        for k in range(4):
            if neighbours[m, k] >= 0 and abs(points[neighbours[m, k], 2] - z) >= jump:
                neighbours[m, k] = -1
        left = neighbours[m, 0] if neighbours[m, 0] >= 0 else m
        right = neighbours[m, 1] if neighbours[m, 1] >= 0 else m
        above = neighbours[m, 2] if neighbours[m, 2] >= 0 else m
        below = neighbours[m, 3] if neighbours[m, 3] >= 0 else m
        # One number at a time: a difference of two rows would be a new array for every cell.
        ax, bx = points[right, 0] - points[left, 0], points[below, 0] - points[above, 0]
        ay, by = points[right, 1] - points[left, 1], points[below, 1] - points[above, 1]
        az, bz = points[right, 2] - points[left, 2], points[below, 2] - points[above, 2]
        x, y, z = ay * bz - by * az, az * bx - bz * ax, ax * by - bx * ay
        length = math.sqrt(x * x + y * y + z * z)
        if length > 0:
            normals[m, 0], normals[m, 1], normals[m, 2] = x / length, y / length, z / length
    return neighbours, normals


def cells_of(
    range_m: NDArray[np.float32], pixels: NDArray[np.intp], labels: NDArray[np.uint8], lens: Lens, jump_m: float
) -> Cells:
    """Divide a body's pixels, int64 [N], ascending, into cells. range_m: float32 [H * W], metres; labels: uint8 [H *
    W].
    """
    jump = np.float32(jump_m)
    index, place, points, named, noise = average_cells(range_m, pixels, labels, lens, jump)
    neighbours, normals = link_cells(index, place, points, lens, jump)
    return Cells(index, place, points, normals, neighbours, named, float(noise))
