"""Where mistakes lie: the distance of a pixel to the nearest pixel with another part, and the errors at each distance.

A pixel has another part within a distance exactly if the largest or the smallest label within that distance, leaving
background out, is not its own. So the answer for one radius is a maximum over a disc, whatever the number of parts.
"""

from __future__ import annotations

from math import isqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.parts import BACKGROUND, PART_COUNT
from bodyseg_model.evaluation.mistakes import KIND_OF, KINDS

EDGES: Final = (1, 2, 4, 8, 16)
"""Upper ends of the bins but the last, pixels, included: 1, above 1 to 2, above 2 to 4, 4 to 8, 8 to 16, above 16."""

BIN_NAMES: Final = ("1", "1-2", "2-4", "4-8", "8-16", ">16")

_ROWS: Final = tuple(
    tuple(
        (number, away)
        for number, radius in enumerate(EDGES)
        for away in range(radius + 1)
        if isqrt(radius**2 - away**2) == reach
    )
    for reach in range(EDGES[-1] + 1)
)
"""For chords that reach so far to either side: (disc, rows away from its middle) that they belong to."""


def distance_bins(labels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Bin of every pixel's distance to the border of its part, uint8 [H, W], BACKGROUND where `labels` has it.

    The distance is Euclidean, from pixel centre to pixel centre, to the nearest pixel of the image that shows another
    part; background is no part. So 1 means beside a pixel of another part. labels: uint8 [H, W], 0..32 or BACKGROUND.
    """
    bins = np.full(labels.shape, BACKGROUND, np.uint8)
    body = labels != BACKGROUND
    rows, columns = np.flatnonzero(body.any(axis=1)), np.flatnonzero(body.any(axis=0))
    if not rows.size:
        return bins
    box = slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)
    inside = body[box]
    height, width = inside.shape
    # Two images whose maxima are the largest label and, counted from the other end, the smallest; 0 is background.
    # Rows lie one behind the other with background between them, so that every shift is one of flat memory.
    own = np.zeros((2, height, width + EDGES[-1]), np.uint8)
    own[0, :, :width] = (labels[box] + np.uint8(1)) * inside
    own[1, :, :width] = (np.uint8(PART_COUNT) - labels[box]) * inside
    stride = own.shape[2]
    own = own.reshape(2, -1)
    found = np.full(own.shape[1], len(EDGES), np.uint8)
    for disc in _discs(own, stride):
        alone = disc == own
        found -= ~(alone[0] & alone[1])
    bins[box][inside] = found.reshape(height, stride)[:, :width][inside]
    return bins


def _discs(own: NDArray[np.uint8], stride: int) -> list[NDArray[np.uint8]]:
    """Maxima over discs around every pixel, one image [2, N] for each radius of EDGES; stride: pixels of a row.

    A disc is a chord of pixels in every row: row by row, the same chords serve all discs.
    """
    chord, discs = own.copy(), [own.copy() for _ in EDGES]
    length = own.shape[1]
    for reach, rows in enumerate(_ROWS):
        if reach:
            np.maximum(chord[:, reach:], own[:, :-reach], out=chord[:, reach:])
            np.maximum(chord[:, :-reach], own[:, reach:], out=chord[:, :-reach])
        for number, away in rows:
            disc, shift = discs[number], away * stride
            if shift < length:
                np.maximum(disc[:, shift:], chord[:, : length - shift], out=disc[:, shift:])
                np.maximum(disc[:, : length - shift], chord[:, shift:], out=disc[:, : length - shift])
    return discs


class BorderErrors:
    """Counts pixels by distance and by kind of mistake. `counts`: int64 [6, 5], a row a bin, a column a kind."""

    def __init__(self) -> None:
        self.counts: NDArray[np.int64] = np.zeros((len(EDGES) + 1, len(KINDS)), np.int64)

    def add(self, pairs: NDArray[np.int64], bins: NDArray[np.uint8]) -> None:
        """Count pixels by their pair numbers, int64 [N] (`scores.pairs_of`), and their bins, uint8 [N]."""
        kinds = KIND_OF.ravel().take(pairs)
        self.counts += np.bincount(bins * np.uint8(len(KINDS)) + kinds, minlength=self.counts.size).reshape(
            self.counts.shape
        )
