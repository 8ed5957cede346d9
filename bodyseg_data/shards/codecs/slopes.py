"""Ranges of a body, lossless, as what its surface's slope leaves over.

Surfaces are locally planar: the step from a pixel to the next one in its row is nearly the step in the row above. Where
the body is, the labels say, so there is one number for each of its pixels and none for background. All arithmetic is
modulo 65536. For the body's pixels inside the box, in reading order and regardless of where rows end:

    the first pixel of a stretch of body has its range stored, as a difference to the last such one;
    any other, the difference between its step from its neighbour and the last such step higher up in its column,
    0 if there was none.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.kernels import compiled, use_compiled
from bodyseg_data.core.parts import BACKGROUND
from bodyseg_data.shards.codecs.labels import split_labels
from bodyseg_data.shards.codecs.runs import Box, Bytes, Runs, escaped, escapes_of, from_planes, planes, unescaped

Range = NDArray[np.uint16]
Places = NDArray[np.int32]
_BACKGROUND: Final = int(BACKGROUND)


@dataclass(frozen=True)
class Slopes:
    """firsts: of each stretch of body, zigzag, as planes. steps: one zigzag byte for each other pixel; escapes: those
    that do not fit (`runs.escaped`).
    """

    firsts: Bytes
    steps: Bytes
    escapes: Bytes


def zigzag(change: Range) -> Range:
    """Differences modulo 65536 as numbers that are small where the difference is: 0, -1, 1, -2, ... -> 0, 1, 2, 3."""
    signed = change.view(np.int16)
    coded: Range = ((signed << 1) ^ (signed >> 15)).view(np.uint16)
    return coded


def unzigzag(coded: Range) -> Range:
    """The inverse of `zigzag`."""
    change: Range = (coded >> np.uint16(1)) ^ (np.uint16(0) - (coded & np.uint16(1)))
    return change


def stretches(runs: Runs) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Where stretches of body begin, in reading order [K], and how many pixels each has; runs: of label bytes."""
    body = np.concatenate([[False], runs.values != _BACKGROUND, [False]])
    ends = np.concatenate([[0], np.cumsum(runs.lengths)])
    edges = ends[np.flatnonzero(body[1:] != body[:-1])]
    return edges[::2], edges[1::2] - edges[::2]


def to_slopes(crop: Range, runs: Runs) -> Slopes:
    """crop: ranges in the box, 0 exactly where `runs`, those of its labels, say background."""
    flat = np.ascontiguousarray(crop).ravel()
    starts, _ = stretches(runs)
    change = np.diff(flat, prepend=np.uint16(0))
    inner = flat > 0
    inner[starts] = False
    # Down the columns, so that the last step above is the one before.
    columns, rows = np.nonzero(inner.reshape(crop.shape).T)
    place = rows * crop.shape[1] + columns
    step = change[place]
    above = np.zeros_like(step)
    above[1:] = np.where(columns[1:] == columns[:-1], step[:-1], 0)
    coded = np.zeros_like(flat)
    coded[place] = zigzag(step - above)
    firsts = planes(zigzag(np.diff(flat[starts], prepend=np.uint16(0))))
    return Slopes(firsts, *escaped(coded[inner], np.uint16))


def restore(
    runs: Runs, slopes: Slopes, box: Box, image: Range, labels: Bytes, facing: NDArray[np.bool_]
) -> Places | None:
    """Range, labels and whether the surface faces the projector, into images [H, W] that show nothing yet.

    runs: of label bytes, filling the box. Where the body begins, ends, begins ... in reading order (places in the flat
    image), if the compiled form made it.

    Raises ValueError if there are not as many numbers as the labels call for.
    """
    starts, lengths = stretches(runs)
    if len(slopes.firsts) != 2 * len(starts) or len(slopes.steps) != lengths.sum() - len(starts):
        raise ValueError(
            f"{len(starts)} stretches of {lengths.sum()} pixels of body, found {len(slopes.firsts) // 2} first "
            f"ranges and {len(slopes.steps)} others"
        )
    firsts = np.cumsum(unzigzag(from_planes(slopes.firsts, np.uint16)), dtype=np.uint16)
    if use_compiled():
        unzigzag_bytes, fill_ranges, fill_labels = _loops()
        steps = np.empty(len(slopes.steps), np.uint16)
        unzigzag_bytes(slopes.steps, *escapes_of(slopes.steps, slopes.escapes, np.uint16), steps)
        last = np.zeros(box.width, np.uint16)
        edges = np.empty(2 * (len(starts) + box.height), np.int32)  # a row's end divides at most one stretch
        count = fill_ranges(starts, lengths, firsts, steps, last, image, box.top, box.left, edges)
        fill_labels(runs.values, runs.lengths, labels, facing, box.top, box.left, box.width)
        return edges[:count]
    steps = unzigzag(unescaped(slopes.steps, slopes.escapes, np.uint16))
    stored = np.repeat(runs.values, runs.lengths).reshape(box.height, box.width)
    box.of(labels)[:], box.of(facing)[:] = split_labels(stored)
    body = stored != BACKGROUND
    np.multiply(_ranges(firsts, steps, starts, body), body, out=box.of(image))
    return None


def _ranges(firsts: Range, steps: Range, starts: NDArray[np.int64], body: NDArray[np.bool_]) -> Range:
    """The ranges in the box, and anything at all where there is no body."""
    inner = body.ravel().copy()
    inner[starts] = False
    crop: Range = np.zeros(body.shape, np.uint16)
    flat = crop.ravel()
    flat[inner] = steps
    np.cumsum(crop, axis=0, dtype=np.uint16, out=crop)
    # One running sum over all: at the first pixel of a stretch, whatever makes it hit that pixel's range.
    flat[starts] = 0
    if len(starts):
        gone = np.add.reduceat(flat, starts, dtype=np.uint16)
        flat[: starts[0]] = 0
        flat[starts] = np.diff(firsts, prepend=np.uint16(0))
        flat[starts[1:]] -= gone[:-1]
    np.cumsum(flat, dtype=np.uint16, out=flat)
    return crop


def _unzigzag_bytes(low: Any, where: Any, large: Any, steps: Any) -> None:
    """As `unzigzag` of `unescaped`; where, large: the place and value of each that is escaped."""
    for i in range(len(low)):
        coded = np.uint16(low[i])
        steps[i] = (coded >> np.uint16(1)) ^ (np.uint16(0) - (coded & np.uint16(1)))
    for i in range(len(where)):
        coded = large[i]
        steps[where[i]] = (coded >> np.uint16(1)) ^ (np.uint16(0) - (coded & np.uint16(1)))


def _fill_ranges(
    starts: Any, lengths: Any, firsts: Any, steps: Any, last: Any, image: Any, top: int, left: int, edges: Any
) -> int:
    """As `_ranges`, straight into the image; last: uint16 [width], zeros: the last step seen in each column.

    edges: room for where the body begins, ends, begins ...; their number is returned.
    """
    width, place, count_of_edges = len(last), 0, 0
    for stretch in range(len(starts)):
        row, column = top + starts[stretch] // width, starts[stretch] % width
        value = firsts[stretch]
        image[row, left + column] = value
        begin = row * image.shape[1] + left + column
        edges[count_of_edges] = begin
        end = begin + 1
        remaining, column = lengths[stretch] - 1, column + 1
        while remaining > 0:
            if column == width:
                row, column = row + 1, 0
                edges[count_of_edges + 1] = end
                count_of_edges += 2
                end = row * image.shape[1] + left
                edges[count_of_edges] = end
            count = min(remaining, width - column)
            end += count
            above, change = last[column : column + count], steps[place : place + count]
            ranges = image[row, left + column : left + column + count]
            for i in range(count):  # apart from the sum, so that several are done at once
                above[i] += change[i]
            for i in range(count):
                value += above[i]
                ranges[i] = value
            place, column, remaining = place + count, column + count, remaining - count
        edges[count_of_edges + 1] = end
        count_of_edges += 2
    return count_of_edges


def _fill_labels(values: Any, lengths: Any, labels: Any, facing: Any, top: int, left: int, width: int) -> None:
    """As `split_labels`, straight from the runs into images that hold background."""
    row, column = top, 0
    for run in range(len(values)):
        remaining = lengths[run]
        if values[run] == 255:
            column += remaining
            row, column = row + column // width, column % width
            continue
        label, faces = np.uint8(values[run] & 0xBF), (values[run] & 0x40) != 0
        while remaining > 0:
            count = min(remaining, width - column)
            begin, end = left + column, left + column + count
            labels[row, begin:end] = label
            facing[row, begin:end] = faces
            column, remaining = column + count, remaining - count
            if column == width:
                row, column = row + 1, 0


@lru_cache(maxsize=1)
def _loops() -> tuple[Any, Any, Any]:
    feature = "restoring ranges"
    return compiled(_unzigzag_bytes, feature), compiled(_fill_ranges, feature), compiled(_fill_labels, feature)
