"""Images at other pixels: each takes its value from the nearest one, so that none lies between two surfaces."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.parts import BACKGROUND
from bodyseg_data.core.system.reused_memory import SCRATCH
from bodyseg_data.loading.transforms.camera_image import Box, CameraImage, ends_of


def take_grid(
    image: CameraImage, rows: NDArray[np.floating[Any]], columns: NDArray[np.floating[Any]], **camera: Any
) -> CameraImage:
    """The image with the pixels that hold the points (columns[j], rows[i]), in image coordinates; outside: background.

    rows, columns: increasing, float64 [H], [W]. camera: fields of the camera that change.
    """
    ranges, labels = background(len(rows), len(columns))
    box = ends_of(image.range)
    if box is not None:
        down, along = _within(np.floor(rows), *box[:2]), _within(np.floor(columns), *box[2:])
        below, across = rows[down].astype(np.intp), columns[along].astype(np.intp)
        ranges[down, along] = image.range.take(below, axis=0).take(across, axis=1)
        labels[down, along] = image.labels.take(below, axis=0).take(across, axis=1)
    return replace(image, range=ranges, labels=labels, **camera)


def _within(places: NDArray[np.floating[Any]], first: int, end: int) -> slice:
    """The stretch of increasing `places` that lie from `first` to below `end`."""
    return slice(*np.searchsorted(places, (first, end)).tolist())


def background(rows: int, columns: int) -> tuple[NDArray[np.uint16], NDArray[np.uint8]]:
    """Range and labels of an image in which nothing was measured."""
    ranges, labels = SCRATCH.empty((rows, columns), np.uint16), SCRATCH.empty((rows, columns), np.uint8)
    ranges.fill(0)
    labels.fill(BACKGROUND)
    return ranges, labels


def take_window(image: CameraImage, top: int, left: int, rows: int, columns: int) -> CameraImage:
    """A window of the image, in pixels as they are; what lies outside is background."""
    (height, width), (x, y) = image.range.shape, image.centre_px
    centre_px = (x - left, y - top)
    if 0 <= top <= height - rows and 0 <= left <= width - columns:
        window = slice(top, top + rows), slice(left, left + columns)
        return replace(image, range=image.range[window], labels=image.labels[window], centre_px=centre_px)
    ranges, labels = background(rows, columns)
    first, end = max(top, 0), min(top + rows, height)
    start, stop = max(left, 0), min(left + columns, width)
    if first < end and start < stop:
        ranges[first - top : end - top, start - left : stop - left] = image.range[first:end, start:stop]
        labels[first - top : end - top, start - left : stop - left] = image.labels[first:end, start:stop]
    return replace(image, range=ranges, labels=labels, centre_px=centre_px)


_BITS: Final = 20
"""Bits of a pixel's fraction to which `take_turned` rounds positions, so that sums of them are exact."""


_ROWS: Final = 128
"""Rows that `take_turned` makes at once, so that what it computes for them stays in the cache."""


def take_turned(image: CameraImage, cos: float, sin: float) -> CameraImage:
    """The image turned about its optical axis: a point (x, y) about it takes the place (cos x + sin y, cos y - sin x).

    What leaves the image is lost; what comes into it is background.
    """
    height, width = image.range.shape
    ranges, labels = background(height, width)
    box = ends_of(image.range)
    if box is not None:
        x, y = image.centre_px
        corners = [(column - x, row - y) for row in box[:2] for column in box[2:]]
        down = _span([cos * below - sin * across + y for across, below in corners], height)
        along = _span([cos * across + sin * below + x for across, below in corners], width)
        across = np.arange(along.start, along.stop) + 0.5 - x  # of the pixels' centres, from the axis
        for first in range(down.start, down.stop, _ROWS):
            rows = slice(first, min(first + _ROWS, down.stop))
            below = np.arange(rows.start, rows.stop) + 0.5 - y
            from_rows, from_columns = _sums(cos * below + y, sin * across), _sums(x - sin * below, cos * across)
            places, inside = _sources(from_rows, from_columns, box, width)
            ranges[rows, along] = image.range.take(places, mode="clip") * inside
            labels[rows, along] = image.labels.take(places, mode="clip") | (inside.view(np.uint8) - np.uint8(1))
    return replace(image, range=ranges, labels=labels)


def _span(places: list[float], size: int) -> slice:
    """The pixels of a side that reach from the least to the greatest of `places`."""
    low, high = (int(np.clip(end, 0, size)) for end in (np.floor(min(places)), np.ceil(max(places))))
    return slice(low, high)


def _sources(
    rows: NDArray[np.intp], columns: NDArray[np.intp], box: Box, width: int
) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Flat indices of pixels, and which of them lie in the box; those of others may be out of range."""
    inside: NDArray[np.bool_] = (rows - box[0]).view(np.uintp) < np.uintp(box[1] - box[0])  # below 0 is large
    inside &= (columns - box[2]).view(np.uintp) < np.uintp(box[3] - box[2])
    rows *= width
    rows += columns
    return rows, inside


def _sums(down: NDArray[np.floating[Any]], along: NDArray[np.floating[Any]]) -> NDArray[np.intp]:
    """Whole pixels of down[i] + along[j], rounded down, [H, W]."""
    fixed = (np.rint(2.0**_BITS * each).astype(np.intp) for each in (down, along))
    found: NDArray[np.intp] = np.add.outer(*fixed)
    found >>= _BITS
    return found
