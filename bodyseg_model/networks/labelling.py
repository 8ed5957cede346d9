"""Labels and confidences of pixels from scores that are coarser than the image: interpolation, best class, softmax.

All of it is specified here in single operations of float32, so that the compiled form, in `labelling_compiled`, gives
the same bits. Of the classes, only those count whose highest score at the four points around a pixel comes within
`REACH` of the score that some class has at all four: the best class is always among them, and all others together
change a confidence by less than 2e-4 (of the network that ships, by 4e-5 at most).
"""

from __future__ import annotations

import itertools
from functools import lru_cache
from importlib import import_module
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.kernels import use_compiled
from bodyseg_data.core.system.divided_work import of_each, pieces

REACH: Final = np.float32(12.0)
"""A class whose score is less than another's by as much has at most exp(-12), 6e-6, of its probability."""

LOG2_E: Final = np.float32(1.44269504)
LEAST_POWER: Final = np.float32(-120.0)
"""Powers of two below are taken as this one: still a normal number of float32."""

POWER: Final = tuple(np.float32(c) for c in (1.3333558e-3, 9.6181291e-3, 5.5504109e-2, 0.24022651, 0.69314718, 1.0))
"""Coefficients of 2^x for x from -1/2 to 1/2, highest power first: Taylor's series, within 4e-6 of the value."""

_CHUNK: Final = 1024
_PIECES: Final = 6  # of an image for several threads: a body is not evenly divided among its rows
_LEAST_PIXELS: Final = 1 << 13  # measured, of a thread: to start and await one takes as long as labelling some thousand

Axis = tuple[NDArray[np.int64], NDArray[np.float32]]
"""Of every pixel along an axis, the index of the score before it, from -1, and the weight of the score after it."""


def label_pixels(
    scores: NDArray[np.float32],
    range_m: NDArray[np.float32],
    stride: int,
    labels: NDArray[np.uint8],
    confidence: NDArray[np.float32],
    threads: int = 1,
) -> None:
    """Write labels and confidences of images' measured pixels, uint8 and float32 [B, H, W]; others stay as they are.

    scores: [B, ceil(H / stride), ceil(W / stride), C], finite, C contiguous; score (i, j) belongs to the point
    ((i + 1/2) stride, (j + 1/2) stride) of its image. range_m: [B, H, W], metres, 0 = nothing measured. threads: among
    which images and their rows are divided; the bits do not depend on it.
    """
    rows, columns = range_m.shape[1:]
    down, across = interpolation(rows, stride), interpolation(columns, stride)
    if not use_compiled():
        for image in zip(scores, range_m, labels, confidence, strict=True):
            _label_in_numpy(*image[:2], down, across, *image[2:])
        return
    loops = import_module("bodyseg_model.networks.labelling_compiled")
    useful = min(threads, max(1, int(np.count_nonzero(range_m > 0)) // _LEAST_PIXELS))
    runs = pieces(scores.shape[1] + 1, _PIECES if useful > 1 else 1)

    def work(part: tuple[int, tuple[int, int]]) -> None:
        image, run = part
        of_image = scores[image], range_m[image], stride, down[1], across[1]
        loops.label_rows(*of_image, *run, labels[image], confidence[image])

    of_each(work, list(itertools.product(range(len(scores)), runs)), useful)


@lru_cache(maxsize=64)
def interpolation(size: int, stride: int) -> Axis:
    """Neighbours and weights of `size` pixels between scores `stride` apart, both [size]."""
    twice = 2 * np.arange(size) + 1 - stride  # the pixel's centre less the first score's point, in half pixels
    before = twice // (2 * stride)
    after = (twice - 2 * stride * before) / (2 * stride)
    return before, after.astype(np.float32)


def _label_in_numpy(
    scores: NDArray[np.float32],
    range_m: NDArray[np.float32],
    down: Axis,
    across: Axis,
    labels: NDArray[np.uint8],
    confidence: NDArray[np.float32],
) -> None:
    """As `label_pixels`, of one image [H, W], some pixels at a time."""
    rows, columns = np.nonzero(range_m > 0)
    last_row, last_column = scores.shape[0] - 1, scores.shape[1] - 1
    for first in range(0, len(rows), _CHUNK):
        row, column = rows[first : first + _CHUNK], columns[first : first + _CHUNK]
        top, bottom = np.maximum(down[0][row], 0), np.minimum(down[0][row] + 1, last_row)
        left, right = np.maximum(across[0][column], 0), np.minimum(across[0][column] + 1, last_column)
        corners = scores[top, left], scores[top, right], scores[bottom, left], scores[bottom, right]
        best, share = label_points(*corners, down[1][row, None], across[1][column, None])
        labels[row, column], confidence[row, column] = best, share


def label_points(
    a: NDArray[np.float32],
    b: NDArray[np.float32],
    c: NDArray[np.float32],
    d: NDArray[np.float32],
    down: NDArray[np.float32],
    across: NDArray[np.float32],
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Best class, uint8 [N], and its probability, float32 [N], between scores a b above c d, each [N, C].

    down, across: weights of the lower and right ones, [N, 1].
    """
    lowest = np.minimum(np.minimum(a, b), np.minimum(c, d)).max(axis=1, keepdims=True)
    counts = np.maximum(np.maximum(a, b), np.maximum(c, d)) >= lowest - REACH
    above, below = a + (b - a) * across, c + (d - c) * across
    scores = np.where(counts, above + (below - above) * down, np.float32(-np.inf))
    label = scores.argmax(axis=1)
    power = np.maximum((scores - scores.max(axis=1, keepdims=True)) * LOG2_E, LEAST_POWER)
    terms = np.where(counts, powers_of_two(power), np.float32(0))
    total = np.zeros(len(a), np.float32)
    for term in terms.T:  # in the order of the classes: sums of float32 depend on it
        total += term
    return label.astype(np.uint8), np.float32(1) / total


def powers_of_two(power: NDArray[np.float32]) -> NDArray[np.float32]:
    """2 to the power of numbers from -120 to 0, float32 of any shape."""
    whole = (power - np.float32(0.5)).astype(np.int32)  # towards zero, so the nearest
    rest = power - whole.astype(np.float32)
    series = np.full_like(rest, POWER[0])
    for coefficient in POWER[1:]:
        series = series * rest + coefficient
    exponent: Any = (whole + np.int32(127)) << np.int32(23)
    return np.asarray(series * exponent.view(np.float32), np.float32)
