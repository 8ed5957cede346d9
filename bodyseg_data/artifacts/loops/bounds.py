"""Bounds of the shadow test, compiled: which pieces of the foreground lie near a texel that can shade them.

Most do not, and are lit where they face the projector. So a few bounds are projected for every piece, and its pixels
only where the bounds hold an occupied texel. Bounds are computed from the images themselves, with a margin for
rounding: no sample, whatever it holds, makes them wrong.
"""

from __future__ import annotations

from functools import partial
from typing import Any, Final

import numpy as np

from bodyseg_data.artifacts.loops.scratch import BLOCK, CHUNK
from bodyseg_data.core.kernels import compiled

_NONE: Final = np.float32(0)
_HALF: Final = np.float32(0.5)
_ONE: Final = np.float32(1)
_kernel = partial(compiled, feature="the compiled form of the artifacts")


@_kernel
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


@_kernel
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


@_kernel
def forget_occupied(shadow: Any, scratch: Any) -> None:
    """Leave `nearest` as it was before `mark_occupied`."""
    texels, nearest, columns, empty = shadow.texels, scratch.nearest, np.int64(shadow.columns), np.uint16(65535)
    for i in range(np.uint64(texels.size)):
        texel: Any = np.int64(texels[i])
        nearest[np.uint64(texel)] = empty
        nearest[np.uint64(max(texel - 1, 0))] = empty
        nearest[np.uint64(max(texel - columns, 0))] = empty
        nearest[np.uint64(max(texel - columns - 1, 0))] = empty


@_kernel
def column_shift(columns: Any) -> Any:
    """The power of two of columns that share a bit, so that 64 bits hold a row."""
    shift = np.int64(0)
    while (columns - 1) >> shift > 63:
        shift += 1
    return shift


@_kernel
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


@_kernel
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
