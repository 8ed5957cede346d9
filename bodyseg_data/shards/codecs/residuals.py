"""Lossless encoding of labels as runs and of ranges as residuals of the surface's slope; escapes for large numbers.

Runs, in reading order across the ends of rows, are two sequences: the value of each and its length in pixels. Lengths
are bytes; 255 marks a longer run, whose length follows among the escapes.

Surfaces are locally planar: the step from a pixel to the next one in its row nearly equals the step in the row above.
The labels define the foreground, so there is one number for each of its pixels and none for background. All arithmetic
is modulo 65536. For foreground pixels inside the box, in reading order across the ends of rows:

    the first pixel of a foreground run stores its range, as the difference from the previous first pixel;
    any other stores the difference between its step from its left neighbour and the last such step higher up in its
    column, 0 without one.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.labels import BACKGROUND
from bodyseg_data.machine import if_ready, loops
from bodyseg_data.samples import box_of
from bodyseg_data.shards.codecs.codec import Bytes, Range

ESCAPE: Final = 255
"""The byte that marks a number above 254; the number follows among the escapes."""

Image = NDArray[Any]


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


def bounding_box(used: NDArray[np.bool_]) -> Box:
    """Bounding box of the True pixels of `used` [H, W]; an empty one at 0, 0 without any."""
    rows, columns = box_of(used) or np.s_[0:0, 0:0]
    return Box(rows.start, columns.start, rows.stop - rows.start, columns.stop - columns.start)


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
    escaped_at, large = np.flatnonzero(low == ESCAPE), from_byte_planes(escapes, kind)
    if len(escaped_at) != len(large):
        raise ValueError(f"{len(escaped_at)} numbers are escaped, found {len(large)}")
    numbers = low.astype(kind)
    numbers[escaped_at] = large
    return numbers


def to_byte_planes(numbers: NDArray[Any]) -> Bytes:
    """Encode unsigned numbers [N] as byte planes: all lowest bytes first, since the upper ones are nearly constant."""
    little = numbers.astype(numbers.dtype.newbyteorder("<"))
    return np.ascontiguousarray(little.view(np.uint8).reshape(len(numbers), numbers.itemsize).T).ravel()


def from_byte_planes(stored: Bytes, kind: type[np.unsignedinteger[Any]]) -> NDArray[Any]:
    """Decode byte planes to numbers of type `kind`, the inverse of `to_byte_planes`."""
    little = np.dtype(kind).newbyteorder("<")
    return np.ascontiguousarray(stored.reshape(little.itemsize, -1).T).view(little).ravel().astype(kind)


def checked_lengths(low: Bytes, escapes: Bytes, box: Box) -> NDArray[np.int64]:
    """Decode lengths of runs. Raises ValueError unless they fill the box exactly."""
    lengths: NDArray[np.int64] = unescape(low, escapes, np.uint32).astype(np.int64)
    if lengths.sum() != box.height * box.width or (len(lengths) and lengths.min() < 1):
        raise ValueError(f"runs of {lengths.sum()} pixels do not fill {box.height} x {box.width}")
    return lengths


def zigzag(change: Range) -> Range:
    """Encode differences modulo 65536 so that small ones become small numbers: 0, -1, 1, -2, ... -> 0, 1, 2, 3, ..."""
    signed = change.view(np.int16)
    return ((signed << 1) ^ (signed >> 15)).view(np.uint16)


def unzigzag(coded: Range) -> Range:
    """Decode differences, the inverse of `zigzag`."""
    return (coded >> np.uint16(1)) ^ (np.uint16(0) - (coded & np.uint16(1)))


def foreground_runs(runs: Runs) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Offsets in the flat box and lengths, pixels, [K] each, of foreground runs in order; runs: of labels."""
    body = np.concatenate([[False], runs.values != BACKGROUND, [False]])
    ends = np.concatenate([[0], np.cumsum(runs.lengths)])
    edges = ends[np.flatnonzero(body[1:] != body[:-1])]
    return edges[::2], edges[1::2] - edges[::2]


def encode_slopes(crop: Range, runs: Runs) -> tuple[Bytes, Bytes, Bytes]:
    """Encode `crop`, the ranges in the box, 0 exactly where `runs`, those of its labels, are background.

    Returns the first range of each foreground run, zigzag, as byte planes; one zigzag byte for each other pixel; and
    the escapes of those above 254 (`escape_large`).
    """
    flat = np.ascontiguousarray(crop).ravel()
    starts, _ = foreground_runs(runs)
    step = np.diff(flat, prepend=np.uint16(0)).reshape(crop.shape)
    inner = flat > 0
    inner[starts] = False
    inner = inner.reshape(crop.shape)
    above = np.zeros_like(step)
    for row in range(1, len(step)):
        above[row] = above[row - 1]
        np.copyto(above[row], step[row - 1], where=inner[row - 1])
    coded = zigzag(step - above)
    firsts = to_byte_planes(zigzag(np.diff(flat[starts], prepend=np.uint16(0))))
    return firsts, *escape_large(coded[inner], np.uint16)


def decode_slopes(runs: Runs, slopes: Sequence[Bytes], box: Box, image: Range) -> None:
    """Decode what `encode_slopes` gave into an image [H, W], whatever it holds.

    runs: of labels, filling the box. Raises ValueError if the labels require another number of values.
    """
    (starts, lengths), (firsts, low, escapes) = foreground_runs(runs), slopes
    if len(firsts) != 2 * len(starts) or len(low) != lengths.sum() - len(starts):
        raise ValueError(
            f"{len(starts)} stretches of {lengths.sum()} pixels of body, found {len(firsts) // 2} first ranges and "
            f"{len(low)} others"
        )
    first_ranges = np.cumsum(unzigzag(from_byte_planes(firsts, np.uint16)), dtype=np.uint16)
    steps = unzigzag(unescape(low, escapes, np.uint16))
    image.fill(0)
    body = np.repeat(runs.values != BACKGROUND, runs.lengths).reshape(box.height, box.width)
    np.multiply(_ranges(first_ranges, steps, starts, body), body, out=box.crop(image))


def _ranges(firsts: Range, steps: Range, starts: NDArray[np.int64], body: NDArray[np.bool_]) -> Range:
    """Ranges in the box, arbitrary on background."""
    inner = body.ravel().copy()
    inner[starts] = False
    crop: Range = np.zeros(body.shape, np.uint16)
    flat = crop.ravel()
    flat[inner] = steps
    np.cumsum(crop, axis=0, dtype=np.uint16, out=crop)
    # One cumulative sum over all: the first pixel of a run gets the difference that makes the sum its range.
    flat[starts] = 0
    if len(starts):
        gone = np.add.reduceat(flat, starts, dtype=np.uint16)
        flat[: starts[0]] = 0
        flat[starts] = np.diff(firsts, prepend=np.uint16(0))
        flat[starts[1:]] -= gone[:-1]
    np.cumsum(flat, dtype=np.uint16, out=flat)
    return crop


_LOOPS: Final = "bodyseg_data.shards.codecs.bodyseg_loops"
_DIGITS: Final = 3 ** np.arange(5)
_ABOVE, _LEFT, _NEW = range(3)


def encode_copies(plane: Range) -> tuple[Bytes, Bytes]:
    """Encode an image of many small regions: for each pixel whether it equals the one above, else the one to the left,
    else neither, five in a byte; and the numbers of the last kind, as zigzag differences in byte planes.
    """
    kinds = np.full(plane.shape, _NEW, np.uint8)
    kinds[:, 1:][plane[:, 1:] == plane[:, :-1]] = _LEFT
    kinds[1:][plane[1:] == plane[:-1]] = _ABOVE
    numbers = plane[kinds == _NEW]
    padded = np.concatenate([kinds.ravel(), np.zeros(-plane.size % 5, np.uint8)]).reshape(-1, 5)
    return (padded @ _DIGITS).astype(np.uint8), to_byte_planes(zigzag(np.diff(numbers, prepend=np.uint16(0))))


def copied_bytes(size: tuple[int, int], count: int) -> list[int]:
    """Bytes of what `encode_copies` gives for an image of this size with so many numbers."""
    return [-(-size[0] * size[1] // 5), 2 * count]


def decode_copies(packed: Bytes, stored: Bytes, size: tuple[int, int]) -> Range:
    """Decode what `encode_copies` gave. Raises ValueError for other bytes."""
    pixels, columns = size[0] * size[1], size[1]
    if packed.size and packed.max() >= 3**5:
        raise ValueError(f"five pixels take 0 to {3**5 - 1}, found {packed.max()}")
    table = (np.arange(3**5)[:, None] // _DIGITS % 3).astype(np.uint8)
    kinds = table[packed].reshape(-1)[:pixels]
    numbers = np.cumsum(unzigzag(from_byte_planes(stored, np.uint16)), dtype=np.uint16)
    new = kinds == _NEW
    if int(new.sum()) != len(numbers):
        raise ValueError(f"{int(new.sum())} pixels have a number of their own, found {len(numbers)}")
    if (kinds[:columns] == _ABOVE).any() or (kinds[::columns] == _LEFT).any():
        raise ValueError("a pixel at the edge cannot equal one beyond it")
    with if_ready:
        copied = np.empty(pixels, np.uint16)
        loops(_LOOPS).fill_copies(kinds, numbers, columns, copied)
        return copied.reshape(size)
    index = np.arange(pixels)
    # From a pixel left to where its run of equal ones begins, up to the pixel that this one equals, and so on.
    source = np.maximum.accumulate(np.where(kinds == _LEFT, 0, index))
    source -= np.where(kinds[source] == _ABOVE, columns, 0)
    while not new[source].all():
        source = source[source]
    found = np.zeros(pixels, np.uint16)
    found[new] = numbers
    return found[source].reshape(size)
