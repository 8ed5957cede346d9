"""Lost pixels, compiled: the bits of the NumPy forms in `lost_pixels` and `losses`.

Images are flat, uint16, in steps; pixels: flat indices of the foreground in reading order; numbers are those of pixels.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from bodyseg_data.core.kernels import compiled

_kernel = partial(compiled, feature="the compiled form of the artifacts")


@_kernel
def lose_steep(image: Any, pixels: Any, bits: Any, limit: Any, angle: Any, from_rad: Any) -> None:
    """As `GrazingLoss.apply`; limit: of the bits, uint32."""
    for point in range(np.uint64(pixels.size)):
        pixel = np.uint64(pixels[point])
        lost = (np.uint32(bits[point]) < limit) & (angle[point] > from_rad)
        image[pixel] = np.uint16(0) if lost else image[pixel]


@_kernel
def lose_marked(image: Any, pixels: Any, bits: Any, limit: Any, marked: Any) -> None:
    """As `EdgeLoss.apply`; limit: of the bits, uint32; marked: whether a pixel of the image is at an edge."""
    for point in range(np.uint64(pixels.size)):
        pixel = np.uint64(pixels[point])
        lost = (np.uint32(bits[point]) < limit) & marked[pixel]
        image[pixel] = np.uint16(0) if lost else image[pixel]


@_kernel
def least_sums(pixels: Any, width: Any, down: Any, along: Any, values: Any) -> None:
    """The least sum of `down` at a pixel's row and of `along` at its column, over the rows of both.

    pixels: flat indices in a box of `width`; down, along: float32 [K, height] and [K, width].
    """
    row, end = np.int64(0), np.int64(width)
    for point in range(np.uint64(pixels.size)):
        pixel = np.int64(pixels[point])
        while pixel >= end:
            row += 1
            end += width
        column = np.uint64(pixel - (end - width))
        least = down[0, np.uint64(row)] + along[0, column]
        for each in range(np.uint64(1), np.uint64(down.shape[0])):
            least = min(least, down[each, np.uint64(row)] + along[each, column])
        values[point] = least


@_kernel
def mark_below(pixels: Any, values: Any, limit: Any, most: Any, marked: Any) -> None:
    """Mark pixels with a value below a limit, and the first of those at the limit, `most` in all, in bool [h, w].

    pixels: flat indices in it.
    """
    below = np.int64(0)
    for point in range(np.uint64(values.size)):
        below += np.int64(values[point] < limit)
    width, left = np.int64(marked.shape[1]), most - below
    row, end = np.int64(0), width
    for point in range(np.uint64(pixels.size)):
        pixel = np.int64(pixels[point])
        while pixel >= end:
            row += 1
            end += width
        first = values[point] == limit and left > 0
        left -= np.int64(first)
        marked[np.uint64(row), np.uint64(pixel - (end - width))] = values[point] < limit or first
