"""The default codec: a sample's three images in one file (docs/shard_format.md).

Labels are stored as runs, ranges as residuals of the surface's slope, the occluder range as runs. Each sequence of
numbers is a zstd block with its own Huffman table, in two frames, so that the occluder range need not be decoded. A
CRC-32 of the file detects altered bytes, and every size is checked before memory is allocated.
"""

from __future__ import annotations

import struct
import threading
import zlib
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Final

import numpy as np
import zstandard
from numpy.typing import NDArray

from bodyseg_data.core.parts import BACKGROUND
from bodyseg_data.shards.codecs.codec import DecodedImages, OutputArrays
from bodyseg_data.shards.codecs.runs import (
    ESCAPE,
    Box,
    Bytes,
    Runs,
    bounding_box,
    checked_lengths,
    escape_large,
    find_runs,
    from_byte_planes,
    to_byte_planes,
)
from bodyseg_data.shards.codecs.slopes import PixelIndices, Slopes, decode_slopes, encode_slopes, foreground_runs

MAX_SIDE: Final = 8192
"""Longest side of an image, pixels; larger ones are refused before memory is allocated."""

_MAGIC: Final = b"BSI2"
_START: Final = struct.Struct("<4sI")  # the magic, a CRC-32 of all that follows
_CAMERA: Final = struct.Struct("<6H6I")
_PROJECTOR: Final = struct.Struct("<6H2I")
_HEADER: Final = _START.size + _CAMERA.size + _PROJECTOR.size

Range = NDArray[np.uint16]


class BodysegImages:
    """The codec `bsi`: all images in one member of that name."""

    members: ClassVar[tuple[str, ...]] = ("bsi",)

    def encode(self, camera: Range, labels: Bytes, projector: Range) -> dict[str, bytes]:
        """See `ImageCodec.encode`."""
        if not np.array_equal(camera == 0, labels == BACKGROUND):
            raise ValueError(f"labels must be {BACKGROUND} exactly where range is 0")
        return {"bsi": encode_images(camera, labels, projector)}

    def decode(self, members: Mapping[str, bytes], projector: bool, out: OutputArrays | None) -> DecodedImages:
        """See `ImageCodec.decode`; `out` is used."""
        try:
            return decode_images(members["bsi"], projector, out)
        except ValueError as error:
            raise ValueError(f"bsi: {error}") from error


def encode_images(camera: Range, labels: Bytes, projector: Range) -> bytes:
    """Encode the images of a sample. camera, projector: ranges, steps, 0 background. labels: label bytes, 255 exactly
    where camera is 0.
    """
    box = bounding_box(labels != BACKGROUND)
    runs = find_runs(box.crop(labels))
    slopes = encode_slopes(box.crop(camera), runs)
    starts, pixels = foreground_runs(runs)
    lengths, long = escape_large(runs.lengths, np.uint32)
    frame = _frame([runs.values, lengths, long, slopes.firsts, slopes.steps, slopes.escapes])
    counts = len(runs.values), len(long) // 4, len(starts), int(pixels.sum()), len(slopes.escapes) // 2, len(frame)
    header = _CAMERA.pack(*camera.shape, box.top, box.left, box.height, box.width, *counts)

    box = bounding_box(projector > 0)
    runs = find_runs(box.crop(projector))
    lengths, long = escape_large(runs.lengths, np.uint32)
    header += _PROJECTOR.pack(
        *projector.shape, box.top, box.left, box.height, box.width, len(runs.values), len(long) // 4
    )
    checked = header + frame + _frame([to_byte_planes(runs.values), lengths, long])
    return _START.pack(_MAGIC, zlib.crc32(checked)) + checked


def _frame(rows: Sequence[Bytes]) -> bytes:
    # Huffman coding gives the gain; a longer match finder would only find accidental repetitions.
    settings = zstandard.ZstdCompressionParameters.from_level(1, min_match=7, hash_log=6, window_log=18)
    coder = zstandard.ZstdCompressor(compression_params=settings).compressobj(size=sum(len(row) for row in rows))
    parts = [coder.compress(row.tobytes()) + coder.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK) for row in rows if len(row)]
    return b"".join([*parts, coder.flush()])


def decode_images(data: bytes, projector: bool, out: tuple[Range, Bytes] | None = None) -> DecodedImages:
    """Decode all images. projector: decode the occluder range, too.

    out: arrays for range and labels, used and returned if shape and dtype match; with `out`, the other images belong
    to this thread and are valid until its next decoding.

    Raises ValueError, naming the problem, for bytes that `encode_images` did not produce.
    """
    if len(data) < _HEADER:
        raise ValueError(f"images have a header of {_HEADER} bytes, found {len(data)} bytes in all")
    magic, stored = _START.unpack_from(data)
    if magic != _MAGIC:
        raise ValueError(f"images start with {_MAGIC!r}, found {magic!r}")
    computed = zlib.crc32(memoryview(data)[_START.size :])
    if stored != computed:
        raise ValueError(f"altered: CRC-32 {stored:08x} expected, found {computed:08x}")
    *geometry, runs, long, starts, pixels, escapes, frame = _CAMERA.unpack_from(data, _START.size)
    size, box = _checked_geometry(geometry)
    _check_counts(box, runs, long, starts, pixels, escapes)
    rows = [runs, runs, 4 * long, 2 * starts, pixels - starts, 2 * escapes]
    values, lengths, longs, firsts, steps, large = _number_rows(data[_HEADER : _HEADER + frame], rows)
    images = _empty_images(size, out)
    runs_of_labels = Runs(values, checked_lengths(lengths, longs, box))
    edges = decode_slopes(runs_of_labels, Slopes(firsts, steps, large), box, *images)
    occluder, texels = _decode_projector(data, _HEADER + frame, out is not None) if projector else (None, None)
    return DecodedImages(*images, occluder, edges, texels)


def _empty_images(size: tuple[int, int], out: tuple[Range, Bytes] | None) -> tuple[Range, Bytes, NDArray[np.bool_]]:
    """Range, labels and facing of an image of background."""
    if out is None or not (_fits(out[0], size, np.uint16) and _fits(out[1], size, np.uint8)):
        return np.zeros(size, np.uint16), np.full(size, BACKGROUND, np.uint8), np.zeros(size, np.bool_)
    image, labels = out
    image.fill(0)
    labels.fill(BACKGROUND)
    return image, labels, _thread_image("facing", size, np.bool_)


def _fits(array: NDArray[Any], size: tuple[int, int], kind: type[np.generic]) -> bool:
    return array.dtype == kind and array.shape == size and array.flags.carray


def _thread_image(name: str, size: tuple[int, int], kind: type[np.generic]) -> NDArray[Any]:
    """The thread's own image of that name, all zeros: allocating one takes as long as decoding into it."""
    image: NDArray[Any] | None = getattr(_thread_local, name, None)
    if image is None or image.shape != size:
        image = np.zeros(size, kind)
        setattr(_thread_local, name, image)
    else:
        image.fill(0)
    return image


def _decode_projector(data: bytes, start: int, keep: bool) -> tuple[Range, PixelIndices]:
    *geometry, runs, long = _PROJECTOR.unpack_from(data, _START.size + _CAMERA.size)
    size, box = _checked_geometry(geometry)
    _check_counts(box, runs, long, 0, 0, 0)
    values, lengths, longs = _number_rows(data[start:], [2 * runs, runs, 4 * long])
    image = _thread_image("projector", size, np.uint16) if keep else np.zeros(size, np.uint16)
    return image, Runs(from_byte_planes(values, np.uint16), checked_lengths(lengths, longs, box)).write_into(image, box)


def _checked_geometry(geometry: Sequence[int]) -> tuple[tuple[int, int], Box]:
    rows, columns, top, left, height, width = geometry
    if not (1 <= rows <= MAX_SIDE and 1 <= columns <= MAX_SIDE):
        raise ValueError(f"an image side is 1 to {MAX_SIDE} pixels, found {rows} x {columns}")
    if top + height > rows or left + width > columns:
        raise ValueError(f"a box of {height} x {width} at {top}, {left} does not fit {rows} x {columns} pixels")
    return (rows, columns), Box(top, left, height, width)


def _check_counts(box: Box, runs: int, long: int, starts: int, pixels: int, escapes: int) -> None:
    """Raise ValueError for counts, by which memory is allocated, that no box of this size can have."""
    area = box.height * box.width
    if runs > area or long * ESCAPE > area or 2 * starts > runs + 1 or not escapes <= pixels <= area or starts > pixels:
        raise ValueError(
            f"{box.height} x {box.width} pixels cannot have {runs} runs ({long} long) and {starts} stretches of "
            f"{pixels} pixels of body ({escapes} escaped)"
        )


def _number_rows(frame: bytes, sizes: Sequence[int]) -> list[Bytes]:
    """Decompress a frame into its sequences of numbers. sizes: of these, bytes."""
    total = sum(sizes)
    try:
        # Checked before decoding: zstd allocates the size that the frame claims.
        claimed = zstandard.frame_content_size(frame)
        if claimed != total:
            raise ValueError(f"{total} bytes of numbers expected, the frame claims {claimed}")
        numbers = np.frombuffer(_decompressor().decompress(frame), np.uint8)
    except zstandard.ZstdError as error:
        raise ValueError(f"zstd cannot decode the numbers: {error}") from error
    ends = np.cumsum(sizes).tolist()
    return [numbers[end - size : end] for end, size in zip(ends, sizes, strict=True)]


_thread_local = threading.local()


def _decompressor() -> zstandard.ZstdDecompressor:
    """The thread's decompressor: construction is costly, and threads must not share one."""
    if not hasattr(_thread_local, "decompressor"):
        _thread_local.decompressor = zstandard.ZstdDecompressor(max_window_size=2 * MAX_SIDE * MAX_SIDE)
    decompressor: zstandard.ZstdDecompressor = _thread_local.decompressor
    return decompressor
