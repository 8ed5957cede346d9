"""Scores interpolated at selected pixels, and the gradient of that, compiled: the bits of PyTorch's operations.

table: scores in a row, the 32 bits of each float32 or the 16 of each bfloat16. places: int64 [4, N], where in it the
scores of the classes at the four points around each pixel begin; shares: float32 [4, N], weight of each.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from bodyseg_data.core.kernels import compiled
from bodyseg_model.networks.input.bfloat16 import BITS, nearest

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
                    bits[k] = np.uint32(table[start + k]) << BITS
            else:
                for k in range(classes):
                    bits[k] = table[start + k]
            if point == 0:
                for k in range(classes):
                    found[pixel, k] = corner[k] * share
            else:
                for k in range(classes):
                    found[pixel, k] += corner[k] * share


@_kernel
def add_gradient(gradient: Any, places: Any, shares: Any, ends: Any, table: Any) -> None:
    """Write the gradient by the scores, from the one by the interpolated scores, float32 [N, C].

    Pixels are in the order of their images. ends: int64 [B], the number of pixels of each image and those before it.
    table: of B equal parts, one for each image. A pixel's gradient by a point has the type of the scores; sums are in
    float32, point by point and pixel by pixel.
    """
    classes, rounded = gradient.shape[1], table.itemsize == 2
    size = table.size // ends.size
    total, corner = np.empty(size, np.float32), np.empty(classes, np.float32)
    bits, sums = corner.view(np.uint32), total.view(np.uint32)
    first = 0
    for image in range(ends.size):
        total[:] = np.float32(0)
        for point in range(4):
            for pixel in range(first, ends[image]):
                start, share = places[point, pixel] - image * size, shares[point, pixel]
                for k in range(classes):
                    corner[k] = gradient[pixel, k] * share
                if rounded:
                    for k in range(classes):
                        bits[k] = nearest(bits[k]) << BITS
                for k in range(classes):
                    total[start + k] += corner[k]
        part = table[image * size : (image + 1) * size]
        if rounded:
            for k in range(size):
                part[k] = nearest(sums[k])
        else:
            for k in range(size):
                part[k] = sums[k]
        first = ends[image]
