"""Bounds of the shadow test, compiled: which pieces of the foreground lie near a texel that can shade them.

Most do not, and are lit where they face the projector. So a few bounds are projected for every piece, and its pixels
only where the bounds hold an occupied texel. Bounds are computed from the images themselves, with a margin for
rounding: no sample, whatever it holds, makes them wrong.

The shadow test compiled with numba: the operations of `artifacts/occlusion.py` in the same order, so the same bits.

The loops take the foreground in chunks that stay in the first cache, and project only the pixels that a texel may
shade (`bounds.py`). Indices are unsigned, so that no code is made for those that count from the end.
"""

from __future__ import annotations

from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts.occlusion import ShadowTest
from bodyseg_data.artifacts.scratch import BLOCK, CHUNK, ROOM, constant, scratch_for
from bodyseg_data.machine import compiled
from bodyseg_data.samples import FARTHEST_STEPS

_NONE: Final = np.float32(0)
_HALF: Final = np.float32(0.5)
_ONE: Final = np.float32(1)
_bounds_kernel = partial(compiled, feature="the compiled form of the artifacts")


@_bounds_kernel
def take_pieces(edges: Any, runs: Any, run: Any, taken: Any, row: Any, width: Any, block: Any, pieces: Any) -> Any:
    """Cut the next `CHUNK` foreground pixels, or what is left of them, into pieces of at most `block` within one row.

    run, taken, row: where the chunk before ended. pieces: first pixel, length and row of each, and its first point.
    Returns run, taken and row where this one ends, the number of pieces, and the number of points.
    """
    firsts, lengths, rows, points = pieces[0], pieces[1], pieces[2], pieces[3]
    count, found = np.int64(0), np.int64(0)
    row_end = (row + 1) * width
    while run < runs and count < CHUNK:
        first = np.int64(edges[np.uint64(2 * run)]) + taken
        left = np.int64(edges[np.uint64(2 * run + 1)]) - first
        while first >= row_end:
            row += 1
            row_end += width
        length = min(left, min(CHUNK - count, min(np.int64(block), row_end - first)))
        at = np.uint64(found)
        firsts[at], lengths[at], rows[at], points[at] = first, length, row, count
        found += 1
        count += length
        taken += length
        if length == left:
            run += 1
            taken = np.int64(0)
    return run, taken, row, found, count


@_bounds_kernel
def mark_occupied(shadow: Any, scratch: Any) -> None:
    """Note the texels that hold anything: in `coarse`, a bit for a few columns of a row, and in `nearest`, the least
    range, less one step, of the four texels that begin at one.

    To the left of the first column is the last one of the row above, where points are then looked at in vain.
    """
    texels, image, coarse, nearest = shadow.texels, shadow.projector_range, scratch.coarse, scratch.nearest
    columns = np.int64(shadow.columns)
    shift = column_shift(columns)
    for row in range(np.uint64(coarse.size)):
        coarse[row] = np.uint64(0)
    texel_row, start = np.int64(0), np.int64(0)
    for i in range(np.uint64(texels.size)):
        texel: Any = np.int64(texels[i])
        while texel >= start + columns:
            texel_row += 1
            start += columns
        while texel < start:
            texel_row -= 1
            start -= columns
        coarse[np.uint64(texel_row)] |= np.uint64(1) << np.uint64((texel - start) >> shift)
        value = np.uint16(image[np.uint64(texel)] - np.uint16(1))
        here, left = np.uint64(texel), np.uint64(max(texel - 1, 0))
        above, above_left = np.uint64(max(texel - columns, 0)), np.uint64(max(texel - columns - 1, 0))
        nearest[here] = min(nearest[here], value)
        nearest[left] = min(nearest[left], value)
        nearest[above] = min(nearest[above], value)
        nearest[above_left] = min(nearest[above_left], value)
    for row in range(np.uint64(shadow.rows)):
        coarse[row] |= coarse[row + np.uint64(1)] | coarse[row + np.uint64(2)] | coarse[row + np.uint64(3)]


@_bounds_kernel
def forget_occupied(shadow: Any, scratch: Any) -> None:
    """Leave `nearest` as it was before `mark_occupied`."""
    texels, nearest, columns, empty = shadow.texels, scratch.nearest, np.int64(shadow.columns), np.uint16(65535)
    for i in range(np.uint64(texels.size)):
        texel: Any = np.int64(texels[i])
        nearest[np.uint64(texel)] = empty
        nearest[np.uint64(max(texel - 1, 0))] = empty
        nearest[np.uint64(max(texel - columns, 0))] = empty
        nearest[np.uint64(max(texel - columns - 1, 0))] = empty


@_bounds_kernel
def column_shift(columns: Any) -> Any:
    """The power of two of columns that share a bit, so that 64 bits hold a row."""
    shift = np.int64(0)
    while (columns - 1) >> shift > 63:
        shift += 1
    return shift


@_bounds_kernel
def find_extremes(camera_range: Any, pieces: Any, found: Any, extremes: Any) -> None:
    """Write the least and the greatest range of each piece, or of more, into `extremes` 0 and 1."""
    size = np.int64(camera_range.size)
    for piece in range(np.uint64(found)):
        first = np.uint64(pieces[0, piece])
        least, greatest = np.uint16(65535), np.uint16(0)
        # As many pixels at a time as a piece can have, for the compiler; background, less one, is the farthest of all.
        span: Any = min(size - np.int64(first), BLOCK)
        for i in range(np.uint64(span)):
            z = camera_range[first + i]
            least = min(least, np.uint16(z - np.uint16(1)))
            greatest = max(greatest, z)
        extremes[0, piece] = np.float32(least) + _ONE
        extremes[1, piece] = np.float32(greatest)


@_bounds_kernel
def bound_pieces(shadow: Any, pieces: Any, found: Any, extremes: Any, boxes: Any) -> None:
    """Write the first and last row and column of the texels that a piece's points can read into `boxes`, int32.

    A projection is a quotient of linear functions of the column, and of the range, so over both it is greatest and
    least at one of four extremes. Pieces that may reach out of the frame get a last row of -1.
    """
    p = shadow.projection
    offset_x, across_column, across_row, across_0, off_x = p[0, 0], p[0, 1], p[0, 2], p[0, 3], p[0, 4]
    offset_y, down_column, down_row, down_0, off_y = p[1, 0], p[1, 1], p[1, 2], p[1, 3], p[1, 4]
    offset_z, forward_column, forward_row, forward_0, off_z = p[2, 0], p[2, 1], p[2, 2], p[2, 3], p[2, 4]
    last_x, last_y = np.float32(shadow.columns) - _HALF, np.float32(shadow.rows) - _HALF
    last_column, last_row = np.int32(shadow.columns - 1), np.int32(shadow.rows - 1)
    firsts, lengths, rows = pieces[0], pieces[1], pieces[2]
    width = np.int32(shadow.width)
    for piece in range(np.uint64(found)):
        row, left = np.float32(rows[piece]), np.float32(np.int32(firsts[piece] - np.int32(rows[piece] * width)))
        right = left + np.float32(lengths[piece] - np.int32(1))
        near, far = extremes[0, piece], extremes[1, piece]
        across, down, forward = across_row * row + across_0, down_row * row + down_0, forward_row * row + forward_0
        left_x, left_y, left_z = (
            across + across_column * left,
            down + down_column * left,
            forward + forward_column * left,
        )
        right_x, right_y, right_z = (
            across + across_column * right,
            down + down_column * right,
            forward + forward_column * right,
        )
        away_0, away_1 = near * left_z + offset_z, far * left_z + offset_z
        away_2, away_3 = near * right_z + offset_z, far * right_z + offset_z
        x_0, x_1 = (near * left_x + offset_x) / away_0, (far * left_x + offset_x) / away_1
        x_2, x_3 = (near * right_x + offset_x) / away_2, (far * right_x + offset_x) / away_3
        y_0, y_1 = (near * left_y + offset_y) / away_0, (far * left_y + offset_y) / away_1
        y_2, y_3 = (near * right_y + offset_y) / away_2, (far * right_y + offset_y) / away_3
        nearest = min(min(away_0, away_1), min(away_2, away_3))
        margin_x, margin_y = off_x / nearest, off_y / nearest
        x_low, x_high = min(min(x_0, x_1), min(x_2, x_3)) - margin_x, max(max(x_0, x_1), max(x_2, x_3)) + margin_x
        y_low, y_high = min(min(y_0, y_1), min(y_2, y_3)) - margin_y, max(max(y_0, y_1), max(y_2, y_3)) + margin_y
        inside = (nearest > off_z) & (x_low >= -_HALF) & (x_high < last_x)
        inside &= (y_low >= -_HALF) & (y_high < last_y)
        boxes[0, piece] = np.int32(max(x_low, _NONE)) if inside else np.int32(0)
        boxes[1, piece] = min(np.int32(max(x_high, _NONE)) + np.int32(1), last_column) if inside else np.int32(0)
        boxes[2, piece] = np.int32(max(y_low, _NONE)) if inside else np.int32(0)
        boxes[3, piece] = min(np.int32(max(y_high, _NONE)) + np.int32(1), last_row) if inside else np.int32(-1)


_OUTSIDE: Final = np.float32(np.nan)
_ALWAYS: Final = np.int32(2**30)
_kernel = partial(compiled, feature="the compiled form of the artifacts")


class Shadow(NamedTuple):
    """The input of `mark_lit` for one projector: flat constant arrays, and the rig's numbers.

    width: of the camera's image. rows, columns: of the projector's. of_columns, of_rows: those of x, y and range, one
    after the other; projection: float32 [3, 5]; all as in `ShadowTest`.
    """

    camera_range: NDArray[np.uint16]
    facing: NDArray[np.uint8]
    projector_range: NDArray[np.uint16]
    texels: NDArray[np.int32]
    width: int
    rows: int
    columns: int
    of_columns: NDArray[np.float64]
    of_rows: NDArray[np.float64]
    projection: NDArray[np.float32]
    gap_steps: np.float32
    edge_steps: np.float32


@_kernel
def find_runs(camera_range: Any, changes: Any, edges: Any) -> Any:
    """Find where foreground begins, ends, begins ... in reading order, into `edges`; returns the number of runs.

    changes: zeros behind the image.
    """
    size = np.uint64(camera_range.size)
    changes[0] = camera_range[0] != 0
    for pixel in range(np.uint64(1), size):
        changes[pixel] = (camera_range[pixel] != 0) != (camera_range[pixel - np.uint64(1)] != 0)
    words = changes.view(np.uint64)  # most of the image is alike: look at eight pixels at once
    count: Any = 0
    for word in range(np.uint64(words.size)):
        if words[word] != 0:
            for offset in range(np.uint64(8)):
                edges[count] = word * np.uint64(8) + offset
                count += np.int64(changes[word * np.uint64(8) + offset])
    if camera_range[size - np.uint64(1)] != 0:
        edges[count] = size
        count += 1
    return count // 2


@_kernel
def project_near(shadow: Any, pieces: Any, found: Any, scratch: Any) -> Any:
    """Project the points of pieces that face the projector and whose box holds an occupied texel; returns their number.

    Writes texel coordinates and range into `floats`, and into `ints` the point's index, its texel to the upper left,
    and from which range on a texel cannot shade it. Points outside the frame get NaN, which no rule calls lit.
    """
    camera_range, of_columns, of_rows = shadow.camera_range, shadow.of_columns, shadow.of_rows
    p, boxes, coarse, floats, ints = shadow.projection, scratch.boxes, scratch.coarse, scratch.floats, scratch.ints
    offset_x, offset_y, offset_z = p[0, 0], p[1, 0], p[2, 0]
    columns = np.int32(shadow.columns)
    last_x, last_y = np.float32(shadow.columns) - _HALF, np.float32(shadow.rows) - _HALF
    # A step is far more than what rounding can make of an interpolated range.
    surely_lit = min(shadow.gap_steps, shadow.edge_steps) - _ONE
    width, height = np.uint64(shadow.width), np.uint64(of_rows.size // 3)
    shift, one = np.uint64(column_shift(shadow.columns)), np.uint64(1)
    second, third = np.uint64(ROOM), np.uint64(2 * ROOM)
    count = np.uint64(0)
    for piece in range(np.uint64(found)):
        low, high, top, bottom = boxes[0, piece], boxes[1, piece], boxes[2, piece], boxes[3, piece]
        hit = bottom < 0
        if not hit and pieces[4, piece]:
            between = ((one << (np.uint64(high) >> shift)) << one) - (one << (np.uint64(low) >> shift))
            last: Any = max(bottom - 3, top)
            bits = coarse[np.uint64(top)] | coarse[np.uint64(last)]
            for texel_row in range(np.uint64(top + 4), np.uint64(max(last, top + 4))):
                bits |= coarse[texel_row]
            hit = bits & between != 0
        if hit:
            first, row, point = np.uint64(pieces[0, piece]), np.uint64(pieces[2, piece]), np.int32(pieces[3, piece])
            left = first - row * width
            of_row_x, of_row_y, of_row_z = of_rows[row], of_rows[height + row], of_rows[height + height + row]
            for i in range(min(np.uint64(BLOCK), width - left)):
                z = np.float32(camera_range[first + i])
                away = z * np.float32(of_columns[width + width + left + i] + of_row_z) + offset_z
                x = (z * np.float32(of_columns[left + i] + of_row_x) + offset_x) / away
                y = (z * np.float32(of_columns[width + left + i] + of_row_y) + offset_y) / away
                inside = (away > _NONE) & (x >= -_HALF) & (x < last_x) & (y >= -_HALF) & (y < last_y)
                texel_x = np.int32(max(np.floor(x), _NONE)) if inside else np.int32(0)
                texel_y = np.int32(max(np.floor(y), _NONE)) if inside else np.int32(0)
                limit = np.int32(min(away - _ONE, FARTHEST_STEPS) - surely_lit) + np.int32(1)
                floats[count + i] = x if inside else _OUTSIDE
                floats[second + count + i] = y
                floats[third + count + i] = away
                ints[count + i] = point + np.int32(i)
                ints[second + count + i] = texel_y * columns + texel_x
                ints[third + count + i] = limit if inside else _ALWAYS
            count += np.uint64(pieces[1, piece])
    return count


@_kernel
def read_texels(shadow: Any, count: Any, scratch: Any) -> Any:
    """Move the points that a texel may shade to the front of `floats` and of `ints`, and read their four texels, less
    one step, into `texels`. Returns their number.
    """
    image, floats, ints, texels = shadow.projector_range, scratch.floats, scratch.ints, scratch.texels
    nearest, candidates = scratch.nearest, scratch.candidates
    last_x, last_y = np.float32(shadow.columns - 1), np.float32(shadow.rows - 1)
    columns = np.uint64(shadow.columns)
    second, third, fourth = np.uint64(ROOM), np.uint64(2 * ROOM), np.uint64(3 * ROOM)
    hits = np.uint64(0)
    for point in range(np.uint64(count)):
        candidates[hits] = point
        hits += np.uint64(np.int32(nearest[np.uint64(ints[second + point])]) < ints[third + point])
    step = np.uint16(1)
    for hit in range(hits):
        found = np.uint64(candidates[hit])
        x, y, at = floats[found], floats[second + found], np.uint64(ints[second + found])
        floats[hit], floats[second + hit], floats[third + hit] = x, y, floats[third + found]
        ints[hit] = ints[found]
        # Beyond the border, the texel beside is the same one.
        right = np.uint64((x >= _NONE) & (x < last_x))
        below = columns if (y >= _NONE) & (y < last_y) else np.uint64(0)
        # One step off, an empty texel wraps round to 65535, which is behind every point, as it should be.
        texels[hit] = np.uint16(image[at] - step)
        texels[second + hit] = np.uint16(image[at + right] - step)
        texels[third + hit] = np.uint16(image[at + below] - step)
        texels[fourth + hit] = np.uint16(image[at + below + right] - step)
    return hits


@_kernel
def decide(hits: Any, floats: Any, texels: Any, gap_steps: Any, edge_steps: Any) -> None:
    """Write 1 into `floats` where light gets to, else 0."""
    second, third, fourth = np.uint64(ROOM), np.uint64(2 * ROOM), np.uint64(3 * ROOM)
    for hit in range(np.uint64(hits)):
        a, b = np.float32(texels[hit]), np.float32(texels[second + hit])
        c, d = np.float32(texels[third + hit]), np.float32(texels[fourth + hit])
        x, y = floats[hit], floats[second + hit]
        along, below = x - np.floor(x), y - np.floor(y)
        away = min(floats[third + hit] - _ONE, FARTHEST_STEPS)
        upper, lower = a + along * (b - a), c + along * (d - c)
        surface = away - (upper + below * (lower - upper)) <= gap_steps
        limit = away - edge_steps
        votes = (_ONE - below) * (_ONE - along) if a >= limit else _NONE
        votes += (_ONE - below) * along if b >= limit else _NONE
        votes += below * (_ONE - along) if c >= limit else _NONE
        votes += below * along if d >= limit else _NONE
        torn = max(max(a, b), max(c, d)) - min(min(a, b), min(c, d)) >= edge_steps
        floats[hit] = _ONE if (votes >= _HALF if torn else surface) else _NONE


@_kernel
def mark_lit(shadow: Any, found: Any, scratch: Any, marks: Any, lit: Any) -> None:
    """Set `marks` to 1 for the points of a chunk's pieces that one projector lights and to 0 for the others.

    scratch: as `mark_occupied` left it for this projector. lit: points that need no answer, where `marks` may get
    either, as the other projector lights them; None without one: the compiler then leaves it out.
    """
    pieces, floats, ints = scratch.pieces, scratch.floats, scratch.ints
    size = np.int64(shadow.camera_range.size)
    for piece in range(np.uint64(found)):
        first, point = np.uint64(pieces[0, piece]), np.uint64(pieces[3, piece])
        faces = np.uint8(0)
        span: Any = min(size - np.int64(first), BLOCK)
        for i in range(np.uint64(span)):
            marks[point + i] = shadow.facing[first + i]
            if lit is None:
                faces |= shadow.facing[first + i]
            else:
                faces |= shadow.facing[first + i] & (lit[point + i] ^ np.uint8(1))
        pieces[4, piece] = faces
    find_extremes(shadow.camera_range, pieces, found, scratch.extremes)
    bound_pieces(shadow, pieces, found, scratch.extremes, scratch.boxes)
    count = project_near(shadow, pieces, found, scratch)
    hits = read_texels(shadow, count, scratch)
    decide(hits, floats, scratch.texels, shadow.gap_steps, shadow.edge_steps)
    for hit in range(hits):
        marks[np.uint64(ints[hit])] &= np.uint8(floats[hit])


@_kernel
def lit_image(shadow: Any, scratch: Any, answer: Any) -> None:
    """Mark the pixels that are lit in `answer`, flat."""
    runs = find_runs(shadow.camera_range, scratch.changes, scratch.edges)
    mark_occupied(shadow, scratch)
    answer[:] = False
    run, taken, row = np.int64(0), np.int64(0), np.int64(0)
    pieces = scratch.pieces
    while run < runs:
        run, taken, row, found, _ = take_pieces(scratch.edges, runs, run, taken, row, shadow.width, BLOCK, pieces)
        mark_lit(shadow, found, scratch, scratch.marks, None)
        for piece in range(np.uint64(found)):
            first, point = np.uint64(pieces[0, piece]), np.uint64(pieces[3, piece])
            for i in range(np.uint64(pieces[1, piece])):
                answer[first + i] = scratch.marks[point + i] != 0
    forget_occupied(shadow, scratch)


def shadow_of(
    test: ShadowTest,
    camera_range: NDArray[np.uint16],
    projector_range: NDArray[np.uint16],
    faces_projector: NDArray[np.bool_],
    texels: NDArray[np.int32] | None = None,
) -> Shadow:
    """Check and gather the input of the compiled test, which checks no length itself.

    Raises BadSample as `ShadowTest.lit`. texels: flat indices of those that hold anything, if they are known.
    """
    test.check(camera_range, projector_range, faces_projector)
    camera, projector = test.rig.camera, test.rig.projector
    if texels is None:
        texels = np.flatnonzero(projector_range).astype(np.int32)
    images = constant(camera_range), constant(faces_projector.view(np.uint8)), constant(projector_range)
    sizes = camera.columns, projector.rows, projector.columns
    return Shadow(
        *images,
        constant(texels),
        *sizes,
        constant(test.of_columns),
        constant(test.of_rows),
        test.projection,
        test.gap_steps,
        test.edge_steps,
    )


def lit(
    test: ShadowTest,
    camera_range: NDArray[np.uint16],
    projector_range: NDArray[np.uint16],
    faces_projector: NDArray[np.bool_],
) -> NDArray[np.bool_]:
    """As `ShadowTest.lit`."""
    shadow = shadow_of(test, camera_range, projector_range, faces_projector)
    answer = np.empty(camera_range.shape, np.bool_)
    lit_image(shadow, scratch_for(camera_range.size, *projector_range.shape), answer.ravel())
    return answer
