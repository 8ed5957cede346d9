"""The default codec: a sample's images in one file (docs/reference/shard_format.md).

Labels and facing are stored as runs, ranges as residuals of the surface's slope, the projector's range as runs where it
was reduced to what the shadow test needs, and as the camera's where it was not. Each sequence of numbers is a zstd
block with its own Huffman table, in two frames, so that the projector's range need not be decoded. A CRC-32 of the file
detects altered bytes, and every size is checked before memory is allocated.
"""

import struct
import threading
import zlib
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Final, NamedTuple

import numpy as np
import zstandard
from numpy.typing import NDArray

from bodyseg_data.labels import BACKGROUND, UNLABELLED
from bodyseg_data.machine import if_ready, loops
from bodyseg_data.rigs import MAX_SIDE
from bodyseg_data.shards.codecs.codec import FACING, SECOND_FACING, Bytes, DecodedImages, OutputArrays, Range
from bodyseg_data.shards.codecs.residuals import (
    ESCAPE,
    Box,
    Runs,
    bounding_box,
    checked_lengths,
    copied_bytes,
    decode_copies,
    decode_slopes,
    encode_copies,
    encode_slopes,
    escape_large,
    find_runs,
    foreground_runs,
    from_byte_planes,
    to_byte_planes,
)
from bodyseg_data.shards.earlier import split_label_bytes

_LOOPS: Final = "bodyseg_data.shards.codecs.bodyseg_loops"

_MAGIC: Final = b"BSI3"
_EARLIER_MAGIC: Final = b"BSI2"
_PLANE_MAGIC: Final = b"BSP1"
_COPIED_MAGIC: Final = b"BSP2"
_MANY_RUNS: Final = 32  # a plane whose runs have fewer pixels than this on average is stored as copies
_START: Final = struct.Struct("<4sI")  # the magic, a CRC-32 of all that follows
_CAMERA: Final = struct.Struct("<6H6I")
_PROJECTOR: Final = struct.Struct("<H6H5I")
_EARLIER_PROJECTOR: Final = struct.Struct("<6H2I")
_PLANE: Final = struct.Struct("<H2H2I")  # bytes a pixel, rows, columns, runs, long runs
_NONE, _RUNS, _SLOPES = 0, 1, 2  # how the projector's range is stored

PixelIndices = NDArray[np.int32]


class Counts(NamedTuple):
    """Numbers of a frame: runs, the long ones of them, and of slopes, whose runs are of labels, also stretches of
    foreground, pixels of foreground, and steps that are escaped.
    """

    runs: int
    long: int
    starts: int = 0
    pixels: int = 0
    escapes: int = 0

    def of_runs(self, width: int) -> list[int]:
        """Bytes of each row of a frame of runs: values of `width` bytes, lengths, those of the long ones."""
        return [width * self.runs, self.runs, 4 * self.long]

    def of_slopes(self) -> list[int]:
        """Bytes of each row of a frame of slopes: labels, facing, lengths, long ones, and `encode_slopes`."""
        return [self.runs, *self.of_runs(1), 2 * self.starts, self.pixels - self.starts, 2 * self.escapes]


class BodysegImages:
    """The codec `bsi`: all images in one member of that name."""

    members: ClassVar[tuple[str, ...]] = ("bsi",)

    def encode(self, camera: Range, labels: Bytes, facing: Bytes, projector: Range | None) -> dict[str, bytes]:
        if not np.array_equal(camera == 0, labels == BACKGROUND):
            raise ValueError(f"labels must be {BACKGROUND} exactly where range is 0")
        return {"bsi": encode_images(camera, labels, facing, projector)}

    def decode(
        self, members: Mapping[str, bytes], projector: bool, out: OutputArrays | None, unlabelled: int
    ) -> DecodedImages:
        """See `ImageCodec.decode`; `out` is used."""
        try:
            return decode_images(members["bsi"], projector, out, unlabelled)
        except ValueError as error:
            raise ValueError(f"bsi: {error}") from error

    def encode_plane(self, plane: Bytes | Range) -> dict[str, bytes]:
        """See `ImageCodec.encode_plane`: runs, of which images of classes and instances have few; else copies."""
        runs = find_runs(plane)
        if _MANY_RUNS * len(runs.values) > plane.size and plane.itemsize == 2:
            kinds, numbers = encode_copies(plane.astype(np.uint16))
            checked = _PLANE.pack(2, *plane.shape, len(numbers) // 2, 0) + _frame([kinds, numbers])
            return {"bsp": _START.pack(_COPIED_MAGIC, zlib.crc32(checked)) + checked}
        counts, frame = _frame_of(runs)
        checked = _PLANE.pack(plane.itemsize, *plane.shape, *counts[:2]) + frame
        return {"bsp": _START.pack(_PLANE_MAGIC, zlib.crc32(checked)) + checked}

    def decode_plane(self, data: bytes) -> Bytes | Range:
        view = _checked(data, (_PLANE_MAGIC, _COPIED_MAGIC), _PLANE.size)
        width, rows, columns, *found = _PLANE.unpack_from(view)
        box, counts = Box(0, 0, rows, columns), Counts(*found)
        _check_header((rows, columns), box, counts)
        if width not in (1, 2):
            raise ValueError(f"a plane has 1 or 2 bytes a pixel, found {width}")
        if data[:4] == _COPIED_MAGIC:
            sizes = copied_bytes((rows, columns), counts.runs)
            kinds, numbers = _split(_numbers(view[_PLANE.size :], sum(sizes)), sizes)
            return decode_copies(kinds, numbers, (rows, columns))
        return _pixels_of(_numbers(view[_PLANE.size :], sum(counts.of_runs(width))), counts, width, box)


def _frame_of(runs: Runs) -> tuple[Counts, bytes]:
    """The counts and the frame of runs alone."""
    lengths, long = escape_large(runs.lengths, np.uint32)
    return Counts(len(runs.values), len(long) // 4), _frame([to_byte_planes(runs.values), lengths, long])


def _pixels_of(numbers: Bytes, counts: Counts, width: int, box: Box) -> Bytes | Range:
    """The pixels in a box whose runs `_frame_of` gave, of `width` bytes each. Raises ValueError."""
    values, lengths, longs = _split(numbers, counts.of_runs(width))
    stored = from_byte_planes(values, np.uint8 if width == 1 else np.uint16)
    return np.repeat(stored, checked_lengths(lengths, longs, box)).reshape(box.height, box.width)


def _slopes_of(image: Range, labels: Bytes, facing: Bytes) -> tuple[Box, Counts, bytes]:
    """The box, the counts and the frame of a range image and its labels, which are 255 exactly where the range is 0."""
    box = bounding_box(labels != BACKGROUND)
    joined = find_runs(box.crop(labels).astype(np.uint16) | (box.crop(facing).astype(np.uint16) << np.uint16(8)))
    runs = Runs((joined.values & np.uint16(255)).astype(np.uint8), joined.lengths)
    slopes = encode_slopes(box.crop(image), runs)
    starts, pixels = foreground_runs(runs)
    lengths, long = escape_large(runs.lengths, np.uint32)
    faced = (joined.values >> np.uint16(8)).astype(np.uint8)
    counts = Counts(len(runs.values), len(long) // 4, len(starts), int(pixels.sum()), len(slopes[-1]) // 2)
    return box, counts, _frame([runs.values, faced, lengths, long, *slopes])


def encode_images(camera: Range, labels: Bytes, facing: Bytes, projector: Range | None) -> bytes:
    """Encode the images of a sample; see `ImageCodec.encode`."""
    box, counts, frame = _slopes_of(camera, labels, facing)
    header = _CAMERA.pack(*camera.shape, *box, *counts, len(frame))
    if projector is None:
        checked = header + _PROJECTOR.pack(_NONE, *(11 * [0])) + frame
    elif _is_smooth(projector):
        shown = np.where(projector > 0, np.uint8(0), np.uint8(BACKGROUND))
        box, counts, second = _slopes_of(projector, shown, np.zeros_like(shown))
        checked = header + _PROJECTOR.pack(_SLOPES, *projector.shape, *box, *counts) + frame + second
    else:
        box = bounding_box(projector > 0)
        counts, second = _frame_of(find_runs(box.crop(projector)))
        checked = header + _PROJECTOR.pack(_RUNS, *projector.shape, *box, *counts) + frame + second
    return _START.pack(_MAGIC, zlib.crc32(checked)) + checked


def _is_smooth(projector: Range) -> bool:
    """True if a projector's range takes much less as slopes than as runs, as one does that was not rounded.

    Ranges rounded for the shadow test are multiples of powers of two, few of them odd. As slopes they would save half a
    percent of a sample's bytes, and a sample would take three times as long to decode.
    """
    changes, texels = np.count_nonzero(projector[:, 1:] != projector[:, :-1]), np.count_nonzero(projector)
    return bool(4 * changes > texels and 4 * np.count_nonzero(projector & np.uint16(1)) > texels)


def _frame(rows: Sequence[Bytes]) -> bytes:
    # Huffman coding gives the gain; a longer match finder would only find accidental repetitions.
    settings = zstandard.ZstdCompressionParameters.from_level(1, min_match=7, hash_log=6, window_log=18)
    coder = zstandard.ZstdCompressor(compression_params=settings).compressobj(size=sum(len(row) for row in rows))
    parts = [coder.compress(row.tobytes()) + coder.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK) for row in rows if len(row)]
    return b"".join([*parts, coder.flush()])


def decode_images(
    data: bytes, projector: bool, out: tuple[Range, Bytes] | None = None, unlabelled: int = UNLABELLED
) -> DecodedImages:
    """Decode all images. projector: decode the projector's range, too. unlabelled: see `ImageCodec.decode`.

    out: arrays for range and labels, used and returned if shape and dtype match; with `out`, the other images belong
    to this thread and are valid until its next decoding.

    Raises ValueError, naming the problem, for bytes that `encode_images` did not produce, now or in an earlier format.
    """
    earlier = data[:4] == _EARLIER_MAGIC
    second = _EARLIER_PROJECTOR if earlier else _PROJECTOR
    view = _checked(data, (_MAGIC, _EARLIER_MAGIC), _CAMERA.size + second.size)
    rows, columns, top, left, height, width, *numbers, frame_bytes = _CAMERA.unpack_from(view)
    start = _CAMERA.size + second.size
    end = start + frame_bytes
    size, box, counts = (rows, columns), Box(top, left, height, width), Counts(*numbers)
    image, labels, facing, edges = _decode_camera(view[start:end], size, box, counts, out, unlabelled, earlier)
    occluder, texels = None, None
    if projector:
        kind, rows, columns, top, left, height, width, *numbers = (
            (_RUNS, *second.unpack_from(view, _CAMERA.size)) if earlier else second.unpack_from(view, _CAMERA.size)
        )
        size, box = (rows, columns), Box(top, left, height, width)
        if kind == _RUNS:
            occluder, texels = _decode_projector(view[end:], size, box, Counts(*numbers[:2]), out is not None)
        elif kind == _SLOPES:
            occluder = _decode_camera(view[end:], size, box, Counts(*numbers), None, BACKGROUND)[0]
            texels = np.flatnonzero(occluder).astype(np.int32)
        elif kind != _NONE:
            raise ValueError(f"the projector's range is stored in the ways 0 to 2, found {kind}")
    return DecodedImages(image, labels, facing, occluder, edges, texels)


def _checked(data: bytes, magics: Sequence[bytes], header_size: int) -> memoryview:
    """All that follows the start of a file, after a test of its checksum. Raises ValueError."""
    if len(data) < _START.size + header_size:
        raise ValueError(f"images have a header of {_START.size + header_size} bytes, found {len(data)} bytes in all")
    magic, stored = _START.unpack_from(data)
    if magic not in magics:
        raise ValueError(f"images start with {magics[0]!r}, found {magic!r}")
    view = memoryview(data)[_START.size :]
    computed = zlib.crc32(view)
    if stored != computed:
        raise ValueError(f"altered: CRC-32 {stored:08x} expected, found {computed:08x}")
    return view


def _decode_camera(
    frame: memoryview,
    size: tuple[int, int],
    box: Box,
    counts: Counts,
    out: tuple[Range, Bytes] | None,
    unlabelled: int,
    earlier: bool = False,
) -> tuple[Range, Bytes, Bytes, PixelIndices | None]:
    """Range, labels and facing, and the edges of foreground, None without the compiled loops."""
    _check_header(size, box, counts)
    numbers = _numbers(frame, sum(counts.of_slopes()) - counts.runs * earlier)
    if earlier:
        labels, facing = split_label_bytes(numbers[: counts.runs])
        numbers = np.concatenate([labels, facing, numbers[counts.runs :]])
    images = _camera_images(size, out)
    with if_ready:
        edges = np.empty(2 * (counts.starts + box.height), np.int32)  # the end of a row divides at most one stretch
        found = loops(_LOOPS).fill_camera(numbers, counts, box, np.uint8(unlabelled), *images, edges)
        if found >= 0:
            return *images, edges[:found]
    # Numbers that the compiled loop refuses get here, too: the NumPy form says what is wrong with them.
    values, faced, lengths, longs, *slopes = _split(numbers, counts.of_slopes())
    if (faced > FACING + SECOND_FACING).any() or faced[values == BACKGROUND].any():
        raise ValueError("facing must be bits 0 and 1, and 0 on background")
    runs = Runs(values, checked_lengths(lengths, longs, box))
    decode_slopes(runs, slopes, box, images[0])
    shown = np.where(values == UNLABELLED, np.uint8(unlabelled), values)
    for image, of_runs, nothing in ((images[1], shown, BACKGROUND), (images[2], faced, 0)):
        image.fill(nothing)
        box.crop(image)[:] = np.repeat(of_runs, runs.lengths).reshape(box.height, box.width)
    return *images, None


def _decode_projector(
    frame: memoryview, size: tuple[int, int], box: Box, counts: Counts, keep: bool
) -> tuple[Range, PixelIndices]:
    """The occluder range, and the flat indices of what it holds. keep: in this thread's memory."""
    _check_header(size, box, counts)
    numbers = _numbers(frame, sum(counts.of_runs(2)))
    image = _of_thread.occluder
    if not keep or image.shape != size:
        image = np.empty(size, np.uint16)
    if keep:
        _of_thread.occluder = image
    image.fill(0)
    with if_ready:
        texels = np.empty(image.size, np.int32)
        found = loops(_LOOPS).fill_projector(numbers, counts, box, image, texels)
        if found >= 0:
            return image, texels[:found]
    box.crop(image)[:] = _pixels_of(numbers, counts, 2, box)
    return image, np.flatnonzero(image != 0).astype(np.int32)  # searching booleans is several times as fast


class _ThreadMemory(threading.local):
    """Memory and decompressor that a thread keeps from sample to sample: making them takes as long as decoding."""

    def __init__(self) -> None:
        self.decompressor = zstandard.ZstdDecompressor(max_window_size=2 * MAX_SIDE * MAX_SIDE)
        self.facing: Bytes = np.empty((0, 0), np.uint8)
        self.occluder: Range = np.empty((0, 0), np.uint16)


_of_thread = _ThreadMemory()


def _camera_images(size: tuple[int, int], out: tuple[Range, Bytes] | None) -> tuple[Range, Bytes, Bytes]:
    """Arrays for range, labels and facing, with any content: those of `out` if they fit."""
    if out is None or not (_fits(out[0], size, np.uint16) and _fits(out[1], size, np.uint8)):
        return np.empty(size, np.uint16), np.empty(size, np.uint8), np.empty(size, np.uint8)
    if _of_thread.facing.shape != size:
        _of_thread.facing = np.empty(size, np.uint8)
    return *out, _of_thread.facing


def _fits(array: NDArray[Any], size: tuple[int, int], kind: type[np.generic]) -> bool:
    return array.dtype == kind and array.shape == size and array.flags.carray


def _check_header(size: tuple[int, int], box: Box, counts: Counts) -> None:
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
