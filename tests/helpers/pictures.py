"""Pictures that were written, looked at as a reader sees them: decoded, by the colours in them and their places."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage

Picture = NDArray[np.uint8]


class Mark(NamedTuple):
    """A connected piece of one colour: its first and last column and row, and its number of pixels."""

    left: int
    right: int
    top: int
    bottom: int
    pixels: int

    @property
    def width(self) -> int:
        return self.right - self.left + 1

    @property
    def height(self) -> int:
        return self.bottom - self.top + 1

    @property
    def middle(self) -> tuple[float, float]:
        """Column and row."""
        return (self.left + self.right) / 2, (self.top + self.bottom) / 2


def decoded(path: Path) -> Picture:
    """A PNG file's picture, sRGB uint8 [H, W, 3], which must not be of one colour."""
    with Image.open(path) as image:
        assert image.format == "PNG"
        image.load()
        picture = np.asarray(image.convert("RGB"))
    assert picture.shape[0] > 100 and picture.shape[1] > 300
    assert (picture != picture[0, 0]).any()
    return picture


def marks(picture: Picture, colour: Any, least: int = 12, within: int = 0) -> list[Mark]:
    """Pieces of a colour, "#rrggbb" or three numbers, of at least so many pixels, from left to right.

    within: by how much each of the three numbers may differ, for what is thin, or not quite opaque.
    """
    rgb = [int(colour[at : at + 2], 16) for at in (1, 3, 5)] if isinstance(colour, str) else list(colour)
    alike = np.ones(picture.shape[:2], bool)
    for channel, value in enumerate(map(int, rgb)):  # one by one, as bytes: a tenth of the time of [H, W, 3]
        least_value, most_value = max(0, value - within), min(255, value + within)
        # One comparison: what is less than the least one wraps around.
        alike &= picture[..., channel] - np.uint8(least_value) <= most_value - least_value
    rows, columns = (np.flatnonzero(alike.any(axis)) for axis in (1, 0))
    if not len(rows):
        return []
    top, left = int(rows[0]), int(columns[0])
    numbers, count = ndimage.label(alike[top : rows[-1] + 1, left : columns[-1] + 1], np.ones((3, 3)))
    sizes = np.bincount(numbers.ravel(), minlength=count + 1)
    found = [
        Mark(left + across.start, left + across.stop - 1, top + down.start, top + down.stop - 1, int(sizes[number]))
        for number, (down, across) in enumerate(ndimage.find_objects(numbers), 1)
        if sizes[number] >= least
    ]
    return sorted(found)


def part(picture: Picture, across: tuple[float, float] = (0, 1), down: tuple[float, float] = (0, 1)) -> Picture:
    """The part between two shares of the width and of the height."""
    rows, columns = picture.shape[:2]
    top, bottom = (round(share * rows) for share in down)
    left, right = (round(share * columns) for share in across)
    return picture[top:bottom, left:right]
