"""The painting of overlays, compiled; `overlay.py` has the NumPy forms of the same bits, and describes the colours.

flat: ranges of a frame, float32 [N], metres. near, scale: of `overlay._scale`. table: uint8 [M, 3], `overlay._table`.
picture: sRGB uint8 [N, 3].
"""

from __future__ import annotations

from functools import partial
from typing import Any, Final

import numpy as np

from bodyseg_data.core.kernels import compiled
from bodyseg_model.segmentation.pictures.overlay import SHADES

_LAST: Final = np.float32(SHADES - 1)
_HALF: Final = np.float32(0.5)
_kernel = partial(compiled, feature="the compiled form of overlays")


@_kernel
def _shade(range_m: Any, near: Any, scale: Any) -> Any:
    return np.intp(min(max((range_m - near) * scale + _HALF, np.float32(0)), _LAST))


@_kernel
def paint_room(flat: Any, near: Any, scale: Any, table: Any, picture: Any) -> None:
    """Paint the room: its measured pixels in the first shades of the table, others in the last."""
    nothing = table.shape[0] - 1
    for i in range(flat.size):
        colour = _shade(flat[i], near, scale) if flat[i] > 0 else nothing
        for channel in range(3):
            picture[i, channel] = table[colour, channel]


@_kernel
def paint_body(
    flat: Any, labels: Any, pixels: Any, near: Any, scale: Any, classes: Any, table: Any, picture: Any
) -> None:
    """Paint the pixels of a body in the shades of their labels, uint8 [N]; all labels from `classes` on alike."""
    for i in range(pixels.size):
        pixel = pixels[i]
        group = min(np.intp(labels[pixel]), classes)
        colour = (1 + group) * SHADES + _shade(flat[pixel], near, scale)
        for channel in range(3):
            picture[pixel, channel] = table[colour, channel]
