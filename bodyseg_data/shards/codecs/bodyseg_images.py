"""The default codec: a sample's three images in one file (docs/reference/shard_format.md).

Labels are stored as runs, ranges as residuals of the surface's slope, the occluder range as runs. Each sequence of
numbers is a zstd block with its own Huffman table, in two frames, so that the occluder range need not be decoded. A
CRC-32 of the file detects altered bytes, and every size is checked before memory is allocated.
"""

from __future__ import annotations

import struct
import threading
import zlib
from collections.abc import Mapping, Sequence
from functools import lru_cache
from importlib import import_module
from typing import Any, ClassVar, Final, NamedTuple

import numpy as np
import zstandard
from numpy.typing import NDArray

from bodyseg_data.labels import BACKGROUND
from bodyseg_data.machine import use_compiled
from bodyseg_data.rigs import MAX_SIDE
from bodyseg_data.shards.codecs.codec import DecodedImages, OutputArrays
from bodyseg_data.shards.codecs.residuals import (
    ESCAPE,
    Box,
    Bytes,
    Runs,
    Slopes,
    bounding_box,
    checked_lengths,
    decode_slopes,
    encode_slopes,
    escape_large,
    find_runs,
    foreground_runs,
    from_byte_planes,
    to_byte_planes,
)

_MAGIC: Final = b"BSI2"
_START: Final = struct.Struct("<4sI")  # the magic, a CRC-32 of all that follows
_CAMERA: Final = struct.Struct("<6H6I")
_PROJECTOR: Final = struct.Struct("<6H2I")
_HEADER_SIZE: Final = _START.size + _CAMERA.size + _PROJECTOR.size

Range = NDArray[np.uint16]
PixelIndices = NDArray[np.int32]


class CameraCounts(NamedTuple):
    """Numbers of the first frame: runs of labels, the long ones of them, stretches of foreground, pixels of foreground,
    and steps that are escaped.
    """

    runs: int
    long: int
    starts: int
    pixels: int
    escapes: int

    @property
    def sizes(self) -> list[int]:
        """Bytes of each row of the frame."""
        steps = self.pixels - self.starts
        return [self.runs, self.runs, 4 * self.long, 2 * self.starts, steps, 2 * self.escapes]


class ProjectorCounts(NamedTuple):
    """Numbers of the second frame: runs of the occluder range, and the long ones of them."""

    runs: int
    long: int

    @property
    def sizes(self) -> list[int]:
        """Bytes of each row of the frame."""
        return [2 * self.runs, self.runs, 4 * self.long]


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
    if len(data) < _HEADER_SIZE:
        raise ValueError(f"images have a header of {_HEADER_SIZE} bytes, found {len(data)} bytes in all")
    magic, stored = _START.unpack_from(data)
    if magic != _MAGIC:
        raise ValueError(f"images start with {_MAGIC!r}, found {magic!r}")
    view = memoryview(data)
    computed = zlib.crc32(view[_START.size :])
    if stored != computed:
        raise ValueError(f"altered: CRC-32 {stored:08x} expected, found {computed:08x}")
    rows, columns, top, left, height, width, *numbers, frame_bytes = _CAMERA.unpack_from(data, _START.size)
    end = _HEADER_SIZE + frame_bytes
    box, counts = Box(top, left, height, width), CameraCounts(*numbers)
    image, labels, facing, edges = _decode_camera(view[_HEADER_SIZE:end], (rows, columns), box, counts, out)
    occluder, texels = None, None
    if projector:
        rows, columns, top, left, height, width, *numbers = _PROJECTOR.unpack_from(data, _START.size + _CAMERA.size)
        box, found = Box(top, left, height, width), ProjectorCounts(*numbers)
        occluder, texels = _decode_projector(view[end:], (rows, columns), box, found, out is not None)
    return DecodedImages(image, labels, facing, occluder, edges, texels)


def _decode_camera(
    frame: memoryview, size: tuple[int, int], box: Box, counts: CameraCounts, out: tuple[Range, Bytes] | None
) -> tuple[Range, Bytes, NDArray[np.bool_], PixelIndices | None]:
    """Range, labels and facing, and the edges of foreground, None without the compiled loops."""
    _check_header(size, box, counts)
    numbers = _numbers(frame, sum(counts.sizes))
    images = _camera_images(size, out)
    if use_compiled():
        edges = np.empty(2 * (counts.starts + box.height), np.int32)  # a row's end divides at most one stretch
        found = _loops().fill_camera(numbers, counts, box, *images, edges)
        if found >= 0:
            return *images, edges[:found]
    # Numbers that the compiled loop refuses get here, too: the NumPy form says what is wrong with them.
    values, lengths, longs, firsts, steps, large = _split(numbers, counts.sizes)
    decode_slopes(Runs(values, checked_lengths(lengths, longs, box)), Slopes(firsts, steps, large), box, *images)
    return *images, None


def _decode_projector(
    frame: memoryview, size: tuple[int, int], box: Box, counts: ProjectorCounts, keep: bool
) -> tuple[Range, PixelIndices]:
    """The occluder range, and the flat indices of what it holds. keep: in this thread's memory, read-only."""
    _check_header(size, box, CameraCounts(counts.runs, counts.long, 0, 0, 0))
    numbers = _numbers(frame, sum(counts.sizes))
    memory = _of_thread.occluder
    if not keep or memory.image.shape != size:
        memory = OccluderMemory(size)
    if keep:
        _of_thread.occluder = memory
    if use_compiled():
        held, memory.held = memory.held, 0
        found = _loops().fill_projector(numbers, counts, box, memory.image, memory.texels, held)
        if found >= 0:
            memory.held = found
            return memory.seen(keep)
    memory.clear()
    values, lengths, longs = _split(numbers, counts.sizes)
    stored = Runs(from_byte_planes(values, np.uint16), checked_lengths(lengths, longs, box))
    memory.hold(stored.write_into(memory.image, box))
    return memory.seen(keep)


class OccluderMemory:
    """An occluder range [Hp, Wp] and the flat indices of the `held` texels that are not 0.

    A few texels in a hundred hold anything: to clear those takes less time than to clear the image.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        self.image: Range = np.zeros(size, np.uint16)
        self.texels: PixelIndices = np.empty(size[0] * size[1], np.int32)
        self.held = 0
        self._read_only = self.image.view()
        self._read_only.flags.writeable = False

    def clear(self) -> None:
        """Make the image empty."""
        self.image.reshape(-1)[self.texels[: self.held]] = 0
        self.held = 0

    def hold(self, texels: PixelIndices) -> None:
        """Note what the image holds."""
        self.held = len(texels)
        self.texels[: self.held] = texels

    def seen(self, read_only: bool) -> tuple[Range, PixelIndices]:
        """The image and its texels; read-only if the memory is used again: what is written there would stay."""
        texels = self.texels[: self.held]
        if not read_only:
            return self.image, texels
        texels.flags.writeable = False
        return self._read_only, texels


class _ThreadMemory(threading.local):
    """Memory and decompressor that a thread keeps from sample to sample: making them takes as long as decoding."""

    def __init__(self) -> None:
        self.decompressor = zstandard.ZstdDecompressor(max_window_size=2 * MAX_SIDE * MAX_SIDE)
        self.facing: NDArray[np.bool_] = np.empty((0, 0), np.bool_)
        self.occluder = OccluderMemory((0, 0))


_of_thread = _ThreadMemory()


def _camera_images(size: tuple[int, int], out: tuple[Range, Bytes] | None) -> tuple[Range, Bytes, NDArray[np.bool_]]:
    """Arrays for range, labels and facing, whatever they hold."""
    if out is None or not (_fits(out[0], size, np.uint16) and _fits(out[1], size, np.uint8)):
        return np.empty(size, np.uint16), np.empty(size, np.uint8), np.empty(size, np.bool_)
    if _of_thread.facing.shape != size:
        _of_thread.facing = np.empty(size, np.bool_)
    return *out, _of_thread.facing


def _fits(array: NDArray[Any], size: tuple[int, int], kind: type[np.generic]) -> bool:
    return array.dtype == kind and array.shape == size and array.flags.carray


def _check_header(size: tuple[int, int], box: Box, counts: CameraCounts) -> None:
    """Raise ValueError for sizes and counts, by which memory is allocated, that no image of `size` can have."""
    rows, columns = size
    if not (1 <= rows <= MAX_SIDE and 1 <= columns <= MAX_SIDE):
        raise ValueError(f"an image side is 1 to {MAX_SIDE} pixels, found {rows} x {columns}")
    if box.top + box.height > rows or box.left + box.width > columns:
        raise ValueError(
            f"a box of {box.height} x {box.width} at {box.top}, {box.left} does not fit {rows} x {columns} pixels"
        )
    area = box.height * box.width
    runs, long, starts, pixels, escapes = counts
    if runs > area or long * ESCAPE > area or 2 * starts > runs + 1 or not escapes <= pixels <= area or starts > pixels:
        raise ValueError(
            f"{box.height} x {box.width} pixels cannot have {runs} runs ({long} long) and {starts} stretches of "
            f"{pixels} pixels of body ({escapes} escaped)"
        )


def _numbers(frame: memoryview, total: int) -> Bytes:
    """Decompress a frame of `total` bytes of numbers."""
    try:
        # Checked before decoding: zstd allocates the size that the frame claims.
        claimed = zstandard.frame_content_size(frame)
        if claimed != total:
            raise ValueError(f"{total} bytes of numbers expected, the frame claims {claimed}")
        return np.frombuffer(_of_thread.decompressor.decompress(frame), np.uint8)
    except zstandard.ZstdError as error:
        raise ValueError(f"zstd cannot decode the numbers: {error}") from error


def _split(numbers: Bytes, sizes: Sequence[int]) -> list[Bytes]:
    """Divide numbers into rows. sizes: of these, bytes."""
    ends = np.cumsum(sizes).tolist()
    return [numbers[end - size : end] for end, size in zip(ends, sizes, strict=True)]


@lru_cache(maxsize=1)
def _loops() -> Any:
    """The compiled loops; they load numba, so not before they are used."""
    return import_module("bodyseg_data.shards.codecs.bodyseg_loops")
