"""The shadow test compiled with numba, to measure what a compiler would gain; nothing else uses it.

The operations of `artifacts/occlusion.py` in the same order, without fast-math, so the same bits.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts.occlusion import EDGE_STEPS, FARTHEST, GAP_STEPS, ShadowTest, framed

_NONE: Final = np.float32(0)
_HALF: Final = np.float32(0.5)
_ONE: Final = np.float32(1)


def lit(
    test: ShadowTest,
    camera_range: NDArray[np.uint16],
    projector_range: NDArray[np.uint16],
    faces_projector: NDArray[np.bool_],
) -> NDArray[np.bool_]:
    """As `ShadowTest.lit`, for contiguous arrays that were checked."""
    answer = np.zeros(camera_range.shape, np.bool_)
    facing = faces_projector.ravel().view(np.uint8)
    image = framed(projector_range)
    frame = np.float32(projector_range.shape[1]), np.float32(projector_range.shape[0])
    _compiled(
        camera_range.ravel(), image.ravel(), image.shape[1], frame, facing, *test.slopes, *test.offsets, answer.ravel()
    )
    return answer


def _loops(
    camera_range: Any,
    image: Any,
    width: int,
    frame: Any,
    facing: Any,
    across: Any,
    down: Any,
    forward: Any,
    offset_x: Any,
    offset_y: Any,
    offset_z: Any,
    answer: Any,
) -> None:
    # Three passes: the middle one has no branches, so the compiler makes it several pixels wide.
    pixels: Any = np.empty(camera_range.size, np.int32)
    count: Any = 0
    words = facing[: facing.size // 8 * 8].view(np.uint64)  # most of the image is dark: look at eight pixels at once
    for word in range(words.size):
        if words[word] != 0:
            for pixel in range(8 * word, 8 * word + 8):
                pixels[count] = pixel
                count += np.int64(facing[pixel]) & np.int64(camera_range[pixel] != 0)
    for pixel in range(8 * words.size, facing.size):
        pixels[count] = pixel
        count += np.int64(facing[pixel]) & np.int64(camera_range[pixel] != 0)
    x, y, away = np.empty(count, np.float32), np.empty(count, np.float32), np.empty(count, np.float32)
    for point in range(count):
        pixel = pixels[point]
        z = np.float32(camera_range[pixel])
        away[point] = z * forward[pixel] + offset_z
        x[point] = (z * across[pixel] + offset_x) / away[point]
        y[point] = (z * down[pixel] + offset_y) / away[point]
    last_x, last_y = frame[0] - _HALF, frame[1] - _HALF
    for point in range(count):
        x_, y_, z = x[point], y[point], away[point]
        if not ((z > _NONE) & (x_ >= -_HALF) & (x_ < last_x) & (y_ >= -_HALF) & (y_ < last_y)):
            continue
        z = min(z - _ONE, FARTHEST)
        left, top = np.floor(x_), np.floor(y_)
        along, below = x_ - left, y_ - top
        # Unsigned, so that no code is made for indices that count from the end.
        start = np.uint64((np.int64(top) + 1) * width + np.int64(left) + 1)
        under = start + np.uint64(width)
        a, b = np.float32(image[start]), np.float32(image[start + np.uint64(1)])
        c, d = np.float32(image[under]), np.float32(image[under + np.uint64(1)])
        if max(max(a, b), max(c, d)) - min(min(a, b), min(c, d)) < EDGE_STEPS:
            upper, lower = a + along * (b - a), c + along * (d - c)
            answer[pixels[point]] = z - (upper + below * (lower - upper)) <= GAP_STEPS
        else:
            limit = z - EDGE_STEPS
            votes = (_ONE - below) * (_ONE - along) if a >= limit else _NONE
            votes += (_ONE - below) * along if b >= limit else _NONE
            votes += below * (_ONE - along) if c >= limit else _NONE
            votes += below * along if d >= limit else _NONE
            answer[pixels[point]] = votes >= _HALF


_compiled: Any = import_module("numba").njit(_loops, nogil=True, error_model="numpy")  # has no types everywhere
