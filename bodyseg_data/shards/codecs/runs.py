"""Images of large areas as runs of equal pixels, in reading order, regardless of where rows end.

Two rows of numbers: what each run holds, and how many pixels it has. Lengths are bytes; 255 stands for one that does
not fit, found among the escapes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.kernels import compiled, use_compiled

ESCAPE: Final = 255
"""The byte that stands for a number which does not fit; the number follows among the escapes."""

Image = NDArray[Any]
Bytes = NDArray[np.uint8]


@dataclass(frozen=True)
class Box:
    """The part of an image that is stored: everything outside is background. Pixels."""

    top: int
    left: int
    height: int
    width: int

    def of(self, image: Image) -> Image:
        """That part of `image`, a view."""
        return image[self.top : self.top + self.height, self.left : self.left + self.width]


@dataclass(frozen=True)
class Runs:
    """values: what each run holds, uint8 or uint16 [N]. lengths: how many pixels it has, int64 [N], at least 1."""

    values: NDArray[Any]
    lengths: NDArray[np.int64]

    def expanded(self, image: Image, box: Box) -> None:
        """Write the pixels into the box of `image`. Their number must be the box's."""
        if use_compiled():
            _loops()[0](self.values, self.lengths, image, box.top, box.left, box.width)
        else:
            box.of(image)[:] = np.repeat(self.values, self.lengths).reshape(box.height, box.width)

    def placed(self, image: Image, box: Box) -> NDArray[np.int32]:
        """As `expanded`, into an `image` of zeros; the places, in the flat image, of all that is not zero."""
        if not use_compiled():
            self.expanded(image, box)
            return np.flatnonzero(image).astype(np.int32)
        places = np.empty(self.lengths[self.values != 0].sum(), np.int32)
        _loops()[1](self.values, self.lengths, image, box.top, box.left, box.width, places)
        return places


def used_box(used: NDArray[np.bool_]) -> Box:
    """The smallest box around what is True in `used` [H, W]; nothing at 0, 0 if nothing is."""
    rows, columns = np.flatnonzero(used.any(axis=1)), np.flatnonzero(used.any(axis=0))
    if not len(rows):
        return Box(0, 0, 0, 0)
    top, left = int(rows[0]), int(columns[0])
    return Box(top, left, int(rows[-1]) - top + 1, int(columns[-1]) - left + 1)


def find_runs(crop: Image) -> Runs:
    """The runs of an image."""
    flat = crop.ravel()
    starts = np.flatnonzero(np.concatenate([[True] * min(1, len(flat)), flat[1:] != flat[:-1]]))
    return Runs(flat[starts], np.diff(starts, append=len(flat)))


def escaped(numbers: NDArray[Any], kind: type[np.unsignedinteger[Any]]) -> tuple[Bytes, Bytes]:
    """Numbers [N] as one byte each, and those that do not fit, of `kind`, as planes: all lowest bytes first."""
    large = numbers[numbers >= ESCAPE].astype(kind)
    return np.minimum(numbers, ESCAPE).astype(np.uint8), planes(large)


def unescaped(low: Bytes, escapes: Bytes, kind: type[np.unsignedinteger[Any]]) -> NDArray[Any]:
    """The inverse of `escaped`: numbers of `kind` [N]. Raises ValueError if the escapes are not as many as said."""
    where, large = escapes_of(low, escapes, kind)
    numbers = low.astype(kind)
    numbers[where] = large
    return numbers


def escapes_of(
    low: Bytes, escapes: Bytes, kind: type[np.unsignedinteger[Any]]
) -> tuple[NDArray[np.intp], NDArray[Any]]:
    """Which numbers are escaped, and what they are. Raises ValueError if the escapes are not as many as said."""
    where, large = np.flatnonzero(low == ESCAPE), from_planes(escapes, kind)
    if len(where) != len(large):
        raise ValueError(f"{len(where)} numbers are escaped, found {len(large)}")
    return where, large


def planes(numbers: NDArray[Any]) -> Bytes:
    """Unsigned numbers [N] as bytes: all lowest first, since the upper ones are nearly constant."""
    little = numbers.astype(numbers.dtype.newbyteorder("<"))
    return np.ascontiguousarray(little.view(np.uint8).reshape(len(numbers), numbers.itemsize).T).ravel()


def from_planes(stored: Bytes, kind: type[np.unsignedinteger[Any]]) -> NDArray[Any]:
    """The inverse of `planes`."""
    little = np.dtype(kind).newbyteorder("<")
    return (
        np.ascontiguousarray(stored.reshape(little.itemsize, len(stored) // little.itemsize).T)
        .view(little)
        .ravel()
        .astype(kind)
    )


def checked_lengths(low: Bytes, escapes: Bytes, box: Box) -> NDArray[np.int64]:
    """Lengths of runs that fill the box exactly. Raises ValueError for others."""
    lengths: NDArray[np.int64] = unescaped(low, escapes, np.uint32).astype(np.int64)
    if lengths.sum() != box.height * box.width or (len(lengths) and lengths.min() < 1):
        raise ValueError(f"runs of {lengths.sum()} pixels do not fill {box.height} x {box.width}")
    return lengths


def _fill(values: NDArray[Any], lengths: NDArray[np.int64], image: Image, top: int, left: int, width: int) -> None:
    row, column = top, 0
    for run in range(len(values)):
        value, remaining = values[run], lengths[run]
        while remaining > 0:
            count = min(remaining, width - column)
            for place in range(left + column, left + column + count):
                image[row, place] = value
            remaining -= count
            column += count
            if column == width:
                row, column = row + 1, 0


def _fill_used(values: Any, lengths: Any, image: Any, top: int, left: int, width: int, places: Any) -> None:
    """As `_fill`, but leaves out zeros, and notes the places of all others in the flat image."""
    row, column, count = top, 0, 0
    for run in range(len(values)):
        value, remaining = values[run], lengths[run]
        if value == 0:
            column += remaining
            row, column = row + column // width, column % width
            continue
        for _ in range(remaining):
            image[row, left + column] = value
            places[count] = row * image.shape[1] + left + column
            count += 1
            column += 1
            if column == width:
                row, column = row + 1, 0


@lru_cache(maxsize=1)
def _loops() -> tuple[Any, Any]:
    return compiled(_fill, "expanding runs"), compiled(_fill_used, "expanding runs")
