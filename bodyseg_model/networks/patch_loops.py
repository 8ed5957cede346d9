"""Patches of range images and bits of bfloat16, compiled: the bits of `network.patches_of` in PyTorch's operations, and
within rounding those of `network.metric_patches`.
"""

from __future__ import annotations

from functools import partial
from typing import Any, Final

import numpy as np

from bodyseg_data.machine import compiled

BITS: Final = np.uint32(16)
"""Bits of a bfloat16: the upper ones of float32."""

_HALF_LESS_ONE, _LAST = np.uint32(0x7FFF), np.uint32(1)
_ZERO, _ONE = np.float32(0), np.float32(1)
_kernel = partial(compiled, feature="cutting range images into patches in a compiled loop")


@_kernel
def nearest(exact: Any) -> Any:
    """Round the bits of a float32, uint32, to those of the nearest bfloat16, ties to even, as the lower ones of 32."""
    return (exact + _HALF_LESS_ONE + ((exact >> BITS) & _LAST)) >> BITS


@_kernel
def cut_patches(range_m: Any, mean: Any, relief: Any, side: Any, values: Any, measured: Any) -> None:
    """Write the patches of images and the share of each that was measured, `Patches`.

    range_m: float32 [B, H, W], metres; mean: float32 [B], of what was measured. relief: float32, factor of
    centred ranges. values: [B, h, w, 2 side^2], the bits of float32 as int32 or of bfloat16 as int16, rounded to the
    nearest, ties to even. measured: float32 [B, h, w].
    """
    images, rows, columns = range_m.shape
    across, area = values.shape[2], side * side
    line = np.zeros((2, across * side), np.float32)  # one row of an image, centred, and what was measured in it
    bits = line.view(np.uint32)
    out = np.zeros(line.shape, values.dtype)
    for image in range(images):
        centre = mean[image]
        for down in range(values.shape[1]):
            height = min(side, rows - down * side)
            measured[image, down] = _ZERO
            values[image, down] = 0
            for row in range(height):
                metres = range_m[image, down * side + row]
                for column in range(columns):
                    seen = _ONE if metres[column] > _ZERO else _ZERO
                    line[0, column] = (metres[column] - centre) * seen * relief
                    line[1, column] = seen
                if values.itemsize == 2:
                    for channel in range(2):
                        for column in range(columns):
                            out[channel, column] = nearest(bits[channel, column])
                else:
                    for channel in range(2):
                        for column in range(columns):
                            out[channel, column] = bits[channel, column]
                for cell in range(across):
                    total = _ZERO
                    for column in range(cell * side, (cell + 1) * side):
                        total += line[1, column]
                    measured[image, down, cell] += total
                    to, start = values[image, down, cell], row * side
                    for k in range(side):
                        to[start + k] = out[0, cell * side + k]
                        to[area + start + k] = out[1, cell * side + k]
            for cell in range(across):
                measured[image, down, cell] /= area


@_kernel
def cut_metric_patches(range_m: Any, side: Any, focal: Any, values: Any, share: Any) -> None:
    """Write the patches of `network.metric_patches`, float32 [B, h, w, 2 side^2 + 7], and the share of each that was
    measured, float32 [B, h, w]. range_m: float32 [B, H, W], metres. focal: float32, pixels.
    """
    images, rows, columns = range_m.shape
    area, most = side * side, np.float32(3)
    for image in range(images):
        for down in range(values.shape[1]):
            y = ((np.float32(down) + np.float32(0.5)) * np.float32(side) - np.float32(rows) / 2) / focal
            for across in range(values.shape[2]):
                x = ((np.float32(across) + np.float32(0.5)) * np.float32(side) - np.float32(columns) / 2) / focal
                to, total, count = values[image, down, across], _ZERO, 0
                for k in range(side):
                    row = down * side + k
                    for n in range(side):
                        column = across * side + n
                        metres = range_m[image, row, column] if row < rows and column < columns else _ZERO
                        to[k * side + n] = metres
                        total += metres
                        count += 1 if metres > _ZERO else 0
                mean = total / np.float32(max(count, 1))
                for k in range(area):
                    known = _ONE if to[k] > _ZERO else _ZERO
                    to[k] = min(max((to[k] - mean) * (np.float32(10) * known), -most), most)
                    to[area + k] = known
                has = _ONE if count else _ZERO
                share[image, down, across] = np.float32(count) / np.float32(area)
                to[2 * area] = mean / most - has
                to[2 * area + 1] = has / max(mean, np.float32(0.3))
                to[2 * area + 2] = x * mean / np.float32(2)
                to[2 * area + 3] = y * mean / np.float32(2)
                to[2 * area + 4] = has
                to[2 * area + 5] = x
                to[2 * area + 6] = y
