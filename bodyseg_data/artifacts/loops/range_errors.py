"""Errors of range, compiled: the bits of the NumPy forms in `range_errors`, each in one pass over the foreground.

Images are flat, uint16, in steps; pixels: flat indices of the foreground in reading order; numbers are those of pixels.
"""

from __future__ import annotations

from functools import partial
from typing import Any, Final

import numpy as np

from bodyseg_data.core.kernels import compiled

_ONE: Final = np.float32(1)
_LEAST, _MOST = np.float32(1), np.float32(65535)
_WIDE_ONE, _WIDE_MOST = np.float64(1), np.float64(65535)
_RIGHT_ANGLE: Final = np.float32(np.pi / 2)
_MILLIMETRE: Final = np.float32(1e-3)
_kernel = partial(compiled, feature="the compiled form of the artifacts")


@_kernel
def add_gaussian(image: Any, pixels: Any, normals: Any, sigma_m: Any, step_m: Any) -> None:
    """As `gaussian.add_gaussian`; normals, sigma_m, step_m: float32."""
    for point in range(pixels.size):
        before = image[pixels[point]]
        value = np.rint(np.float32(before) + normals[point] * (sigma_m[point] / step_m))
        value = min(max(value, _LEAST), _MOST)
        image[pixels[point]] = np.uint16(np.int32(value)) if before > 0 else before


@_kernel
def axial_sigma(range_m: Any, angle: Any, terms: Any, roots: Any, sigma_m: Any) -> None:
    """As `AxialNoise.sigma_m`; terms: constant, quadratic, from and grazing, float32; roots: twice the power."""
    constant, quadratic, start, grazing = terms
    for point in range(range_m.size):
        away = range_m[point] - start
        root = np.sqrt(range_m[point])
        power = _ONE / root if roots < 0 else _ONE
        for _ in range(roots):
            power *= root
        tilt = angle[point] / (_RIGHT_ANGLE - angle[point])
        sigma = constant + quadratic * (away * away)
        sigma += grazing * power * (tilt * tilt)
        sigma_m[point] = sigma * _MILLIMETRE


@_kernel
def beside(
    image: Any, labels: Any, clean: Any, columns: Any, near: Any, angle: Any, terms: Any, normals: Any, seen: Any
) -> None:
    """As `LateralNoise.apply`, at the pixels `near`; terms: constant and grazing; seen: range and label, [2, N]."""
    constant, grazing = terms
    count, rows = near.size, clean.size // columns
    foreground = 0
    for point in range(count):
        pixel = np.int64(near[point])
        sigma = constant
        if clean[pixel] > 0:
            sigma += grazing * (angle[foreground] / (_RIGHT_ANGLE - angle[foreground]))
            foreground += 1
        row = pixel // columns + np.int64(np.rint(normals[point] * sigma))
        column = pixel % columns + np.int64(np.rint(normals[count + point] * sigma))
        source = min(max(row, 0), rows - 1) * columns + min(max(column, 0), columns - 1)
        seen[0, point], seen[1, point] = image[source], labels[source]
    for point in range(count):
        image[near[point]], labels[near[point]] = seen[0, point], np.uint8(seen[1, point])


@_kernel
def mix(
    image: Any, clean: Any, columns: Any, pixels: Any, bits: Any, limit: Any, behind: Any, jump_mm: Any, step_m: Any
) -> None:
    """As `MixedPixels.apply`; limit: of the higher half of bits; behind: background, in steps."""
    size = clean.size
    for point in range(pixels.size):
        pixel = np.int64(pixels[point])
        column = pixel % columns
        farthest = np.int64(0)
        for side in range(4):
            inside = (
                pixel >= columns
                if side == 0
                else pixel + columns < size
                if side == 1
                else column > 0
                if side == 2
                else column < columns - 1
            )
            if inside:
                step = -columns if side == 0 else columns if side == 1 else np.int64(-1) if side == 2 else np.int64(1)
                value = np.int64(clean[pixel + step])
                farthest = max(farthest, value if value > 0 else behind)
        gap = farthest - np.int64(clean[pixel])
        before = image[pixel]
        if before > 0 and np.float64(bits[point] >> np.uint32(16)) < limit and gap * step_m * 1000 >= jump_mm:
            position = np.float64(bits[point] & np.uint32(0xFFFF)) / 65536
            value_f = np.rint(np.float64(before) + gap * position)
            image[pixel] = np.uint16(np.int32(min(max(value_f, _WIDE_ONE), _WIDE_MOST)))


@_kernel
def round_disparities(image: Any, scale: Any) -> None:
    """As `DisparityRounding.apply`; scale: disparity times range, in steps of both, float64."""
    for pixel in range(image.size):
        before = image[pixel]
        if before > 0:
            disparity = np.rint(scale / np.float64(before))
            value = np.rint(scale / max(disparity, _WIDE_ONE))
            value = min(max(value, _WIDE_ONE), _WIDE_MOST)
            image[pixel] = np.uint16(np.int32(value)) if disparity > 0 else np.uint16(0)


@_kernel
def round_ranges(image: Any, steps: Any) -> None:
    """As `RangeRounding.apply`; steps: of the image in one of the sensor's, float64."""
    for pixel in range(image.size):
        before = image[pixel]
        if before > 0:
            value = np.rint(max(np.rint(np.float64(before) / steps), _WIDE_ONE) * steps)
            image[pixel] = np.uint16(np.int32(min(max(value, _WIDE_ONE), _WIDE_MOST)))
