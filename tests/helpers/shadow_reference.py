"""The shadow test one pixel at a time: slow, plain, and equal to `bodyseg_data/artifacts/occlusion.py` in every bit.

The arithmetic is float32 in the same order of operations.
"""

from __future__ import annotations

from math import floor

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.samples import FARTHEST_STEPS

_NONE, _HALF, _ONE = np.float32(0), np.float32(0.5), np.float32(1)


def lit_by_pixel(
    camera_range: NDArray[np.uint16],
    projector_range: NDArray[np.uint16],
    faces_projector: NDArray[np.bool_],
    slopes: NDArray[np.float32],
    offsets: NDArray[np.float32],
    thresholds: tuple[np.float32, np.float32],
) -> NDArray[np.bool_]:
    """As `occlusion.ShadowTest.lit`; slopes, offsets, thresholds (gap and edge, steps): those of the `ShadowTest`."""
    answer = np.zeros(camera_range.shape, np.bool_)
    last_x = np.float32(projector_range.shape[1]) - _HALF
    last_y = np.float32(projector_range.shape[0]) - _HALF
    for row in range(camera_range.shape[0]):
        for column in range(camera_range.shape[1]):
            if not faces_projector[row, column] or camera_range[row, column] == 0:
                continue
            pixel = row * camera_range.shape[1] + column
            z = np.float32(camera_range[row, column])
            away = z * slopes[2, pixel] + offsets[2]
            if not away > _NONE:
                continue
            x = (z * slopes[0, pixel] + offsets[0]) / away
            y = (z * slopes[1, pixel] + offsets[1]) / away
            if x >= -_HALF and x < last_x and y >= -_HALF and y < last_y:
                answer[row, column] = reached(projector_range, x, y, away, *thresholds)
    return answer


def reached(
    projector_range: NDArray[np.uint16],
    x: np.float32,
    y: np.float32,
    away: np.float32,
    gap_steps: np.float32,
    edge_steps: np.float32,
) -> bool:
    """Decide whether light reaches the point at texel coordinates (x, y) and range `away` in the projector's frame."""
    left, top = floor(x), floor(y)
    along, below = x - np.float32(left), y - np.float32(top)
    a, b = _texel(projector_range, top, left), _texel(projector_range, top, left + 1)
    c, d = _texel(projector_range, top + 1, left), _texel(projector_range, top + 1, left + 1)
    away = min(away - _ONE, FARTHEST_STEPS)
    if max(max(a, b), max(c, d)) - min(min(a, b), min(c, d)) < edge_steps:
        upper, lower = a + along * (b - a), c + along * (d - c)
        return bool(away - (upper + below * (lower - upper)) <= gap_steps)
    limit = away - edge_steps
    votes = (_ONE - below) * (_ONE - along) if a >= limit else _NONE
    votes += (_ONE - below) * along if b >= limit else _NONE
    votes += below * (_ONE - along) if c >= limit else _NONE
    votes += below * along if d >= limit else _NONE
    return bool(votes >= _HALF)


def _texel(projector_range: NDArray[np.uint16], row: int, column: int) -> np.float32:
    """One texel less one step, the border repeated; an empty one is as far away as can be."""
    rows, columns = projector_range.shape
    texel = projector_range[min(max(row, 0), rows - 1), min(max(column, 0), columns - 1)]
    return np.float32(texel) - _ONE if texel > 0 else FARTHEST_STEPS
