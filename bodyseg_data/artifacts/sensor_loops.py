"""Mixed pixels, compiled: the bits of `mixed_pixels`."""

from typing import Any

import numpy as np

from bodyseg_data.machine import compiled

_MOST = np.float64(65535)


@compiled
def mix(
    image: Any, clean: Any, columns: Any, pixels: Any, bits: Any, limit: Any, behind: Any, jump_mm: Any, step_m: Any
) -> None:
    """As `MixedPixels.apply`; pixels: flat indices of the foreground; limit: of the higher half of bits; behind:
    background, in steps.
    """
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
            image[pixel] = np.uint16(np.int32(min(value_f, _MOST)))
