"""Run-length encoding of images, in reading order across the ends of rows.

Two sequences: the value of each run and its length in pixels. Lengths are bytes; 255 marks a longer run, whose length
follows among the escapes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

ESCAPE: Final = 255
"""The byte that marks a number above 254; the number follows among the escapes."""

Image = NDArray[Any]
Bytes = NDArray[np.uint8]


class Box(NamedTuple):
    """The stored part of an image, in pixels; all outside is background."""

    top: int
    left: int
    height: int
    width: int

    def crop(self, image: Image) -> Image:
        """View of that part of `image`."""
        return image[self.top : self.top + self.height, self.left : self.left + self.width]


@dataclass(frozen=True)
class Runs:
    """Runs of equal pixels. values: uint8 or uint16 [N]. lengths: int64 [N], pixels, at least 1."""

    values: NDArray[Any]
    lengths: NDArray[np.int64]

    def write_into(self, image: Image, box: Box) -> NDArray[np.int32]:
        """Write the pixels, as many as the box has, into the box of `image`, [H, W], zeros.

        Returns the flat indices of the pixels other than 0, ascending.
        """
        box.crop(image)[:] = np.repeat(self.values, self.lengths).reshape(box.height, box.width)
        return np.flatnonzero(image != 0).astype(np.int32)  # of booleans it is several times as fast


def bounding_box(used: NDArray[np.bool_]) -> Box:
    """Bounding box of the True pixels of `used` [H, W]; an empty one at 0, 0 without any."""
    rows, columns = np.flatnonzero(used.any(axis=1)), np.flatnonzero(used.any(axis=0))
    if not len(rows):
        return Box(0, 0, 0, 0)
    top, left = int(rows[0]), int(columns[0])
    return Box(top, left, int(rows[-1]) - top + 1, int(columns[-1]) - left + 1)


def find_runs(crop: Image) -> Runs:
    """Find the runs of an image."""
    flat = crop.ravel()
    starts = np.flatnonzero(np.concatenate([[True] * min(1, len(flat)), flat[1:] != flat[:-1]]))
    return Runs(flat[starts], np.diff(starts, append=len(flat)))


def escape_large(numbers: NDArray[Any], kind: type[np.unsignedinteger[Any]]) -> tuple[Bytes, Bytes]:
    """Encode numbers [N] as one byte each, and those above 254 also as byte planes of type `kind`."""
    large = numbers[numbers >= ESCAPE].astype(kind)
    return np.minimum(numbers, ESCAPE).astype(np.uint8), to_byte_planes(large)


def unescape(low: Bytes, escapes: Bytes, kind: type[np.unsignedinteger[Any]]) -> NDArray[Any]:
    """Decode the numbers of `escape_large`, [N] of type `kind`. Raises ValueError for a wrong number of escapes."""
    escaped_at, large = find_escapes(low, escapes, kind)
    numbers = low.astype(kind)
    numbers[escaped_at] = large
    return numbers


def find_escapes(
    low: Bytes, escapes: Bytes, kind: type[np.unsignedinteger[Any]]
) -> tuple[NDArray[np.intp], NDArray[Any]]:
    """Indices and values of the escaped numbers. Raises ValueError for a wrong number of escapes."""
    escaped_at, large = np.flatnonzero(low == ESCAPE), from_byte_planes(escapes, kind)
    if len(escaped_at) != len(large):
        raise ValueError(f"{len(escaped_at)} numbers are escaped, found {len(large)}")
    return escaped_at, large


def to_byte_planes(numbers: NDArray[Any]) -> Bytes:
    """Encode unsigned numbers [N] as byte planes: all lowest bytes first, since the upper ones are nearly constant."""
    little = numbers.astype(numbers.dtype.newbyteorder("<"))
    return np.ascontiguousarray(little.view(np.uint8).reshape(len(numbers), numbers.itemsize).T).ravel()


def from_byte_planes(stored: Bytes, kind: type[np.unsignedinteger[Any]]) -> NDArray[Any]:
    """Decode byte planes to numbers of type `kind`, the inverse of `to_byte_planes`."""
    little = np.dtype(kind).newbyteorder("<")
    return (
        np.ascontiguousarray(stored.reshape(little.itemsize, len(stored) // little.itemsize).T)
        .view(little)
        .ravel()
        .astype(kind)
    )


def checked_lengths(low: Bytes, escapes: Bytes, box: Box) -> NDArray[np.int64]:
    """Decode lengths of runs. Raises ValueError unless they fill the box exactly."""
    lengths: NDArray[np.int64] = unescape(low, escapes, np.uint32).astype(np.int64)
    if lengths.sum() != box.height * box.width or (len(lengths) and lengths.min() < 1):
        raise ValueError(f"runs of {lengths.sum()} pixels do not fill {box.height} x {box.width}")
    return lengths
