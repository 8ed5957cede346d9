"""Surfaces and planes of a range image, compiled; `surfaces.py`, `surface_table.py` and `room_planes.py` have the NumPy
forms of the same bits.
"""

from __future__ import annotations

from functools import partial
from typing import Any, Final

import numpy as np

from bodyseg_data.core.kernels import compiled

_ONE: Final = np.float32(1)
_NONE: Final = np.float32(0)
_kernel = partial(compiled, feature="the compiled form of the background's removal")


@_kernel
def _root(parent: Any, run: Any) -> Any:
    """The root of a run; paths are halved on the way."""
    while parent[run] != run:
        parent[run] = parent[parent[run]]
        run = parent[run]
    return run


@_kernel
def _join(parent: Any, one: Any, other: Any) -> None:
    a, b = _root(parent, one), _root(parent, other)
    if a < b:
        parent[b] = a
    elif b < a:
        parent[a] = b


@_kernel
def number_surfaces(range_m: Any, level: Any, widest: Any, gap: Any, surface: Any, parent: Any) -> Any:
    """Number the connected surfaces as `surfaces.connected_surfaces` does, in `surface`, int32 [H, W].

    range_m, level: float32 [H, W]. widest: of a shadow, pixels at a range of 1 m, float32. gap: `GAP_PIXELS`. parent:
    int32 scratch for as many runs as there are pixels. Returns the number of surfaces.
    """
    rows, columns = range_m.shape
    runs = 0
    for row in range(rows):
        here, numbers = level[row], surface[row]
        last = -1  # the last measured column of the row
        for column in range(columns):
            value = here[column]
            if range_m[row, column] <= _NONE:
                numbers[column] = -1
                continue
            joined = False
            if last >= 0 and abs(value - here[last]) <= _ONE:
                joined = last == column - 1
                if not joined:  # across a hole
                    nearer = min(range_m[row, last], range_m[row, column])
                    joined = np.float64(column - last) <= max(np.float64(widest / nearer), np.float64(gap))
            if joined:
                run = numbers[last]
            else:
                run = np.int32(runs)
                parent[run] = run
                runs += 1
            numbers[column] = run
            last = column
            for shift in range(2, min(gap, column) + 1):
                other = numbers[column - shift]
                if other >= 0 and other != run and abs(value - here[column - shift]) <= _ONE:
                    _join(parent, other, run)
            stairs = True
            for shift in range(1, min(gap, row) + 1):
                # What smaller steps join needs no further look, nor does a pair of runs that the pixel before joined.
                stairs = stairs and abs(level[row - shift + 1, column] - level[row - shift, column]) <= _ONE
                if shift > 1 and stairs:
                    continue
                other = surface[row - shift, column]
                if other < 0 or abs(value - level[row - shift, column]) > _ONE:
                    continue
                if (
                    column > 0
                    and numbers[column - 1] == run
                    and surface[row - shift, column - 1] == other
                    and abs(here[column - 1] - level[row - shift, column - 1]) <= _ONE
                ):
                    continue
                _join(parent, other, run)
    count = 0
    for run in range(runs):  # a root comes before all that it is the root of
        if parent[run] == run:
            parent[run] = -1 - count
            count += 1
        else:
            above = parent[run]
            parent[run] = above if above < 0 else parent[above]
    for row in range(rows):
        for column in range(columns):
            run = surface[row, column]
            if run >= 0:
                surface[row, column] = -1 - parent[run]
    return count


@_kernel
def measure_surfaces(range_m: Any, surface: Any, focal_px: Any, area_m2: Any, ends: Any) -> None:
    """Add up areas, float64 [N], and write where each surface's pixels end among those of all, intp [N]."""
    rows, columns = range_m.shape
    for row in range(rows):
        for column in range(columns):
            number = surface[row, column]
            if number >= 0:
                side = np.float64(range_m[row, column]) / focal_px
                area_m2[number] += side * side
                ends[number] += 1
    for number in range(1, ends.size):
        ends[number] += ends[number - 1]


@_kernel
def sort_pixels(surface: Any, starts: Any, pixels: Any) -> None:
    """Write the flat indices of each surface's pixels, ascending, from its entry of `starts` on; starts move on."""
    rows, columns = surface.shape
    for row in range(rows):
        for column in range(columns):
            number = surface[row, column]
            if number >= 0:
                pixels[starts[number]] = row * columns + column
                starts[number] += 1


@_kernel
def bound_surfaces(range_m: Any, surface: Any, lowest: Any, highest: Any) -> None:
    """Write lowest and highest row, column and range of each surface, float64 [3, N] that hold inf and -inf."""
    rows, columns = range_m.shape
    for row in range(rows):
        for column in range(columns):
            number = surface[row, column]
            if number >= 0:
                z = np.float64(range_m[row, column])
                lowest[0, number] = min(lowest[0, number], np.float64(row))
                highest[0, number] = max(highest[0, number], np.float64(row))
                lowest[1, number] = min(lowest[1, number], np.float64(column))
                highest[1, number] = max(highest[1, number], np.float64(column))
                lowest[2, number] = min(lowest[2, number], z)
                highest[2, number] = max(highest[2, number], z)


@_kernel
def explained(judges: Any, normals: Any, offsets: Any, tolerance: Any, surface: Any) -> None:
    """Add the weight of every judge that a candidate plane explains to that candidate's `surface`, float64 [N].

    judges: float64 [4, M], x, y, inverse range and weight. normals: float64 [3, N]. offsets: float64 [N].
    """
    a, b, c = normals[0], normals[1], normals[2]
    for judge in range(judges.shape[1]):
        x, y, z, weight = judges[0, judge], judges[1, judge], judges[2, judge], judges[3, judge]
        for i in range(surface.size):
            away = x * a[i] + y * b[i] + z * c[i] - offsets[i]
            surface[i] += weight if abs(away) < tolerance * abs(c[i]) else 0.0


@_kernel
def moments(points: Any, plane: Any, tolerance: Any, sums: Any) -> None:
    """Add up the moments of points near a plane: of x, y, 1 and inverse range, in the order of `room_planes._moments`.

    points: float64 [N, 3]. plane: float64 [3]. sums: float64 [9].
    """
    a, b, c = plane[0], plane[1], plane[2]
    for i in range(points.shape[0]):
        x, y, inverse = points[i, 0], points[i, 1], points[i, 2]
        if abs(x * a + y * b + c - inverse) <= tolerance:
            sums[0] += x * x
            sums[1] += x * y
            sums[2] += x
            sums[3] += y * y
            sums[4] += y
            sums[5] += 1.0
            sums[6] += x * inverse
            sums[7] += y * inverse
            sums[8] += inverse


@_kernel
def mark_plane(flat: Any, pixels: Any, columns: Any, lens: Any, plane: Any, tolerance: Any, near: Any) -> Any:
    """Mark the pixels near a plane in `near`, bool [N]; returns the sum of their ranges cubed.

    flat: float32 ranges. lens: float64 [3], principal point and focal length, pixels.
    """
    a, b, c = plane[0], plane[1], plane[2]
    across, down, focal_px = lens[0], lens[1], lens[2]
    total = 0.0
    for i in range(pixels.size):
        pixel = pixels[i]
        row = pixel // columns
        z = np.float64(flat[pixel])
        x = (np.float64(pixel - row * columns) + 0.5 - across) / focal_px
        y = (np.float64(row) + 0.5 - down) / focal_px
        near[i] = abs(x * a + y * b + c - 1.0 / z) <= tolerance
        if near[i]:
            total += z * z * z
    return total
