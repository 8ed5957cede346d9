"""The shadow test, compiled: the operations of `occlusion.ShadowTest` in the same order, so the same bits.

Most of the foreground does not lie near a texel that can shade it, and is lit where it faces the projector. So a few
bounds are projected for every piece, and its pixels only where the bounds hold an occupied texel. Bounds are computed
from the images themselves, with a margin for rounding: no sample, whatever it holds, makes them wrong.

The loops take the foreground in chunks that stay in the first cache. Indices are unsigned, so that no code is made for
those that count from the end.
"""

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts.occlusion import ShadowTest
from bodyseg_data.artifacts.scratch import BLOCK, CHUNK, ROOM, constant
from bodyseg_data.machine import compiled
from bodyseg_data.samples import FARTHEST_STEPS

_NONE: Final = np.float32(0)
_HALF: Final = np.float32(0.5)
_ONE: Final = np.float32(1)
_OUTSIDE: Final = np.float32(np.nan)


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


@compiled
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


@compiled
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


@compiled
def row_of(texel: Any, row: Any, start: Any, columns: Any) -> Any:
    """Row of a texel and the first texel in it, from those of another that is near."""
    while texel >= start + columns:
        row += 1
        start += columns
    while texel < start:
        row -= 1
        start -= columns
    return row, start


@compiled
def mark_occupied(shadow: Any, scratch: Any) -> None:
    """Write the projector's image as the test reads it into `frame`, which holds nothing (`occlusion.framed`), and the
    least of it in windows of tiles into `coarse`.
    """
    texels, image, coarse, frame = shadow.texels, shadow.projector_range, scratch.coarse, scratch.frame
    columns, across, shift = np.int64(shadow.columns), np.int64(scratch.across), np.int64(scratch.shift)
    coarse[:] = 65535
    row, start = np.int64(0), np.int64(0)
    for i in range(np.uint64(texels.size)):
        texel: Any = np.int64(texels[i])
        row, start = row_of(texel, row, start, columns)
        value = np.uint16(image[np.uint64(texel)] - np.uint16(1))
        frame[np.uint64(texel + 2 * row + columns + 3)] = value
        tile = np.uint64((row >> (shift - 1)) * across + ((texel - start) >> shift))
        coarse[tile] = min(coarse[tile], value)
    repeat_border(frame, shadow.rows, shadow.columns)
    # At the end of a row this takes in tiles of the next row: a window there may be too near, never too far.
    for beside in (np.uint64(across), np.uint64(1), np.uint64(2)):
        for i in range(np.uint64(coarse.size) - beside):
            coarse[i] = min(coarse[i], coarse[i + beside])


@compiled
def forget_occupied(shadow: Any, scratch: Any) -> None:
    """Leave `frame` as it was before `mark_occupied`."""
    texels, frame, columns = shadow.texels, scratch.frame, np.int64(shadow.columns)
    row, start = np.int64(0), np.int64(0)
    for i in range(np.uint64(texels.size)):
        texel: Any = np.int64(texels[i])
        row, start = row_of(texel, row, start, columns)
        frame[np.uint64(texel + 2 * row + columns + 3)] = 65535
    repeat_border(frame, shadow.rows, shadow.columns)


@compiled
def repeat_border(frame: Any, rows: Any, columns: Any) -> None:
    """Repeat the border of the image in a flat frame around it."""
    stride = np.uint64(columns + 2)
    last = np.uint64(rows) * stride
    for i in range(stride):
        frame[i], frame[last + stride + i] = frame[stride + i], frame[last + i]
    one = np.uint64(1)
    for row in range(np.uint64(rows + 2)):
        left, right = row * stride, (row + one) * stride - one
        frame[left], frame[right] = frame[left + one], frame[right - one]


@compiled
def find_extremes(camera_range: Any, pieces: Any, found: Any, extremes: Any) -> None:
    """Write the least and the greatest range of each piece, or of more, into `extremes` 0 and 1."""
    size = np.int64(camera_range.size)
    for piece in range(np.uint64(found)):
        first = np.uint64(pieces[0, piece])
        least, greatest = np.uint16(65535), np.uint16(0)
        # Always as many pixels as a piece can have, for the compiler; less one, background is 65535, the farthest.
        span: Any = min(size - np.int64(first), BLOCK)
        for i in range(np.uint64(span)):
            z = camera_range[first + i]
            least = min(least, np.uint16(z - np.uint16(1)))
            greatest = max(greatest, z)
        extremes[0, piece] = np.float32(least) + _ONE
        extremes[1, piece] = np.float32(greatest)


@compiled
def bound_pieces(shadow: Any, pieces: Any, found: Any, extremes: Any, boxes: Any) -> None:
    """Write the first and last row and column of the texels that a piece's points can read into `boxes`, int32.

    A projection is a quotient of linear functions of the column, and of the range, so over both it is greatest and
    least at one of four extremes. Pieces that may reach out of the frame get a last row of -1. The fifth number is the
    range, less one step, from which on a texel cannot shade any of them.
    """
    p = shadow.projection
    offset_x, across_column, across_row, across_0, off_x = p[0, 0], p[0, 1], p[0, 2], p[0, 3], p[0, 4]
    offset_y, down_column, down_row, down_0, off_y = p[1, 0], p[1, 1], p[1, 2], p[1, 3], p[1, 4]
    offset_z, forward_column, forward_row, forward_0, off_z = p[2, 0], p[2, 1], p[2, 2], p[2, 3], p[2, 4]
    last_x, last_y = np.float32(shadow.columns) - _HALF, np.float32(shadow.rows) - _HALF
    last_column, last_row = np.int32(shadow.columns - 1), np.int32(shadow.rows - 1)
    firsts, lengths, rows = pieces[0], pieces[1], pieces[2]
    width = np.int32(shadow.width)
    # One step is far more than an interpolated range can be off by rounding.
    surely_lit = min(shadow.gap_steps, shadow.edge_steps) - _ONE
    for piece in range(np.uint64(found)):
        row, left = np.float32(rows[piece]), np.float32(np.int32(firsts[piece] - np.int32(rows[piece] * width)))
        right = left + np.float32(lengths[piece] - np.int32(1))
        near, far = extremes[0, piece], extremes[1, piece]
        across, down, forward = across_row * row + across_0, down_row * row + down_0, forward_row * row + forward_0
        left_x, right_x = across + across_column * left, across + across_column * right
        left_y, right_y = down + down_column * left, down + down_column * right
        left_z, right_z = forward + forward_column * left, forward + forward_column * right
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
        farthest = max(max(away_0, away_1), max(away_2, away_3)) + off_z
        boxes[4, piece] = np.int32(min(farthest, FARTHEST_STEPS) - surely_lit) + np.int32(1)


@compiled
def find_near(shadow: Any, pieces: Any, found: Any, scratch: Any) -> Any:
    """Find the pieces that face the projector and that a texel may shade; returns the number of their points.

    Writes the points' slopes (`ShadowTest`) and ranges into `floats`, and into row 4 of the pieces where there, or -1.
    """
    camera_range, of_columns, of_rows = shadow.camera_range, shadow.of_columns, shadow.of_rows
    boxes, coarse, floats = scratch.boxes, scratch.coarse, scratch.floats
    width, height = np.uint64(shadow.width), np.uint64(of_rows.size // 3)
    shift, half, across = np.int32(scratch.shift), np.int32(scratch.shift - 1), np.int32(scratch.across)
    second, third, fourth = np.uint64(ROOM), np.uint64(2 * ROOM), np.uint64(3 * ROOM)
    count = np.uint64(0)
    for piece in range(np.uint64(found)):
        low, high, top, bottom = boxes[0, piece], boxes[1, piece], boxes[2, piece], boxes[3, piece]
        faces, pieces[4, piece] = pieces[4, piece] != 0, np.int32(-1)
        low, high, top, bottom = low >> shift, high >> shift, top >> half, bottom >> half
        one, other = np.uint64(top * across + low), np.uint64(top * across + max(high - np.int32(3), low))
        near = min(coarse[one], coarse[other]) < boxes[4, piece]
        if faces and (near or bottom > top + 1 or high > low + 7 or bottom < 0):
            pieces[4, piece] = count
            first, row = np.uint64(pieces[0, piece]), np.uint64(pieces[2, piece])
            left = first - row * width
            of_row_x, of_row_y, of_row_z = of_rows[row], of_rows[height + row], of_rows[height + height + row]
            span = min(np.uint64(BLOCK), width - left)
            for i in range(span):
                floats[count + i] = np.float32(of_columns[left + i] + of_row_x)
                floats[second + count + i] = np.float32(of_columns[width + left + i] + of_row_y)
                floats[third + count + i] = np.float32(of_columns[width + width + left + i] + of_row_z)
            for i in range(span):
                floats[fourth + count + i] = np.float32(camera_range[first + i])
            count += np.uint64(pieces[1, piece])
    return count


@compiled
def read_texels(shadow: Any, count: Any, scratch: Any) -> None:
    """Project points, and read the four texels around them, less one step, into `texels`.

    Texel coordinates and range take the place of slopes in `floats`. Points outside the frame get NaN for their column,
    which no rule calls lit.
    """
    p, frame, floats, starts, texels = shadow.projection, scratch.frame, scratch.floats, scratch.ints, scratch.texels
    offset_x, offset_y, offset_z = p[0, 0], p[1, 0], p[2, 0]
    last_x, last_y = np.float32(shadow.columns) - _HALF, np.float32(shadow.rows) - _HALF
    stride = np.int32(shadow.columns + 2)
    second, third, fourth = np.uint64(ROOM), np.uint64(2 * ROOM), np.uint64(3 * ROOM)
    for point in range(np.uint64(count)):
        z = floats[fourth + point]
        away = z * floats[third + point] + offset_z
        x, y = (z * floats[point] + offset_x) / away, (z * floats[second + point] + offset_y) / away
        inside = (away > _NONE) & (x >= -_HALF) & (x < last_x) & (y >= -_HALF) & (y < last_y)
        floats[point], floats[second + point], floats[third + point] = x if inside else _OUTSIDE, y, away
        column = np.int32(np.floor(x if inside else _NONE)) + np.int32(1)
        row = np.int32(np.floor(y if inside else _NONE)) + np.int32(1)
        starts[point] = row * stride + column
    below, one = np.uint64(stride), np.uint64(1)
    for point in range(np.uint64(count)):
        at = np.uint64(starts[point])
        texels[point], texels[second + point] = frame[at], frame[at + one]
        texels[third + point], texels[fourth + point] = frame[at + below], frame[at + below + one]


@compiled
def decide(count: Any, floats: Any, texels: Any, gap_steps: Any, edge_steps: Any) -> None:
    """Write 1 into `floats` where light gets to, else 0."""
    second, third, fourth = np.uint64(ROOM), np.uint64(2 * ROOM), np.uint64(3 * ROOM)
    for point in range(np.uint64(count)):
        a, b = np.float32(texels[point]), np.float32(texels[second + point])
        c, d = np.float32(texels[third + point]), np.float32(texels[fourth + point])
        x, y = floats[point], floats[second + point]
        along, below = x - np.floor(x), y - np.floor(y)
        away = min(floats[third + point] - _ONE, FARTHEST_STEPS)
        upper, lower = a + along * (b - a), c + along * (d - c)
        surface = away - (upper + below * (lower - upper)) <= gap_steps
        limit = away - edge_steps
        votes = (_ONE - below) * (_ONE - along) if a >= limit else _NONE
        votes += (_ONE - below) * along if b >= limit else _NONE
        votes += below * (_ONE - along) if c >= limit else _NONE
        votes += below * along if d >= limit else _NONE
        torn = max(max(a, b), max(c, d)) - min(min(a, b), min(c, d)) >= edge_steps
        floats[point] = _ONE if (votes >= _HALF if torn else surface) else _NONE


@compiled
def mark_lit(shadow: Any, found: Any, scratch: Any, marks: Any, lit: Any) -> None:
    """Set `marks` to 1 for the points of a chunk's pieces that one projector lights and to 0 for the others.

    scratch: as `mark_occupied` left it for this projector. lit: points that need no answer, where `marks` may get
    either, as the other projector lights them; None without one: the compiler then leaves it out.
    """
    pieces, floats = scratch.pieces, scratch.floats
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
    count = find_near(shadow, pieces, found, scratch)
    read_texels(shadow, count, scratch)
    decide(count, floats, scratch.texels, shadow.gap_steps, shadow.edge_steps)
    for piece in range(np.uint64(found)):
        if pieces[4, piece] >= 0:
            point, at = np.uint64(pieces[3, piece]), np.uint64(pieces[4, piece])
            for i in range(np.uint64(pieces[1, piece])):
                marks[point + i] &= np.uint8(floats[at + i])


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
