"""Labels and confidences from coarse scores in NumPy: the reference of the loops in `networks.labelling`."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bodyseg_model.networks.labelling import LEAST_POWER, LOG2_E, POWER, REACH, interpolation

_CHUNK = 1024


def label_in_numpy(
    scores: NDArray[np.float32],
    range_m: NDArray[np.float32],
    stride: int,
    labels: NDArray[np.uint8],
    confidence: NDArray[np.float32],
) -> None:
    """As `label_pixels`, of one image [H, W], some pixels at a time."""
    down, across = interpolation(range_m.shape[0], stride), interpolation(range_m.shape[1], stride)
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
