"""Scores interpolated at selected pixels, and the gradient of that, compiled: the bits of PyTorch's operations.

table: scores in a row, float32, or bfloat16 as the 16 bits of each. places: int64 [4, N], where in it the scores of the
classes at the four points around each pixel begin; shares: float32 [4, N], weight of each.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from bodyseg_data.core.kernels import compiled

_BFLOAT16, _HALF_LESS_ONE, _LAST = np.uint32(16), np.uint32(0x7FFF), np.uint32(1)
_kernel = partial(compiled, feature="interpolation of scores in compiled loops")


@_kernel
def interpolate(table: Any, places: Any, shares: Any, found: Any) -> None:
    """Write the interpolated scores, float32 [N, C]."""
    count, classes = found.shape
    corner = np.empty(classes, np.float32)
    bits = corner.view(np.uint32)
    for pixel in range(count):
        for point in range(4):
            start, share = places[point, pixel], shares[point, pixel]
            if table.itemsize == 2:
                for k in range(classes):
                    bits[k] = np.uint32(table[start + k]) << _BFLOAT16
            else:
                for k in range(classes):
                    corner[k] = table[start + k]
            if point == 0:
                for k in range(classes):
                    found[pixel, k] = corner[k] * share
            else:
                for k in range(classes):
                    found[pixel, k] += corner[k] * share


@_kernel
def add_gradient(gradient: Any, places: Any, shares: Any, rounded: Any, total: Any) -> None:
    """Add the gradient by the scores, from the one by the interpolated scores, both float32.

    gradient: [N, C]. rounded: whether each pixel's gradient by a point is rounded to bfloat16 first. total: in a row,
    as the table.
    """
    count, classes = gradient.shape
    corner = np.empty(classes, np.float32)
    bits = corner.view(np.uint32)
    for point in range(4):
        for pixel in range(count):
            start, share = places[point, pixel], shares[point, pixel]
            for k in range(classes):
                corner[k] = gradient[pixel, k] * share
            if rounded:
                for k in range(classes):
                    even = (bits[k] + _HALF_LESS_ONE + ((bits[k] >> _BFLOAT16) & _LAST)) >> _BFLOAT16
                    bits[k] = even << _BFLOAT16
            for k in range(classes):
                total[start + k] += corner[k]
