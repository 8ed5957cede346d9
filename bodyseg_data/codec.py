"""Samples to bytes and back: pure, versioned, lossless.

A sample is four members of a tar: `json`, and three images whose extension names their codec.

    bsi   crop to the foreground, two-way difference, byte planes, zstd (the default; docs/shard_format.md)
    png   plain 16-bit and 8-bit PNG, for shards that any image tool opens
"""

from __future__ import annotations

import io
import json
import struct
import threading
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Final, Literal, Protocol, get_args

import numpy as np
import zstandard
from numpy.typing import NDArray

from bodyseg_data.errors import BadConfig, BadSample
from bodyseg_data.parts import BACKGROUND
from bodyseg_data.sample import Sample, info_from_json

CodecName = Literal["bsi", "png"]
CODECS: Final[tuple[CodecName, ...]] = get_args(CodecName)

FACING_BIT: Final = 0x40
"""Set in a stored label where the surface faces the projector; background stays 255."""

MAX_SIDE: Final = 8192
"""Images with a longer side are refused before any memory is asked for."""

_IMAGES: Final = {"range": np.uint16, "projector": np.uint16, "labels": np.uint8}
_MAGIC: Final = b"BSI1"
_FIELDS: Final = struct.Struct("<BBHHHHHH")  # bytes a pixel, background, rows, columns, top, left, height, width
_HEADER: Final = 8 + _FIELDS.size  # the magic, a CRC-32 of all that follows it, the fields
_ZSTD_LEVEL: Final = 1  # 5 % more bytes than level 9 in a fifth of its time (docs/renderers.md)

Image = NDArray[Any]


class ImageCodec(Protocol):
    """Lossless bytes for one uint8 or uint16 image."""

    def encode(self, image: Image, background: int) -> bytes:
        """`image` [H, W] as bytes; `background` is the value expected to fill most of it."""

    def decode(self, data: bytes) -> Image:
        """The inverse. Raises ValueError, saying what is wrong, for bytes that `encode` did not make."""


def image_codec(name: str) -> ImageCodec:
    """The codec called `name`. Raises BadConfig."""
    if name == "bsi":
        return BsiCodec()
    if name == "png":
        return PngCodec()
    raise BadConfig(f"the codec must be one of {', '.join(CODECS)}, found {name!r}")


@dataclass(frozen=True)
class BsiCodec:
    """Crop, two-way difference (16-bit images), byte planes, zstd.

    Surfaces are locally planar, so x - left - up + up-left is small; the two bytes of what remains are stored apart
    because the upper one is nearly constant.
    """

    level: int = _ZSTD_LEVEL

    def encode(self, image: Image, background: int) -> bytes:
        used = image != background
        rows, columns = np.flatnonzero(used.any(axis=1)), np.flatnonzero(used.any(axis=0))
        top, left, height, width = 0, 0, 0, 0
        if len(rows):
            top, left = int(rows[0]), int(columns[0])
            height, width = int(rows[-1]) - top + 1, int(columns[-1]) - left + 1
        crop = image[top : top + height, left : left + width]
        fields = _FIELDS.pack(image.itemsize, background, *image.shape, top, left, height, width)
        checked = fields + zstandard.ZstdCompressor(level=self.level).compress(_to_planes(crop))
        return _MAGIC + zlib.crc32(checked).to_bytes(4, "little") + checked

    def decode(self, data: bytes) -> Image:
        if len(data) < _HEADER:
            raise ValueError(f"an image has a header of {_HEADER} bytes, found {len(data)} bytes in all")
        if data[:4] != _MAGIC:
            raise ValueError(f"an image starts with {_MAGIC!r}, found {data[:4]!r}")
        stored, computed = int.from_bytes(data[4:8], "little"), zlib.crc32(memoryview(data)[8:])
        if stored != computed:
            raise ValueError(f"altered: CRC-32 {stored:08x} expected, found {computed:08x}")
        size, background, rows, columns, top, left, height, width = _FIELDS.unpack_from(data, 8)
        if size not in (1, 2):
            raise ValueError(f"an image has 1 or 2 bytes a pixel, found {size}")
        if not (1 <= rows <= MAX_SIDE and 1 <= columns <= MAX_SIDE):
            raise ValueError(f"an image side is 1 to {MAX_SIDE} pixels, found {rows} x {columns}")
        if top + height > rows or left + width > columns:
            raise ValueError(f"a crop of {height} x {width} at {top}, {left} does not fit {rows} x {columns} pixels")
        expected = height * width * size
        payload = memoryview(data)[_HEADER:]
        try:
            # Asked before decoding: zstd allocates whatever a frame claims to hold.
            claimed = zstandard.frame_content_size(payload)
            if claimed != expected:
                raise ValueError(
                    f"a crop of {height} x {width} pixels has {expected} bytes, the frame claims {claimed}"
                )
            planes = _decompressor().decompress(payload)
        except zstandard.ZstdError as error:
            raise ValueError(f"zstd cannot decode the crop: {error}") from error
        image = np.full((rows, columns), background, np.uint16 if size == 2 else np.uint8)
        image[top : top + height, left : left + width] = _from_planes(planes, size, height, width)
        return image


def _to_planes(crop: Image) -> bytes:
    if crop.itemsize == 1:
        return crop.tobytes()  # labels are flat areas: differences only add edges
    change = crop.copy()
    change[:, 1:] -= crop[:, :-1]
    across = change.copy()
    change[1:] -= across[:-1]
    return change.astype("<u2").view(np.uint8).reshape(-1, 2).T.tobytes()


def _from_planes(planes: bytes, size: int, height: int, width: int) -> Image:
    stored = np.frombuffer(planes, np.uint8)
    if size == 1:
        return stored.reshape(height, width)
    low, high = stored.reshape(2, height, width)
    image = low | (high.astype(np.uint16) << 8)
    # Sums wrap around at 16 bits exactly as the differences did.
    np.cumsum(image, axis=0, dtype=np.uint16, out=image)
    np.cumsum(image, axis=1, dtype=np.uint16, out=image)
    return image


_of_thread = threading.local()


def _decompressor() -> zstandard.ZstdDecompressor:
    """One a thread: it is costly to make and must not be shared."""
    if not hasattr(_of_thread, "decompressor"):
        _of_thread.decompressor = zstandard.ZstdDecompressor(max_window_size=2 * MAX_SIDE * MAX_SIDE)
    decompressor: zstandard.ZstdDecompressor = _of_thread.decompressor
    return decompressor


@dataclass(frozen=True)
class PngCodec:
    """PNG by Pillow, whose 16-bit greyscale is lossless (some readers of plain tars clip 16-bit PNGs to 8 bits)."""

    def encode(self, image: Image, background: int) -> bytes:
        from PIL import Image as Pillow

        buffer = io.BytesIO()
        Pillow.fromarray(image).save(buffer, "PNG")
        return buffer.getvalue()

    def decode(self, data: bytes) -> Image:
        from PIL import Image as Pillow

        # Asked before opening: Pillow allocates, and warns, by what a file claims.
        columns, rows = int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")
        if not (1 <= rows <= MAX_SIDE and 1 <= columns <= MAX_SIDE):
            raise ValueError(f"not a readable PNG: an image side is 1 to {MAX_SIDE} pixels, found {rows} x {columns}")
        try:
            with Pillow.open(io.BytesIO(data), formats=["PNG"]) as picture:
                if picture.mode not in ("L", "I;16"):
                    raise ValueError(f"a PNG must be 8- or 16-bit greyscale, found mode {picture.mode}")
                return np.asarray(picture).copy()
        except (OSError, SyntaxError) as error:
            raise ValueError(f"not a readable PNG: {error}") from error


def encode_sample(sample: Sample, codec: str = "bsi") -> dict[str, bytes]:
    """A sample as tar members: extension -> bytes. The same sample gives the same bytes."""
    coder = image_codec(codec)
    labels = np.where(sample.faces_projector, sample.labels | FACING_BIT, sample.labels).astype(np.uint8)
    images: dict[str, tuple[Image, int]] = {
        "range": (sample.range, 0),
        "projector": (sample.projector_range, 0),
        "labels": (labels, BACKGROUND),
    }
    members = {f"{name}.{codec}": coder.encode(image, background) for name, (image, background) in images.items()}
    members["json"] = json.dumps(asdict(sample.info), sort_keys=True).encode()
    return members


def decode_sample(key: str, members: Mapping[str, bytes]) -> Sample:
    """The inverse of `encode_sample`, whichever codec the extensions name.

    Raises BadSample, naming key and member, for anything missing, unknown or damaged.
    """
    names = {name: name.partition(".") for name in members if name != "json"}
    codecs = {extension for _, _, extension in names.values()}
    if "json" not in members or sorted(stem for stem, _, _ in names.values()) != sorted(_IMAGES) or len(codecs) != 1:
        raise BadSample(f"{key}: a sample has json, range, projector and labels in one codec, found {sorted(members)}")
    (extension,) = codecs
    if extension not in CODECS:
        raise BadSample(f"{key}: no codec is called {extension!r}, known are {', '.join(CODECS)}")
    coder = image_codec(extension)
    images: dict[str, Image] = {}
    for name, kind in _IMAGES.items():
        member = f"{name}.{extension}"
        try:
            images[name] = coder.decode(members[member])
        except ValueError as error:
            raise BadSample(f"{key}: {member}: {error}") from error
        if images[name].dtype != kind:
            raise BadSample(f"{key}: {member}: must be {kind.__name__}, found {images[name].dtype}")
    try:
        info = info_from_json(json.loads(members["json"]), key)
    except (ValueError, RecursionError) as error:
        raise BadSample(f"{key}: json: {error}") from error
    labels, facing = split_labels(images["labels"])
    return Sample(key, images["range"], images["projector"], labels, facing, info)


def split_labels(stored: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Stored label byte -> (labels 0..32 or 255, whether the surface faces the projector)."""
    foreground = stored != BACKGROUND
    facing: NDArray[np.bool_] = foreground & ((stored & FACING_BIT) != 0)
    return np.where(foreground, stored & ~np.uint8(FACING_BIT), stored).astype(np.uint8), facing
