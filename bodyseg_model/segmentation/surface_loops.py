"""Surfaces and planes of a range image, compiled, for `surfaces.py`."""

from __future__ import annotations

from functools import partial
from typing import Any, Final

import numpy as np

from bodyseg_data.machine import compiled

_ONE: Final = np.float32(1)
_NOTHING: Final = np.float32(0)
_UNMEASURED: Final = np.float32(np.inf)
_kernel = partial(compiled, feature="labelling frames", extra="segment")


@_kernel
def write_levels(ranges: Any, logs: Any, first: Any, metres: Any, share: Any, limit: Any, level: Any) -> None:
    """Write the levels of rows, from the `first` on, into a framed image, as `surfaces.jumps` describes them.

    ranges: float32 [N, W], metres. logs: of range over `limit`, or of 1 where range is less, float32 [N, W]. Surfaces
    are divided by a difference of range of `metres`, or beyond `limit` of a `share`, float32.
    """
    for row in range(ranges.shape[0]):
        some, log, into = ranges[row], logs[row], level[first + row + 3, 3:]
        for i in range(np.uint64(some.size)):
            value = (log[i] + _ONE) / share if some[i] > limit else some[i] / metres
            into[i] = value if some[i] > _NOTHING else _UNMEASURED


@_kernel
def _root(parent: Any, number: Any) -> Any:
    """The root of a segment; paths are halved on the way."""
    while parent[number] != number:
        parent[number] = parent[parent[number]]
        number = parent[number]
    return number


@_kernel
def _join(parent: Any, one: Any, other: Any) -> None:
    if parent[one] == parent[other]:  # the usual case, found without a search
        return
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
def find_segments(frame: Any, first: Any, last: Any, found: Any, numbers: Any, room: Any) -> Any:
    """Divide the rows from `first` to before `last` of a `surfaces.LevelledFrame` into segments, adjacent pixels of one
    surface, and join those of one surface among these rows.

    Segments are numbered from first * W on, and written into `found`, the `surfaces.Segments`; the segments of the
    pixels of row r are written into `numbers`, int32 [4, W], at (r + 3) & 3, where those of the last rows stay. room:
    zeros for `_compare`, whole words of `marks`, and these words. Returns the number behind that of the last segment.
    """
    range_m, level, focal_px = frame.range_m, frame.level, frame.focal_px
    segments, parent, area_m2 = found.segments, found.parent, found.area_m2
    columns = range_m.shape[1]
    steps, begins, marks, words = room
    of_row = marks[:columns]
    for row in range(max(first - 3, 0), first):
        _compare(level, row + 3, steps, begins, of_row)
    count, start = first * columns, 0
    for row in range(first, last):
        _compare(level, row + 3, steps, begins, of_row)
        here, number = level[row + 3, 3:], numbers[(row + 3) & 3]
        shown = -1  # the last measured column so far
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
                for shift in range(1, min(row - first, 3) + 1):
                    if mark & (2 << shift):
                        _join(parent, numbers[(row + 3 - shift) & 3, column], count)
                if not mark & 2:
                    continue
                some, of_segment = range_m[row, start : column + 1], number[start : column + 1]
                of_segment[:] = count
                total = 0.0
                for i in range(some.size):
                    side = np.float64(some[i]) / focal_px
                    total += side * side
                area_m2[count] = total
                segments[0, count], segments[1, count] = row * columns + start, row * columns + column + 1
                if 0 <= shown < start - 1 and abs(here[start] - here[shown]) <= _ONE:
                    wide = max(np.float64(frame.widest / min(range_m[row, shown], range_m[row, start])), 3.0)
                    if np.float64(start - shown) <= wide:
                        _join(parent, number[shown], count)
                for right in range(start, min(start + 2, column) + 1):
                    for left in range(max(right - 3, 0), min(right - 1, start)):
                        if abs(here[right] - here[left]) <= _ONE:
                            _join(parent, number[left], count)
                shown = column
                count += 1
    return count


@_kernel
def join_pieces(frame: Any, row: Any, end: Any, found: Any, above: Any) -> None:
    """Join the segments of three rows from `row` on with those of the three rows above it, which another call of
    `find_segments` divided. end: the number behind that of the last segment from `row` on. above: `numbers` of that
    other call.
    """
    level, segments, parent, columns = frame.level, found.segments, found.parent, frame.range_m.shape[1]
    for segment in range(row * columns, end):
        first = segments[0, segment]
        line = first // columns
        if line >= row + 3:
            break
        for column in range(first - line * columns, segments[1, segment] - line * columns):
            for up in range(line - row + 1, 4):
                if abs(level[line + 3, column + 3] - level[line + 3 - up, column + 3]) <= _ONE:
                    _join(parent, above[(line - up + 3) & 3, column], segment)


@_kernel
def number_surfaces(firsts: Any, ends: Any, found: Any) -> Any:
    """Number the surfaces of `surfaces.Segments`, in the order of their first pixels, and move all segments and areas
    to the beginning. firsts, ends: int64 [N], the first segment of each run and the number behind its last. Returns the
    numbers of segments and surfaces.
    """
    segments, parent, area_m2 = found.segments, found.parent, found.area_m2
    count = surfaces = 0
    for run in range(firsts.size):
        for segment in range(firsts[run], ends[run]):  # a root comes before all that it is the root of
            above = parent[segment]
            if above == segment:
                segments[2, segment] = surfaces
                surfaces += 1
            else:
                segments[2, segment] = segments[2, above]
    for run in range(firsts.size):
        for segment in range(firsts[run], ends[run]):
            segments[0, count], segments[1, count] = segments[0, segment], segments[1, segment]
            segments[2, count], area_m2[count] = segments[2, segment], area_m2[segment]
            count += 1
    return count, surfaces


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
def extents(flat: Any, columns: Any, lens: Any, pixels: Any) -> Any:
    """Width, height and depth of ascending pixels, metres. flat: float32 ranges. lens: `surfaces.Lens`."""
    row, row_end = 0, columns
    left = top = near = np.inf
    right = bottom = far = -np.inf
    for i in range(pixels.size):
        pixel = pixels[i]
        while pixel >= row_end:
            row += 1
            row_end += columns
        z = np.float64(flat[pixel])
        x = (np.float64(pixel - row_end + columns) + 0.5 - lens.across) * z
        y = (np.float64(row) + 0.5 - lens.down) * z
        left, right = min(left, x), max(right, x)
        top, bottom = min(top, y), max(bottom, y)
        near, far = min(near, z), max(far, z)
    return (right - left) / lens.focal_px, (bottom - top) / lens.focal_px, far - near


@_kernel
def explained(judges: Any, corners: Any, tolerance: Any, planes: Any, surface: Any) -> None:
    """Write the plane through each triple of points into `planes`, float64 [4, N], its normal and offset; and add the
    area at each judge that it explains, as if it faced a camera of focal length 1, to `surface`, float64 [N].

    judges: float64 [M, 3], x, y and inverse range. corners: float64 [N, 3, 3].
    """
    a, b, c, offset = planes[0], planes[1], planes[2], planes[3]
    for i in range(surface.size):
        x, y, z = corners[i, 0]
        ux, uy, uz = corners[i, 1, 0] - x, corners[i, 1, 1] - y, corners[i, 1, 2] - z
        vx, vy, vz = corners[i, 2, 0] - x, corners[i, 2, 1] - y, corners[i, 2, 2] - z
        a[i], b[i], c[i] = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        offset[i] = a[i] * x + b[i] * y + c[i] * z
    for judge in range(judges.shape[0]):
        x, y, z = judges[judge, 0], judges[judge, 1], judges[judge, 2]
        side = 1.0 / z
        area = side * side
        for i in range(surface.size):
            away = x * a[i] + y * b[i] + z * c[i] - offset[i]
            surface[i] += area if abs(away) < tolerance * abs(c[i]) else 0.0


@_kernel
def mark_plane(
    flat: Any, pixels: Any, ends: Any, columns: Any, lens: Any, plane: Any, tolerance: Any, near: Any
) -> Any:
    """Mark those of ascending pixels near a plane in `near`, bool [N]; returns the sum of their ranges cubed.

    flat: float32 ranges. ends: the number of pixels before each row, and of all. lens: `surfaces.Lens`. plane: float64
    [3].
    """
    a, b, c = plane[0] / lens.focal_px, plane[1] / lens.focal_px, plane[2]
    total = 0.0
    for row in range(ends.size - 1):
        start = row * columns
        level = (np.float64(row) + 0.5 - lens.down) * b + c
        of_row, marks = pixels[ends[row] : ends[row + 1]], near[ends[row] : ends[row + 1]]
        for i in range(of_row.size):  # free of branches, so that the compiler takes many pixels at once
            x, z = np.float64(of_row[i] - start) + 0.5 - lens.across, np.float64(flat[np.uint64(of_row[i])])
            marks[i] = abs((x * a + level) * z - 1.0) <= tolerance * z
        for i in range(of_row.size):
            if marks[i]:
                z = np.float64(flat[np.uint64(of_row[i])])
                total += z * z * z
    return total
