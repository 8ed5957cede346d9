"""Lossless encoding of ranges as residuals of the surface's slope.

Surfaces are locally planar: the step from a pixel to the next one in its row nearly equals the step in the row above.
The labels define the foreground, so there is one number for each of its pixels and none for background. All arithmetic
is modulo 65536. For foreground pixels inside the box, in reading order across the ends of rows:

    the first pixel of a foreground run stores its range, as the difference from the previous first pixel;
    any other stores the difference between its step from its left neighbour and the last such step higher up in its
    column, 0 without one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.parts import BACKGROUND
from bodyseg_data.shards.codecs.labels import split_labels
from bodyseg_data.shards.codecs.runs import (
    Box,
    Bytes,
    Runs,
    escape_large,
    from_byte_planes,
    to_byte_planes,
    unescape,
)

Range = NDArray[np.uint16]
_BACKGROUND: Final = int(BACKGROUND)


@dataclass(frozen=True)
class Slopes:
    """Encoded ranges. firsts: of each foreground run, zigzag, as byte planes. steps: one zigzag byte for each other
    pixel. escapes: of steps above 254 (`runs.escape_large`).
    """

    firsts: Bytes
    steps: Bytes
    escapes: Bytes


def zigzag(change: Range) -> Range:
    """Encode differences modulo 65536 so that small ones become small numbers: 0, -1, 1, -2, ... -> 0, 1, 2, 3, ..."""
    signed = change.view(np.int16)
    coded: Range = ((signed << 1) ^ (signed >> 15)).view(np.uint16)
    return coded


def unzigzag(coded: Range) -> Range:
    """Decode differences, the inverse of `zigzag`."""
    change: Range = (coded >> np.uint16(1)) ^ (np.uint16(0) - (coded & np.uint16(1)))
    return change


def foreground_runs(runs: Runs) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Offsets in the flat box and lengths, pixels, [K] each, of foreground runs in order; runs: of label bytes."""
    body = np.concatenate([[False], runs.values != _BACKGROUND, [False]])
    ends = np.concatenate([[0], np.cumsum(runs.lengths)])
    edges = ends[np.flatnonzero(body[1:] != body[:-1])]
    return edges[::2], edges[1::2] - edges[::2]


def encode_slopes(crop: Range, runs: Runs) -> Slopes:
    """Encode `crop`, the ranges in the box, 0 exactly where `runs`, those of its label bytes, are background."""
    flat = np.ascontiguousarray(crop).ravel()
    starts, _ = foreground_runs(runs)
    change = np.diff(flat, prepend=np.uint16(0))
    inner = flat > 0
    inner[starts] = False
    # In column order, the last step above is the previous one.
    columns, rows = np.nonzero(inner.reshape(crop.shape).T)
    index = rows * crop.shape[1] + columns
    step = change[index]
    above = np.zeros_like(step)
    above[1:] = np.where(columns[1:] == columns[:-1], step[:-1], 0)
    coded = np.zeros_like(flat)
    coded[index] = zigzag(step - above)
    firsts = to_byte_planes(zigzag(np.diff(flat[starts], prepend=np.uint16(0))))
    return Slopes(firsts, *escape_large(coded[inner], np.uint16))


def decode_slopes(runs: Runs, slopes: Slopes, box: Box, image: Range, labels: Bytes, facing: NDArray[np.bool_]) -> None:
    """Decode range, labels and facing into images [H, W], whatever they hold.

    runs: of label bytes, filling the box. Raises ValueError if the labels require another number of values.
    """
    starts, lengths = foreground_runs(runs)
    if len(slopes.firsts) != 2 * len(starts) or len(slopes.steps) != lengths.sum() - len(starts):
        raise ValueError(
            f"{len(starts)} stretches of {lengths.sum()} pixels of body, found {len(slopes.firsts) // 2} first "
            f"ranges and {len(slopes.steps)} others"
        )
    firsts = np.cumsum(unzigzag(from_byte_planes(slopes.firsts, np.uint16)), dtype=np.uint16)
    steps = unzigzag(unescape(slopes.steps, slopes.escapes, np.uint16))
    image.fill(0)
    labels.fill(BACKGROUND)
    facing.fill(False)
    stored = np.repeat(runs.values, runs.lengths).reshape(box.height, box.width)
    box.crop(labels)[:], box.crop(facing)[:] = split_labels(stored)
    body = stored != BACKGROUND
    np.multiply(_ranges(firsts, steps, starts, body), body, out=box.crop(image))


def _ranges(firsts: Range, steps: Range, starts: NDArray[np.int64], body: NDArray[np.bool_]) -> Range:
    """Ranges in the box, arbitrary on background."""
    inner = body.ravel().copy()
    inner[starts] = False
    crop: Range = np.zeros(body.shape, np.uint16)
    flat = crop.ravel()
    flat[inner] = steps
    np.cumsum(crop, axis=0, dtype=np.uint16, out=crop)
    # One cumulative sum over all: the first pixel of a run gets the difference that makes the sum its range.
    flat[starts] = 0
    if len(starts):
        gone = np.add.reduceat(flat, starts, dtype=np.uint16)
        flat[: starts[0]] = 0
        flat[starts] = np.diff(firsts, prepend=np.uint16(0))
        flat[starts[1:]] -= gone[:-1]
    np.cumsum(flat, dtype=np.uint16, out=flat)
    return crop
