"""The network of shapes, compiled; `shape_network.py` has the NumPy forms of the same bits."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from bodyseg_data.core.kernels import compiled
from bodyseg_model.segmentation.order_loops import median
from bodyseg_model.segmentation.people.shape_network import CURVED_M, MOST, RANGE_M, SIDE

_MOST = np.float32(MOST)
_BULGE = np.float32(RANGE_M / CURVED_M)
_ZERO, _ONE = np.float32(0), np.float32(1)
_kernel = partial(compiled, feature="the compiled form of the network of shapes")


@_kernel
def place_cells(cells: Any, image: Any) -> None:
    """As `shape_network.shape_image`, into `image`, float32 [2, 48, 48] of zeros."""
    known, count = np.empty(cells.size), 0
    for row in range(cells.shape[0]):
        for column in range(cells.shape[1]):
            if np.isfinite(cells[row, column]):
                known[count] = cells[row, column]
                count += 1
    if count == 0:
        return
    middle = median(known[:count])
    down, across = min(cells.shape[0], SIDE), min(cells.shape[1], SIDE)
    top, left = (cells.shape[0] - down) // 2, (cells.shape[1] - across) // 2
    first, before = (SIDE - down) // 2, (SIDE - across) // 2
    for row in range(down):
        for column in range(across):
            cell = cells[top + row, left + column]
            if np.isfinite(cell):
                image[0, first + row, before + column] = min(max((cell - middle) / RANGE_M, -MOST), MOST)
                image[1, first + row, before + column] = 1


@_kernel
def _curvature(image: Any, framed: Any) -> None:
    """As `shape_network.with_curvature`, of an image [2, 48, 48] into `framed`, float32 [3, 50, 50], whose border is
    0.
    """
    for row in range(SIDE):
        for column in range(SIDE):
            framed[0, row + 1, column + 1] = image[0, row, column] * image[1, row, column]
            framed[1, row + 1, column + 1] = image[1, row, column]
    rows = np.empty((2, SIDE + 2), np.float32)
    for row in range(SIDE):
        for k in range(2):
            above, here, below = framed[k, row], framed[k, row + 1], framed[k, row + 2]
            for i in range(SIDE + 2):
                rows[k, i] = above[i] + here[i] + below[i]
        for i in range(SIDE):
            total = rows[0, i] + rows[0, i + 1] + rows[0, i + 2]
            count = rows[1, i] + rows[1, i + 1] + rows[1, i + 2]
            away = (image[0, row, i] - total / max(count, _ONE)) * image[1, row, i] * _BULGE
            framed[2, row + 1, i + 1] = min(max(away, -_MOST), _MOST)
    framed[0, 1:-1, 1:-1] = image[0]


@_kernel
def _half(framed: Any, weight: Any, bias: Any, found: Any) -> None:
    """As `shape_network._half`, of an image in a border of zeros, into the middle of `found`, in one, too."""
    out, count, side, _ = weight.shape
    rows, columns = found.shape[1] - 2, found.shape[2] - 2
    taps = np.empty((count * side * side, rows * columns), np.float32)
    tap = 0
    for channel in range(count):
        for down in range(side):
            for across in range(side):
                for row in range(rows):
                    of_row, to = framed[channel, 2 * row + down, across:], taps[tap, row * columns :]
                    for column in range(columns):
                        to[column] = of_row[2 * column]
                tap += 1
    weights = weight.reshape(out, tap)
    sums = np.empty(rows * columns, np.float32)
    for k in range(out):
        sums[:] = 0
        for tap in range(weights.shape[1]):
            factor, values = weights[k, tap], taps[tap]
            for i in range(sums.size):
                sums[i] += factor * values[i]
        for row in range(rows):
            for column in range(columns):
                found[k, row + 1, column + 1] = max(sums[row * columns + column] + bias[k], _ZERO)


@_kernel
def logit(image: Any, measures: Any, one: Any, two: Any, three: Any, hidden: Any, out: Any) -> Any:
    """As `ShapeNetwork.logit`. measures: float32 [16]. Layers: weight and bias of each."""
    framed = np.zeros((3, SIDE + 2, SIDE + 2), np.float32)
    _curvature(image, framed)
    first = np.zeros((one[1].size, SIDE // 2 + 2, SIDE // 2 + 2), np.float32)
    _half(framed, one[0], one[1], first)
    second = np.zeros((two[1].size, SIDE // 4 + 2, SIDE // 4 + 2), np.float32)
    _half(first, two[0], two[1], second)
    last, side = np.zeros((three[1].size, SIDE // 8 + 2, SIDE // 8 + 2), np.float32), SIDE // 8
    _half(second, three[0], three[1], last)
    channels = last.shape[0]
    seen = np.empty(2 * channels + measures.size, np.float32)
    for k in range(channels):
        total, most = _ZERO, _ZERO
        for row in range(side):
            for column in range(side):
                value = last[k, row + 1, column + 1]
                total, most = total + value, max(most, value)
        seen[k], seen[channels + k] = total / np.float32(side * side), most
    seen[2 * channels :] = measures
    answer = _ZERO
    for k in range(hidden[1].size):
        total = _ZERO
        for i in range(seen.size):
            total += hidden[0][k, i] * seen[i]
        answer += out[0][0, k] * max(total + hidden[1][k], _ZERO)
    return np.float64(answer + out[1][0])
