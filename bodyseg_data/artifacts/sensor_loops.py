"""Lost and mixed pixels, compiled: the bits of `lost_pixels` and `mixed_pixels`.

pixels: flat indices of the foreground in reading order.
"""

from functools import partial
from typing import Any

import numpy as np

from bodyseg_data.machine import compiled

_LEAST, _MOST = np.float64(1), np.float64(65535)
_kernel = partial(compiled, feature="the compiled form of the artifacts")


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


@_kernel
def mix(
    image: Any, clean: Any, columns: Any, pixels: Any, bits: Any, limit: Any, behind: Any, jump_mm: Any, step_m: Any
) -> None:
    """As `MixedPixels.apply`; limit: of the higher half of bits; behind: background, in steps."""
    size = clean.size
    for point in range(pixels.size):
        pixel = np.int64(pixels[point])
        before = image[pixel]
        if before == 0 or np.float64(bits[point] >> np.uint32(16)) >= limit:
            continue
        column = pixel % columns
        farthest = np.int64(0)
        above, below, left, right = pixel >= columns, pixel + columns < size, column > 0, column < columns - 1
        for inside, step in ((above, -columns), (below, columns), (left, np.int64(-1)), (right, np.int64(1))):
            if inside:
                value = np.int64(clean[pixel + step])
                farthest = max(farthest, value if value > 0 else behind)
        gap = farthest - np.int64(clean[pixel])
        if gap * step_m * 1000 >= jump_mm:
            position = np.float64(bits[point] & np.uint32(0xFFFF)) / 65536
            value_f = np.rint(np.float64(before) + gap * position)
            image[pixel] = np.uint16(np.int32(min(max(value_f, _LEAST), _MOST)))
