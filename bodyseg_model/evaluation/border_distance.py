"""Errors by distance to a border: the distance of a pixel to the nearest pixel of another class, and errors at each.

A pixel of another class is within a distance exactly if the largest or the smallest label within that distance,
background aside, differs from the pixel's own. So one radius takes maxima over a disc, whatever the number of classes.
"""

from __future__ import annotations

from math import isqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts.surface import box_of
from bodyseg_data.core.labels.label_map import PARTS33, LabelMap
from bodyseg_data.core.parts import BACKGROUND
from bodyseg_model.evaluation.mistakes import KINDS, kinds_of

EDGES: Final = (1, 2, 4, 8, 16)
"""Upper ends (included) of all bins but the last, pixels: up to 1, above 1 to 2, 2 to 4, 4 to 8, 8 to 16, above 16."""

BIN_NAMES: Final = ("1", "1-2", "2-4", "4-8", "8-16", ">16")

_ROWS: Final = tuple(
    tuple(
        (number, row)
        for number, radius in enumerate(EDGES)
        for row in range(radius + 1)
        if isqrt(radius**2 - row**2) == reach
    )
    for reach in range(EDGES[-1] + 1)
)
"""Reach of a chord to either side, pixels -> (disc, row from its centre) of all chords with that reach."""


def distance_bins(labels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Bin of every pixel's distance to another class, uint8 [H, W], BACKGROUND where `labels` has it.

    The distance is Euclidean, between pixel centres, to the nearest pixel of another class; background is none.
    Pixels at distance 1 are adjacent to another class. labels: uint8 [H, W], any or BACKGROUND.
    """
    bins = np.full(labels.shape, BACKGROUND, np.uint8)
    body = labels != BACKGROUND
    box = box_of(body)
    if box is None:
        return bins
    inside = body[box]
    height, width = inside.shape
    # Two images: maxima of the first give the largest label, of the second the smallest; 0 is background.
    # Rows are padded with background, so that every shift is a shift in flat memory.
    own = np.zeros((2, height, width + EDGES[-1]), np.uint8)
    own[0, :, :width] = (labels[box] + np.uint8(1)) * inside
    own[1, :, :width] = (np.uint8(BACKGROUND) - labels[box]) * inside
    stride = own.shape[2]
    own = own.reshape(2, -1)
    found = np.full(own.shape[1], len(EDGES), np.uint8)
    for disc in _discs(own, stride):
        same = disc == own
        found -= ~(same[0] & same[1])
    bins[box][inside] = found.reshape(height, stride)[:, :width][inside]
    return bins


def _discs(own: NDArray[np.uint8], stride: int) -> list[NDArray[np.uint8]]:
    """Maxima over discs around every pixel, one image [2, N] for each radius of EDGES; stride: pixels of a row.

    A disc is made of one chord a row; chords of equal length are computed once for all discs.
    """
    chord, discs = own.copy(), [own.copy() for _ in EDGES]
    length = own.shape[1]
    for reach, rows in enumerate(_ROWS):
        if reach:
            np.maximum(chord[:, reach:], own[:, :-reach], out=chord[:, reach:])
            np.maximum(chord[:, :-reach], own[:, reach:], out=chord[:, :-reach])
        for number, row in rows:
            disc, shift = discs[number], row * stride
            if shift < length:
                np.maximum(disc[:, shift:], chord[:, : length - shift], out=disc[:, shift:])
                np.maximum(disc[:, : length - shift], chord[:, shift:], out=disc[:, : length - shift])
    return discs


class BorderErrors:
    """Counts of pixels by distance and kind of mistake. counts: int64 [6, 5], row bin, column kind of `KINDS`."""

    def __init__(self, label_map: LabelMap = PARTS33) -> None:
        self._kinds = kinds_of(label_map).ravel()
        self.counts: NDArray[np.int64] = np.zeros((len(EDGES) + 1, len(KINDS)), np.int64)

    def __repr__(self) -> str:
        return f"BorderErrors({self.counts.sum()} pixels)"

    def add(self, pairs: NDArray[np.int64], bins: NDArray[np.uint8]) -> None:
        """Count pixels by their pair numbers, int64 [N] (`scores.pairs_of`), and their bins, uint8 [N]."""
        kinds = self._kinds.take(pairs)
        self.counts += np.bincount(bins * np.uint8(len(KINDS)) + kinds, minlength=self.counts.size).reshape(
            self.counts.shape
        )
