"""Surfaces, lost pixels and errors of range, compiled: the bits of `surface`, `lost_pixels` and `range_errors`.

Loops over surfaces go along rows, where neighbours lie side by side, so that the compiler takes several pixels at once.
Those behind them pass over the foreground once: images are flat, uint16, in steps; pixels: flat indices of the
foreground in reading order; numbers are those of pixels.
"""

import math
from functools import partial
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts.constants import ARCCOS, FAR, STEEPEST
from bodyseg_data.machine import compiled
from bodyseg_data.rigs import Camera

_CONSTANT, _LINEAR, _SQUARE, _CUBE = ARCCOS
_HALF: Final = np.float32(0.5)
_ONE: Final = np.float32(1)
_kernel = partial(compiled, feature="the compiled form of the artifacts")

_LEAST, _MOST = np.float32(1), np.float32(65535)
_WIDE_ONE, _WIDE_MOST = np.float64(1), np.float64(65535)
_RIGHT_ANGLE: Final = np.float32(np.pi / 2)
_MILLIMETRE: Final = np.float32(1e-3)


# Surfaces.


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
    flat, marked = np.ascontiguousarray(image).reshape(-1), np.empty(image.shape, np.bool_)
    # Ranges are whole numbers: they differ by more than a jump if they do by more than its whole part.
    _silhouettes(flat, *image.shape, np.int32(min(math.floor(jump), 65535)), marked.reshape(-1))
    return marked


def widened(marked: NDArray[np.bool_], pixels: int) -> NDArray[np.bool_]:
    found = np.empty(marked.shape, np.bool_)
    marks = np.ascontiguousarray(marked).view(np.uint8)
    _widened(marks, pixels, np.empty(marked.shape[1], np.uint8), found.view(np.uint8))
    return found


# Lost pixels.


@_kernel
def lose_steep(image: Any, pixels: Any, bits: Any, limit: Any, angle: Any, from_rad: Any) -> None:
    """As `GrazingLoss.apply`; limit: of the bits, uint32."""
    for point in range(np.uint64(pixels.size)):
        pixel = np.uint64(pixels[point])
        lost = (np.uint32(bits[point]) < limit) & (angle[point] > from_rad)
        image[pixel] = np.uint16(0) if lost else image[pixel]


@_kernel
def lose_marked(image: Any, pixels: Any, bits: Any, limit: Any, marked: Any) -> None:
    """As `EdgeLoss.apply`; limit: of the bits, uint32; marked: whether a pixel of the image is at an edge."""
    for point in range(np.uint64(pixels.size)):
        pixel = np.uint64(pixels[point])
        lost = (np.uint32(bits[point]) < limit) & marked[pixel]
        image[pixel] = np.uint16(0) if lost else image[pixel]


@_kernel
def least_sums(pixels: Any, width: Any, down: Any, along: Any, values: Any) -> None:
    """The least sum of `down` at a pixel's row and of `along` at its column, over the rows of both.

    pixels: flat indices in a box of `width`; down, along: float32 [K, height] and [K, width].
    """
    row, end = np.int64(0), np.int64(width)
    for point in range(np.uint64(pixels.size)):
        pixel = np.int64(pixels[point])
        while pixel >= end:
            row += 1
            end += width
        column = np.uint64(pixel - (end - width))
        least = down[0, np.uint64(row)] + along[0, column]
        for each in range(np.uint64(1), np.uint64(down.shape[0])):
            least = min(least, down[each, np.uint64(row)] + along[each, column])
        values[point] = least


@_kernel
def mark_below(pixels: Any, values: Any, limit: Any, most: Any, marked: Any) -> None:
    """Mark pixels with a value below a limit, and the first of those at the limit, `most` in all, in bool [h, w].

    pixels: flat indices in it.
    """
    below = np.int64(0)
    for point in range(np.uint64(values.size)):
        below += np.int64(values[point] < limit)
    width, left = np.int64(marked.shape[1]), most - below
    row, end = np.int64(0), width
    for point in range(np.uint64(pixels.size)):
        pixel = np.int64(pixels[point])
        while pixel >= end:
            row += 1
            end += width
        first = values[point] == limit and left > 0
        left -= np.int64(first)
        marked[np.uint64(row), np.uint64(pixel - (end - width))] = values[point] < limit or first


# Errors of range.


@_kernel
def add_gaussian(image: Any, pixels: Any, normals: Any, sigma_m: Any, step_m: Any) -> None:
    """As `range_errors.add_gaussian`; normals, sigma_m, step_m: float32."""
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
