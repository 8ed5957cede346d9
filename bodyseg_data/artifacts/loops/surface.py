"""Angles of incidence, compiled: the bits of `surface.slants` and `surface.angles`, at pixels of the foreground."""

from __future__ import annotations

from functools import partial
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts.surface import ARCCOS, FAR, STEEPEST
from bodyseg_data.core.kernels import compiled
from bodyseg_data.core.rig import Camera

_CONSTANT, _LINEAR, _SQUARE, _CUBE = ARCCOS
_HALF: Final = np.float32(0.5)
_ONE: Final = np.float32(1)
_kernel = partial(compiled, feature="the compiled form of the artifacts")


@_kernel
def _known(value: Any) -> Any:
    """A range in steps as float32, background far away."""
    return np.float32(value) if value > 0 else FAR


@_kernel
def _smaller(before: Any, here: Any, after: Any) -> Any:
    backward, forward = here - before, after - here
    return forward if abs(forward) <= abs(backward) else backward


@_kernel
def _incidence(image: Any, rows: Any, columns: Any, focal: Any, x: Any, y: Any, pixels: Any, found: Any) -> None:
    """Angles of a flat image's pixels; x, y: of each column's and row's rays."""
    width = np.int64(columns)
    for point in range(pixels.size):
        pixel = np.int64(pixels[point])
        row = pixel // width
        column = pixel - row * width
        here = np.float32(image[pixel])
        left = _known(image[pixel - 1]) if column > 0 else FAR
        right = _known(image[pixel + 1]) if column < width - 1 else FAR
        above = _known(image[pixel - width]) if row > 0 else FAR
        below = _known(image[pixel + width]) if row < rows - 1 else FAR
        across, down = _smaller(left, here, right) * focal, _smaller(above, here, below) * focal
        product = here + x[column] * across + y[row] * down
        slant = product * product
        slant += across * across
        slant += down * down
        slant *= (x[column] * x[column] + _ONE) + y[row] * y[row]
        slant /= here * here
        cosine = max(_ONE / np.sqrt(max(slant, _ONE)), STEEPEST)
        cubic = _CONSTANT + cosine * (_LINEAR + cosine * (_SQUARE + cosine * _CUBE))
        found[point] = np.sqrt(_ONE - cosine) * cubic


def incidence(image: NDArray[np.uint16], camera: Camera, pixels: NDArray[np.intp]) -> NDArray[np.float32]:
    """Angles of incidence at pixels of the foreground, radians, float32 [N].

    image: clean range, uint16 [H, W], in steps. pixels: flat indices, [N].
    """
    rows, columns = image.shape
    focal = np.float32(camera.focal_px)
    x = (np.arange(columns, dtype=np.float32) + _HALF - np.float32(camera.centre_px[0])) / focal
    y = (np.arange(rows, dtype=np.float32) + _HALF - np.float32(camera.centre_px[1])) / focal
    found = np.empty(len(pixels), np.float32)
    flat = np.ascontiguousarray(image).reshape(-1)
    _incidence(flat, rows, columns, focal, x, y, pixels, found)
    return found
