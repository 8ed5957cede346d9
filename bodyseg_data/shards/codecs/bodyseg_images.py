"""The default codec: a sample's three images in one file (docs/shard_format.md).

Labels are runs; ranges, what the surface's slope leaves over; the projector's range, runs again. Each row of numbers is
a zstd block with a Huffman table of its own, in two frames, so that the projector's can be left alone. A CRC-32 over
all of it reports altered bytes, and every size is checked before memory is asked for.
"""

from __future__ import annotations

import struct
import threading
import zlib
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np
import zstandard
from numpy.typing import NDArray

from bodyseg_data.core.parts import BACKGROUND
from bodyseg_data.shards.codecs.runs import (
    ESCAPE,
    Box,
    Bytes,
    Runs,
    checked_lengths,
    escaped,
    find_runs,
    from_planes,
    planes,
    used_box,
)
from bodyseg_data.shards.codecs.slopes import Places, Slopes, restore, stretches, to_slopes

MAX_SIDE: Final = 8192
"""Images with a longer side are refused before any memory is asked for."""

_MAGIC: Final = b"BSI2"
_START: Final = struct.Struct("<4sI")  # the magic, a CRC-32 of all that follows
_CAMERA: Final = struct.Struct("<6H6I")
_PROJECTOR: Final = struct.Struct("<6H2I")
_HEADER: Final = _START.size + _CAMERA.size + _PROJECTOR.size

Range = NDArray[np.uint16]


class Decoded(NamedTuple):
    """What was encoded, images [H, W]; occluder: the projector's range [Hp, Wp], None if it was not asked for.

    edges: where the body begins, ends, begins ...; texels: where `occluder` is not 0; places in the flat images, in
    reading order, None where they are not known.
    """

    range: Range
    labels: Bytes
    facing: NDArray[np.bool_]
    occluder: Range | None
    edges: Places | None
    texels: Places | None


def encode_images(camera: Range, labels: Bytes, projector: Range) -> bytes:
    """camera, projector: ranges in steps, 0 background. labels: stored label bytes, 255 exactly where camera is 0."""
    box = used_box(labels != BACKGROUND)
    runs = find_runs(box.of(labels))
    slopes = to_slopes(box.of(camera), runs)
    starts, pixels = stretches(runs)
    lengths, long = escaped(runs.lengths, np.uint32)
    frame = _frame([runs.values, lengths, long, slopes.firsts, slopes.steps, slopes.escapes])
    counts = len(runs.values), len(long) // 4, len(starts), int(pixels.sum()), len(slopes.escapes) // 2, len(frame)
    header = _CAMERA.pack(*camera.shape, box.top, box.left, box.height, box.width, *counts)

    box = used_box(projector > 0)
    runs = find_runs(box.of(projector))
    lengths, long = escaped(runs.lengths, np.uint32)
    header += _PROJECTOR.pack(
        *projector.shape, box.top, box.left, box.height, box.width, len(runs.values), len(long) // 4
    )
    checked = header + frame + _frame([planes(runs.values), lengths, long])
    return _START.pack(_MAGIC, zlib.crc32(checked)) + checked


def _frame(rows: Sequence[Bytes]) -> bytes:
    # Huffman coding is what pays; a longer match finder would only take true numbers for repeated ones.
    settings = zstandard.ZstdCompressionParameters.from_level(1, min_match=7, hash_log=6, window_log=18)
    coder = zstandard.ZstdCompressor(compression_params=settings).compressobj(size=sum(len(row) for row in rows))
    parts = [coder.compress(row.tobytes()) + coder.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK) for row in rows if len(row)]
    return b"".join([*parts, coder.flush()])


def decode_images(data: bytes, projector: bool, into: tuple[Range, Bytes] | None = None) -> Decoded:
    """All images; the projector's range only if it is asked for.

    into: arrays for range and labels. They are what is returned if they fit; the other images are then this thread's,
    and last until its next decoding.

    Raises ValueError, saying what is wrong, for bytes that `encode_images` did not make.
    """
    if len(data) < _HEADER:
        raise ValueError(f"images have a header of {_HEADER} bytes, found {len(data)} bytes in all")
    magic, stored = _START.unpack_from(data)
    if magic != _MAGIC:
        raise ValueError(f"images start with {_MAGIC!r}, found {magic!r}")
    computed = zlib.crc32(memoryview(data)[_START.size :])
    if stored != computed:
        raise ValueError(f"altered: CRC-32 {stored:08x} expected, found {computed:08x}")
    *places, runs, long, starts, pixels, escapes, frame = _CAMERA.unpack_from(data, _START.size)
    size, box = _checked_places(places)
    _check_counts(box, runs, long, starts, pixels, escapes)
    rows = [runs, runs, 4 * long, 2 * starts, pixels - starts, 2 * escapes]
    values, lengths, longs, firsts, steps, large = _rows(data[_HEADER : _HEADER + frame], rows)
    images = _empty_images(size, into)
    runs_of_labels = Runs(values, checked_lengths(lengths, longs, box))
    edges = restore(runs_of_labels, Slopes(firsts, steps, large), box, *images)
    occluder, texels = _decode_projector(data, _HEADER + frame, into is not None) if projector else (None, None)
    return Decoded(*images, occluder, edges, texels)


def _empty_images(size: tuple[int, int], into: tuple[Range, Bytes] | None) -> tuple[Range, Bytes, NDArray[np.bool_]]:
    """Range, labels and facing that show nothing."""
    if into is None or not (_fits(into[0], size, np.uint16) and _fits(into[1], size, np.uint8)):
        return np.zeros(size, np.uint16), np.full(size, BACKGROUND, np.uint8), np.zeros(size, np.bool_)
    image, labels = into
    image.fill(0)
    labels.fill(BACKGROUND)
    return image, labels, _kept("facing", size, np.bool_)


def _fits(array: NDArray[Any], size: tuple[int, int], kind: type[np.generic]) -> bool:
    return array.dtype == kind and array.shape == size and array.flags.carray


def _kept(name: str, size: tuple[int, int], kind: type[np.generic]) -> NDArray[Any]:
    """The thread's own image of that name, all zeros: a fresh one costs as much as decoding into it."""
    image: NDArray[Any] | None = getattr(_of_thread, name, None)
    if image is None or image.shape != size:
        image = np.zeros(size, kind)
        setattr(_of_thread, name, image)
    else:
        image.fill(0)
    return image


def _decode_projector(data: bytes, start: int, keep: bool) -> tuple[Range, Places]:
    *places, runs, long = _PROJECTOR.unpack_from(data, _START.size + _CAMERA.size)
    size, box = _checked_places(places)
    _check_counts(box, runs, long, 0, 0, 0)
    values, lengths, longs = _rows(data[start:], [2 * runs, runs, 4 * long])
    image = _kept("projector", size, np.uint16) if keep else np.zeros(size, np.uint16)
    return image, Runs(from_planes(values, np.uint16), checked_lengths(lengths, longs, box)).placed(image, box)


def _checked_places(places: Sequence[int]) -> tuple[tuple[int, int], Box]:
    rows, columns, top, left, height, width = places
    if not (1 <= rows <= MAX_SIDE and 1 <= columns <= MAX_SIDE):
        raise ValueError(f"an image side is 1 to {MAX_SIDE} pixels, found {rows} x {columns}")
    if top + height > rows or left + width > columns:
        raise ValueError(f"a box of {height} x {width} at {top}, {left} does not fit {rows} x {columns} pixels")
    return (rows, columns), Box(top, left, height, width)


def _check_counts(box: Box, runs: int, long: int, starts: int, pixels: int, escapes: int) -> None:
    """Raise ValueError for counts that no box of this size can have; they say how much memory is needed."""
    area = box.height * box.width
    if runs > area or long * ESCAPE > area or 2 * starts > runs + 1 or not escapes <= pixels <= area or starts > pixels:
        raise ValueError(
            f"{box.height} x {box.width} pixels cannot have {runs} runs ({long} long) and {starts} stretches of "
            f"{pixels} pixels of body ({escapes} escaped)"
        )


def _rows(frame: bytes, sizes: Sequence[int]) -> list[Bytes]:
    """The rows of numbers in a frame, of the given sizes in bytes."""
    total = sum(sizes)
    try:
        # Asked before decoding: zstd allocates whatever a frame claims to hold.
        claimed = zstandard.frame_content_size(frame)
        if claimed != total:
            raise ValueError(f"{total} bytes of numbers expected, the frame claims {claimed}")
        numbers = np.frombuffer(_decompressor().decompress(frame), np.uint8)
    except zstandard.ZstdError as error:
        raise ValueError(f"zstd cannot decode the numbers: {error}") from error
    ends = np.cumsum(sizes).tolist()
    return [numbers[end - size : end] for end, size in zip(ends, sizes, strict=True)]


_of_thread = threading.local()


def _decompressor() -> zstandard.ZstdDecompressor:
    """One a thread: it is costly to make and must not be shared."""
    if not hasattr(_of_thread, "decompressor"):
        _of_thread.decompressor = zstandard.ZstdDecompressor(max_window_size=2 * MAX_SIDE * MAX_SIDE)
    decompressor: zstandard.ZstdDecompressor = _of_thread.decompressor
    return decompressor
