"""Surfaces in a range image, compiled: the bits of `surface.angles`, at pixels of the foreground, of
`surface.silhouettes` and of `surface.widened`.

Loops go along rows, where neighbours lie side by side, so that the compiler takes several pixels at once.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts.constants import ARCCOS, FAR, STEEPEST
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
def _angle(here: Any, left: Any, right: Any, above: Any, below: Any, focal: Any, x: Any, y: Any) -> Any:
    """The angle of a pixel with a range, from those of its neighbours; x, y: of its ray."""
    across, down = _smaller(left, here, right) * focal, _smaller(above, here, below) * focal
    product = here + x * across + y * down
    slant = product * product
    slant += across * across
    slant += down * down
    slant *= (x * x + _ONE) + y * y
    slant /= here * here
    cosine = max(_ONE / np.sqrt(max(slant, _ONE)), STEEPEST)
    cubic = _CONSTANT + cosine * (_LINEAR + cosine * (_SQUARE + cosine * _CUBE))
    return np.sqrt(_ONE - cosine) * cubic


@_kernel
def _incidence(image: Any, rows: Any, columns: Any, focal: Any, x: Any, y: Any, pixels: Any, found: Any) -> None:
    """Angles of a flat image's pixels; x, y: of each column's and row's rays."""
    width, total, point = np.int64(columns), np.int64(pixels.size), np.int64(0)
    while point < total:
        first = np.int64(pixels[point])
        row = first // width
        column = first - row * width
        longest, length = min(total - point, width - column), np.int64(1)
        while length < longest and pixels[np.uint64(point + length)] == first + length:
            length += 1
        has_above, has_below = row > 0, row < rows - 1
        up, down = np.uint64(first - width if has_above else first), np.uint64(first + width if has_below else first)
        at, to, ray, y_row = np.uint64(first), np.uint64(point), np.uint64(column), y[row]
        begin = np.uint64(1 if column == 0 else 0)
        end = np.uint64(length - 1 if column + length == width else length)
        for i in range(begin, end):
            left, right = _known(image[at + i - np.uint64(1)]), _known(image[at + i + np.uint64(1)])
            above = _known(image[up + i]) if has_above else FAR
            below = _known(image[down + i]) if has_below else FAR
            found[to + i] = _angle(np.float32(image[at + i]), left, right, above, below, focal, x[ray + i], y_row)
        for border in (np.uint64(0), np.uint64(length - 1)):
            if begin <= border < end:
                continue  # not at the image's border
            left = _known(image[at + border - np.uint64(1)]) if column + np.int64(border) > 0 else FAR
            right = _known(image[at + border + np.uint64(1)]) if column + np.int64(border) < width - 1 else FAR
            above = _known(image[up + border]) if has_above else FAR
            below = _known(image[down + border]) if has_below else FAR
            here = np.float32(image[at + border])
            found[to + border] = _angle(here, left, right, above, below, focal, x[ray + border], y_row)
        point += length


@_kernel
def _apart(here: Any, beside: Any, jump: Any) -> Any:
    """True if two neighbours differ by more than a jump, or if one of them is background."""
    return (abs(np.int32(here) - np.int32(beside)) > jump) | ((here == 0) != (beside == 0))


@_kernel
def _silhouettes(image: Any, rows: Any, columns: Any, jump: Any, marked: Any) -> None:
    """Mark the flat image's pixels beside an edge; beyond the image's border every pixel has itself for a neighbour."""
    width, one = np.uint64(columns), np.uint64(1)
    for row in range(np.uint64(rows)):
        at = row * width
        up, down = at - width if row > 0 else at, at + width if row + one < rows else at
        for i in range(one, max(width, one) - one):
            here = image[at + i]
            ends = _apart(here, image[up + i], jump) | _apart(here, image[down + i], jump)
            ends |= _apart(here, image[at + i - one], jump) | _apart(here, image[at + i + one], jump)
            marked[at + i] = ends & (here > 0)
        for border in (np.uint64(0), width - one):
            here, left, right = image[at + border], max(border, one) - one, min(border + one, width - one)
            ends = _apart(here, image[up + border], jump) | _apart(here, image[down + border], jump)
            ends |= _apart(here, image[at + left], jump) | _apart(here, image[at + right], jump)
            marked[at + border] = ends & (here > 0)


@_kernel
def _widened(marked: Any, pixels: Any, line: Any, found: Any) -> None:
    """Grow marks, uint8 [H, W], by squares; line: room for a row."""
    rows, columns = marked.shape
    for row in range(rows):
        line[:] = 0
        for other in range(max(row - pixels, 0), min(row + pixels + 1, rows)):
            for i in range(np.uint64(columns)):
                line[i] |= marked[other, i]
        for i in range(np.uint64(columns)):
            found[row, i] = line[i]
        for shift in range(1, min(pixels + 1, columns)):
            along = np.uint64(shift)
            for i in range(np.uint64(columns) - along):
                found[row, i + along] |= line[i]
            for i in range(np.uint64(columns) - along):
                found[row, i] |= line[i + along]


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


def silhouettes(image: NDArray[np.uint16], jump: float) -> NDArray[np.bool_]:
    """As `surface.silhouettes`."""
    flat, marked = np.ascontiguousarray(image).reshape(-1), np.empty(image.shape, np.bool_)
    # Ranges are whole numbers: they differ by more than a jump if they do by more than its whole part.
    _silhouettes(flat, *image.shape, np.int32(min(math.floor(jump), 65535)), marked.reshape(-1))
    return marked


def widened(marked: NDArray[np.bool_], pixels: int) -> NDArray[np.bool_]:
    """As `surface.widened`."""
    found = np.empty(marked.shape, np.bool_)
    marks = np.ascontiguousarray(marked).view(np.uint8)
    _widened(marks, pixels, np.empty(marked.shape[1], np.uint8), found.view(np.uint8))
    return found
