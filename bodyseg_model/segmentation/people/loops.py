"""Surfaces and planes of a range image, compiled; `surfaces.py`, `surface_table.py` and `room_planes.py` have the NumPy
forms of the same bits.
"""

from __future__ import annotations

from functools import partial
from typing import Any, Final

import numpy as np

from bodyseg_data.core.kernels import compiled

_ONE: Final = np.float32(1)
_NOTHING: Final = np.float32(0)
_UNMEASURED: Final = np.float32(np.inf)
_kernel = partial(compiled, feature="the compiled form of the background's removal")


@_kernel
def _root(parent: Any, number: Any) -> Any:
    """The root of a segment; paths are halved on the way."""
    while parent[number] != number:
        parent[number] = parent[parent[number]]
        number = parent[number]
    return number


@_kernel
def _join(parent: Any, one: Any, other: Any) -> None:
    a, b = _root(parent, one), _root(parent, other)
    if a < b:
        parent[b] = a
    elif b < a:
        parent[a] = b


@_kernel
def _compare(level: Any, row: Any, steps: Any, begins: Any, marks: Any) -> None:
    """Write what is to be looked at in a row of a framed image into `marks`, uint8: bit 0 where a segment begins, bit 1
    where one ends, bits 2 to 4 where a pixel is on one surface with the one 1 to 3 rows above and may be the first of
    its segment that is. steps, begins: uint8 [4, columns + 1] of this row and the three above, from column -1 on.

    Free of branches, so that the compiler compares many pixels at once.
    """
    columns = np.uint64(marks.size)
    here, left, right = level[row, 3:], level[row, 2:], level[row, 4:]
    above, above_2, above_3 = level[row - 1, 3:], level[row - 2, 3:], level[row - 3, 3:]
    step, step_1, step_2 = steps[row & 3], steps[(row - 1) & 3], steps[(row - 2) & 3]
    begin, begin_1, begin_2, begin_3 = (
        begins[row & 3],
        begins[(row - 1) & 3],
        begins[(row - 2) & 3],
        begins[(row - 3) & 3],
    )
    for i in range(columns):
        value, after = here[i], i + np.uint64(1)
        begin[after] = (value < _UNMEASURED) & (not abs(value - left[i]) <= _ONE)
        step[after] = abs(value - above[i]) <= _ONE
        marks[i] = (value < _UNMEASURED) & (not abs(value - right[i]) <= _ONE)
    for i in range(columns):
        after = i + np.uint64(1)
        stairs, stairs_before = step[after] & step_1[after], step[i] & step_1[i]
        two = np.uint8(abs(here[i] - above_2[i]) <= _ONE) & ~stairs
        two_before = np.uint8(abs(left[i] - level[row - 2, 2:][i]) <= _ONE) & ~stairs_before
        three = np.uint8(abs(here[i] - above_3[i]) <= _ONE) & ~(stairs & step_2[after])
        three_before = np.uint8(abs(left[i] - level[row - 3, 2:][i]) <= _ONE) & ~(stairs_before & step_2[i])
        new = begin[after]
        marks[i] = (
            new
            | (marks[i] << 1)
            | ((step[after] & (~step[i] | new | begin_1[after])) & 1) << 2
            | ((two & (~two_before | new | begin_2[after])) & 1) << 3
            | ((three & (~three_before | new | begin_3[after])) & 1) << 4
        )


@_kernel
def find_segments(
    range_m: Any, level: Any, widest: Any, focal_px: Any, segments: Any, parent: Any, area_m2: Any
) -> Any:
    """Divide rows into segments, adjacent pixels of one surface, and join those of one surface.

    range_m: float32 [H, W]. level: float32 [3 + H, 3 + W + 2], from `surfaces.jumps`. widest: of a shadow, pixels at 1
    m, float32. Writes the first flat index, one after the last, and the number of the surface of each segment into
    `segments`, int32 [3, N], and its area into
    `area_m2`, float64 [N]. parent: int32 [N], scratch. Returns the numbers of segments and surfaces.
    """
    rows, columns = range_m.shape
    steps, begins = np.zeros((4, columns + 1), np.uint8), np.zeros((4, columns + 1), np.uint8)
    marks = np.zeros((columns + 7) // 8 * 8, np.uint8)
    words, of_row = marks.view(np.uint64), marks[:columns]
    numbers = np.full((4, columns), -1, np.int32)
    count, start = 0, 0
    for row in range(rows):
        _compare(level, row + 3, steps, begins, of_row)
        here, number = level[row + 3, 3:], numbers[(row + 3) & 3]
        last = -1  # the last measured column so far
        for word in range(words.size):
            if words[word] == np.uint64(0):
                continue
            for column in range(8 * word, 8 * word + 8):
                mark = marks[column]
                if mark == 0:
                    continue
                if mark & 1:
                    start = column
                    parent[count] = count
                for shift in range(1, 4):
                    if mark & (2 << shift):
                        _join(parent, numbers[(row + 3 - shift) & 3, column], count)
                if not mark & 2:
                    continue
                total = 0.0
                for i in range(start, column + 1):
                    number[i] = count
                    side = np.float64(range_m[row, i]) / focal_px
                    total += side * side
                area_m2[count] = total
                segments[0, count], segments[1, count] = row * columns + start, row * columns + column + 1
                if 0 <= last < start - 1 and abs(here[start] - here[last]) <= _ONE:
                    wide = max(np.float64(widest / min(range_m[row, last], range_m[row, start])), 3.0)
                    if np.float64(start - last) <= wide:
                        _join(parent, number[last], count)
                for right in range(start, min(start + 2, column) + 1):
                    for left in range(max(right - 3, 0), min(right - 1, start)):
                        if abs(here[right] - here[left]) <= _ONE:
                            _join(parent, number[left], count)
                last = column
                count += 1
    surfaces = 0
    for segment in range(count):  # a root comes before all that it is the root of
        above = parent[segment]
        if above == segment:
            segments[2, segment] = surfaces
            surfaces += 1
        else:
            segments[2, segment] = segments[2, above]
    return count, surfaces


@_kernel
def paint_surfaces(segments: Any, flat: Any) -> None:
    """Write the number of every segment's surface into its pixels of a flat image."""
    for segment in range(segments.shape[1]):
        for pixel in range(segments[0, segment], segments[1, segment]):
            flat[pixel] = segments[2, segment]


@_kernel
def measure_surfaces(segments: Any, segment_m2: Any, area_m2: Any, counts: Any) -> None:
    """Add up areas, float64 [N], and numbers of pixels, intp [N], of surfaces."""
    for segment in range(segments.shape[1]):
        number = segments[2, segment]
        area_m2[number] += segment_m2[segment]
        counts[number] += segments[1, segment] - segments[0, segment]


@_kernel
def list_pixels(segments: Any, number: Any, pixels: Any) -> None:
    """Write the flat indices of a surface's pixels, ascending."""
    count = 0
    for segment in range(segments.shape[1]):
        if segments[2, segment] == number:
            first = segments[0, segment]
            long = segments[1, segment] - first
            of_segment = pixels[count : count + long]
            for i in range(long):
                of_segment[i] = first + i
            count += long


@_kernel
def bound_surfaces(flat: Any, columns: Any, segments: Any, lowest: Any, highest: Any) -> None:
    """Write lowest and highest row, column and range of each surface, float64 [3, N] that hold inf and -inf."""
    for segment in range(segments.shape[1]):
        first, end, number = segments[0, segment], segments[1, segment], segments[2, segment]
        row = first // columns
        nearest = farthest = flat[first]
        for pixel in range(first + 1, end):
            nearest, farthest = min(nearest, flat[pixel]), max(farthest, flat[pixel])
        lowest[0, number] = min(lowest[0, number], np.float64(row))
        highest[0, number] = max(highest[0, number], np.float64(row))
        lowest[1, number] = min(lowest[1, number], np.float64(first - row * columns))
        highest[1, number] = max(highest[1, number], np.float64(end - 1 - row * columns))
        lowest[2, number] = min(lowest[2, number], np.float64(nearest))
        highest[2, number] = max(highest[2, number], np.float64(farthest))


@_kernel
def remove_pixels(range_m: Any, level: Any, pixels: Any, gone: Any) -> None:
    """Make those of ascending pixels that are `gone` unmeasured in a range image, and in its framed `level`."""
    columns, first = range_m.shape[1], 0
    while first < pixels.size:
        row = pixels[first] // columns
        start = row * columns
        end = first + np.searchsorted(pixels[first : first + columns], start + columns)
        ranges, levels = range_m[row], level[row + 3, 3:]
        for i in range(first, end):
            if gone[i]:
                column = np.uint64(pixels[i] - start)
                ranges[column] = _NOTHING
                levels[column] = _UNMEASURED
        first = end


@_kernel
def extents(flat: Any, columns: Any, centre: Any, pixels: Any) -> Any:
    """Width and height, times the focal length, and depth of pixels, ascending; centre: float64 [2]."""
    row, row_end = 0, columns
    left = top = near = np.inf
    right = bottom = far = -np.inf
    for i in range(pixels.size):
        pixel = pixels[i]
        while pixel >= row_end:
            row += 1
            row_end += columns
        z = np.float64(flat[pixel])
        x = (np.float64(pixel - row_end + columns) + 0.5 - centre[0]) * z
        y = (np.float64(row) + 0.5 - centre[1]) * z
        left, right = min(left, x), max(right, x)
        top, bottom = min(top, y), max(bottom, y)
        near, far = min(near, z), max(far, z)
    return right - left, bottom - top, far - near


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
    """Mark those of ascending pixels near a plane in `near`, bool [N]; returns the sum of their ranges cubed.

    flat: float32 ranges. lens: float64 [3], principal point and focal length, pixels.
    """
    a, b, c = plane[0], plane[1], plane[2]
    across, down, focal_px = lens[0], lens[1], lens[2]
    total, first = 0.0, 0
    while first < pixels.size:
        row = pixels[first] // columns
        start = row * columns
        end = first + np.searchsorted(pixels[first : first + columns], start + columns)
        y = (np.float64(row) + 0.5 - down) / focal_px * b
        of_row, marks = pixels[first:end], near[first:end]
        for i in range(of_row.size):  # free of branches, so that the compiler takes many pixels at once
            x = (np.float64(of_row[i] - start) + 0.5 - across) / focal_px
            marks[i] = abs(x * a + y + c - 1.0 / np.float64(flat[np.uint64(of_row[i])])) <= tolerance
        for i in range(of_row.size):
            if marks[i]:
                z = np.float64(flat[np.uint64(of_row[i])])
                total += z * z * z
        first = end
    return total
