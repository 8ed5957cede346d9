"""The painting of overlays, compiled, for `pictures.py`, which describes the colours.

flat: ranges of a frame, float32 [N], metres. shading: `pictures.Shading`. table: uint8 [M, 3], `pictures._table`.
picture: sRGB uint8 [N, 3].
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from bodyseg_data.core.kernels import compiled

_kernel = partial(compiled, feature="overlays", extra="segment")


@_kernel
def _shade(range_m: Any, shading: Any) -> Any:
    last = np.float32(shading.shades - 1)
    return np.intp(min(max((range_m - shading.near) * shading.scale + np.float32(0.5), np.float32(0)), last))


@_kernel
def paint_room(flat: Any, shading: Any, table: Any, picture: Any) -> None:
    """Paint the room: its measured pixels in the first shades of the table, others in the last."""
    nothing = table.shape[0] - 1
    for i in range(flat.size):
        colour = _shade(flat[i], shading) if 0 < flat[i] < np.inf else nothing
        for channel in range(3):
            picture[i, channel] = table[colour, channel]


@_kernel
def paint_body(flat: Any, labels: Any, pixels: Any, shading: Any, classes: Any, table: Any, picture: Any) -> None:
    """Paint a body's measured pixels in the shades of their labels, uint8 [N]; all labels from `classes` on alike."""
    for i in range(pixels.size):
        pixel = pixels[i]
        if 0 < flat[pixel] < np.inf:
            group = min(np.intp(labels[pixel]), classes)
            colour = (1 + group) * shading.shades + _shade(flat[pixel], shading)
            for channel in range(3):
                picture[pixel, channel] = table[colour, channel]
