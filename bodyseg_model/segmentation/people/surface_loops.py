"""Surfaces of a range image, compiled; `surfaces.py` and `surface_table.py` have the NumPy forms of the same bits."""

from __future__ import annotations

from functools import partial
from typing import Any, Final

import numpy as np

from bodyseg_data.core.kernels import compiled
from bodyseg_model.segmentation.people.surfaces import JUMP_M, JUMP_SHARE, LIMIT_M

_JUMP: Final = np.float32(JUMP_M)
_SHARE: Final = np.float32(JUMP_SHARE)
_LIMIT: Final = np.float32(LIMIT_M)
_ONE: Final = np.float32(1)
_NOTHING: Final = np.float32(0)
_UNMEASURED: Final = np.float32(np.inf)
_kernel = partial(compiled, feature="the compiled form of the background's removal")


@_kernel
def keep_within(flat: Any, near_m: Any, far_m: Any, kept: Any) -> None:
    """Write ranges from `near_m` to `far_m` into `kept`, 0 for others. All float32; flat, kept: [N]."""
    for i in range(np.uint64(flat.size)):
        value = flat[i]
        kept[i] = value if (value >= near_m) & (value <= far_m) else _NOTHING


@_kernel
def write_levels(ranges: Any, logs: Any, first: Any, level: Any) -> None:
    """Write the levels of rows, from the `first` on, into a framed image, as `surfaces.jumps` describes them.

    ranges: float32 [N, W], metres. logs: of range over `LIMIT_M`, or of 1 where range is less, float32 [N, W].
    """
    for row in range(ranges.shape[0]):
        some, log, into = ranges[row], logs[row], level[first + row + 3, 3:]
        for i in range(np.uint64(some.size)):
            value = (log[i] + _ONE) / _SHARE if some[i] > _LIMIT else some[i] / _JUMP
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
def find_segments(
    range_m: Any, level: Any, widest: Any, focal_px: Any, first: Any, last: Any, segments: Any, parent: Any,
    area_m2: Any, numbers: Any,
) -> Any:  # fmt: skip
    """Divide the rows from `first` to before `last` into segments, adjacent pixels of one surface, and join those of
    one surface among these rows.

    range_m: float32 [H, W]. level: float32 [3 + H, 3 + W + 2], from `surfaces.jumps`. widest: of a shadow, pixels at 1
    m, float32. Segments are numbered from first * W on. Writes the first flat index and one after the last of each into
    `segments`, int32 [3, H * W], a segment of the same surface that comes before it, or itself, into `parent`, int32
    [H * W], its area into `area_m2`, float64 [H * W], and the segments of the pixels of row r into `numbers`, int32
    [4, W], at (r + 3) & 3, where those of the last rows stay. Returns the number behind that of the last segment.
    """
    columns = range_m.shape[1]
    steps, begins = np.zeros((4, columns + 1), np.uint8), np.zeros((4, columns + 1), np.uint8)
    marks = np.zeros((columns + 7) // 8 * 8, np.uint8)
    words, of_row = marks.view(np.uint64), marks[:columns]
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
                    wide = max(np.float64(widest / min(range_m[row, shown], range_m[row, start])), 3.0)
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
def join_pieces(level: Any, columns: Any, row: Any, segments: Any, parent: Any, end: Any, above: Any) -> None:
    """Join the segments of three rows from `row` on with those of the three rows above it, which another call of
    `find_segments` divided. end: the number behind that of the last segment from `row` on. above: `numbers` of that
    other call.
    """
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
def number_surfaces(firsts: Any, ends: Any, parent: Any, segments: Any, area_m2: Any) -> Any:
    """Number the surfaces of segments, in the order of their first pixels, in `segments`, and move all segments to the
    beginning of it and of `area_m2`. firsts, ends: int64 [N], the first segment of each run and the number behind its
    last. Returns the numbers of segments and surfaces.
    """
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
