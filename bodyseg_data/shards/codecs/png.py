"""Codec of 8-bit and 16-bit PNG, for shards readable by any image tool, and a reader of PNG chunks."""

import io
import struct
import zlib
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import reported
from bodyseg_data.labels import UNLABELLED
from bodyseg_data.rigs import MAX_SIDE
from bodyseg_data.shards.codecs.codec import FACING, SECOND_FACING, Bytes, DecodedImages, OutputArrays, Range
from bodyseg_data.shards.earlier import split_label_bytes

SIGNATURE: Final = b"\x89PNG\r\n\x1a\n"

_UNREADABLE: Final = "not a readable PNG"
_HEADER_BYTES: Final = 25  # of the chunk IHDR: length, name, 13 bytes, checksum


class Chunk(NamedTuple):
    """A chunk of a PNG. name: four letters. whole: its bytes in the file: length, name, content and checksum."""

    name: bytes
    whole: bytes


class Header(NamedTuple):
    """Header of a PNG: size in pixels, bits of a sample, and colour type (0 is greyscale)."""

    rows: int
    columns: int
    bits: int
    colour: int


def read_chunks(data: bytes) -> list[Chunk]:
    """Split a PNG into chunks up to its end, IEND (W3C, "Portable Network Graphics", 5.3), without testing checksums.

    Raises ValueError for a file that is truncated or no PNG.
    """
    if not data.startswith(SIGNATURE):
        raise ValueError("a PNG must begin with its signature")
    chunks: list[Chunk] = []
    end = len(SIGNATURE)
    while not chunks or chunks[-1].name != b"IEND":
        start, end = end, end + 12 + int.from_bytes(data[end : end + 4], "big")
        if end > len(data):
            raise ValueError(f"a PNG must be whole, found it cut off after {len(data)} bytes")
        chunks.append(Chunk(data[start + 4 : start + 8], data[start:end]))
    return chunks


def read_header(chunk: Chunk) -> Header:
    """Parse the header, a PNG's first chunk. Raises ValueError for another chunk."""
    if chunk.name != b"IHDR" or len(chunk.whole) != _HEADER_BYTES:
        raise ValueError("a PNG must begin with its size")
    columns, rows, bits, colour = struct.unpack_from(">IIBB", chunk.whole, 8)
    return Header(rows, columns, bits, colour)


def encode_png(image: NDArray[Any]) -> bytes:
    """Encode a uint8 or uint16 image [H, W] as PNG; 16-bit greyscale is lossless in Pillow."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "PNG")
    return buffer.getvalue()


def check_checksums(chunks: Sequence[Chunk]) -> None:
    """Test the CRC-32 of every chunk's name and content. Raises ValueError, naming a chunk whose checksum is wrong."""
    for chunk in chunks:
        stored, found = int.from_bytes(chunk.whole[-4:], "big"), zlib.crc32(memoryview(chunk.whole)[4:-4])
        if stored != found:
            raise ValueError(
                f"a PNG's checksums must be right, found {stored:08x} instead of {found:08x} for {chunk.name!r}"
            )


def decode_png(data: bytes) -> NDArray[Any]:
    """Decode a greyscale PNG to uint8 or uint16 [H, W]. Raises ValueError for other files and sides over `MAX_SIDE`."""
    with reported(_UNREADABLE, ValueError):
        chunks = read_chunks(data)
        read_header(chunks[0])
        if spare := len(data) - len(SIGNATURE) - sum(len(chunk.whole) for chunk in chunks):
            raise ValueError(f"nothing follows its end, found {spare} bytes")
        check_checksums(chunks)
    return decode_chunks(chunks)


def decode_chunks(chunks: Sequence[Chunk]) -> NDArray[Any]:
    """Decode the chunks of a greyscale PNG, whose checksums have been tested; otherwise as `decode_png`."""
    # Checked before pixels are decoded: Pillow allocates memory, and warns, by the sizes in header and other chunks.
    with reported(_UNREADABLE, ValueError):
        header = read_header(chunks[0])
        names = [chunk.name for chunk in chunks]
        if set(names[1:-1]) != {b"IDAT"}:
            raise ValueError(f"it holds IHDR, IDAT and IEND alone, found {b' '.join(names[:9])!r}")
        if not (1 <= header.rows <= MAX_SIDE and 1 <= header.columns <= MAX_SIDE):
            found = f"{header.rows} x {header.columns}"
            raise ValueError(f"an image side is 1 to {MAX_SIDE} pixels, found {found}")
    from PIL import Image

    whole = io.BytesIO(SIGNATURE + b"".join(chunk.whole for chunk in chunks))
    with reported(_UNREADABLE, ValueError, OSError, SyntaxError), Image.open(whole, formats=["PNG"]) as picture:
        if picture.mode not in ("L", "I;16"):
            raise ValueError(f"a PNG must be 8- or 16-bit greyscale, found mode {picture.mode}")
        return np.asarray(picture).copy()


class PngImages:
    """The codec `png`: an image a member, for shards readable by any image tool."""

    members: ClassVar[tuple[str, ...]] = ("range.png", "projector.png", "labels.png", "facing.png")

    def encode(self, camera: Range, labels: Bytes, facing: Bytes, projector: Range | None) -> dict[str, bytes]:
        """See `ImageCodec.encode`; the projector's range is one pixel, 0, where there is none."""
        nothing = np.zeros((1, 1), np.uint16)
        images: list[NDArray[Any]] = [camera, nothing if projector is None else projector, labels, facing]
        return {member: encode_png(image) for member, image in zip(self.members, images, strict=True)}

    def decode(
        self, members: Mapping[str, bytes], projector: bool, out: OutputArrays | None, unlabelled: int
    ) -> DecodedImages:
        """See `ImageCodec.decode`; `out` is not used."""
        images: dict[str, NDArray[Any]] = {}
        for member in self.members:
            if member == "projector.png" and not projector:
                continue
            dtype = np.uint16 if member in ("range.png", "projector.png") else np.uint8
            with reported(member, ValueError):
                images[member] = decode_png(members[member])
            if images[member].dtype != dtype:
                raise ValueError(f"{member}: must be {dtype.__name__}, found {images[member].dtype}")
        labels, facing = self._labels(images)
        labels[labels == UNLABELLED] = unlabelled
        occluder = images.get("projector.png")
        if occluder is not None and occluder.size == 1:
            occluder = None
        return DecodedImages(images["range.png"], labels, facing, occluder, None, None)

    def _labels(self, images: Mapping[str, NDArray[Any]]) -> tuple[Bytes, Bytes]:
        labels, facing = images["labels.png"], images["facing.png"]
        if facing.max() > FACING + SECOND_FACING:
            raise ValueError("facing.png: must hold bits 0 and 1 alone")
        return labels, facing

    def encode_plane(self, plane: Bytes | Range) -> dict[str, bytes]:
        return {"png": encode_png(plane)}

    def decode_plane(self, data: bytes) -> Bytes | Range:
        return decode_png(data)


class EarlierPngImages(PngImages):
    """The codec `png` of formats before 7, whose label bytes hold facing; it reads alone."""

    members: ClassVar[tuple[str, ...]] = ("range.png", "projector.png", "labels.png")

    def _labels(self, images: Mapping[str, NDArray[Any]]) -> tuple[Bytes, Bytes]:
        return split_label_bytes(images["labels.png"])
