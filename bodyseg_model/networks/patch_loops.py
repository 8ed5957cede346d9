"""Patches of range images, compiled: `network.patches_of` to the bit, `network.metric_patches` within rounding."""

from typing import Any

import numpy as np

from bodyseg_data.machine import compiled

_ZERO, _ONE = np.float32(0), np.float32(1)


@compiled
def cut_patches(range_m: Any, mean: Any, relief: Any, side: Any, focal: Any, values: Any, share: Any) -> None:
    """Write the patches of images and the share of each that was measured, `Patches`: those of `network.metric_patches`
    for a focal length, float32, pixels, else of `network.patches_of`.

    range_m: float32 [B, H, W], metres; mean: float32 [B], of what was measured. relief: float32, factor of centred
    ranges; both for patches without a focal length, 0, alone. values: float32 [B, h, w, 2 side^2], and 7 more of a
    room's. share: float32 [B, h, w].
    """
    images, rows, columns = range_m.shape
    area = side * side
    most, scale = (np.float32(3), np.float32(10)) if focal > 0 else (np.float32(np.inf), relief)
    for image in range(images):
        for down in range(values.shape[1]):
            for across in range(values.shape[2]):
                to, total, count = values[image, down, across], _ZERO, 0
                for k in range(side):
                    row = down * side + k
                    for n in range(side):
                        column = across * side + n
                        metres = range_m[image, row, column] if row < rows and column < columns else _ZERO
                        to[k * side + n] = metres
                        total += metres
                        count += 1 if metres > _ZERO else 0
                centre = total / np.float32(max(count, 1)) if focal > 0 else mean[image]
                for k in range(area):
                    known = _ONE if to[k] > _ZERO else _ZERO
                    to[k] = min(max((to[k] - centre) * (scale * known), -most), most)
                    to[area + k] = known
                share[image, down, across] = np.float32(count) / np.float32(area)
                if focal > 0:
                    y = ((np.float32(down) + np.float32(0.5)) * np.float32(side) - np.float32(rows) / 2) / focal
                    x = ((np.float32(across) + np.float32(0.5)) * np.float32(side) - np.float32(columns) / 2) / focal
                    has = _ONE if count else _ZERO
                    to[2 * area] = centre / most - has
                    to[2 * area + 1] = has / max(centre, np.float32(0.3))
                    to[2 * area + 2] = x * centre / np.float32(2)
                    to[2 * area + 3] = y * centre / np.float32(2)
                    to[2 * area + 4], to[2 * area + 5], to[2 * area + 6] = has, x, y
