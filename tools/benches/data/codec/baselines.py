"""Other ways to store a sample's images without loss, for `bench codec`.

Each takes the same three images, camera range, label bytes and projector range, and gives one piece of bytes for each.
"""

from __future__ import annotations

import importlib
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import zstandard
from numpy.typing import NDArray

from bodyseg_data.core.errors import MissingLibrary
from bodyseg_data.shards.codecs.png import decode_png, encode_png
from bodyseg_data.shards.codecs.runs import Box, used_box
from bodyseg_data.shards.codecs.slopes import unzigzag, zigzag

Image = NDArray[Any]
Encode = Callable[[Image, int], bytes]
Decode = Callable[[bytes], Image]


@dataclass(frozen=True)
class Baseline:
    """A way to store one image: `encode(image, background)`, where background fills most of it, and its inverse."""

    name: str
    encode: Encode
    decode: Decode


@dataclass(frozen=True)
class Cropped:
    """Bytes of the part of an image that is not background, made by `pack` and undone by `unpack`, under a plain
    header.
    """

    pack: Callable[[Image], bytes]
    unpack: Callable[[bytes, Box, Any], Image]

    def encode(self, image: Image, background: int) -> bytes:
        """See `Baseline`."""
        box = used_box(image != background)
        fields = [image.itemsize, background, *image.shape, box.top, box.left, box.height, box.width]
        return np.array(fields, "<u2").tobytes() + self.pack(np.ascontiguousarray(box.of(image)))

    def decode(self, data: bytes) -> Image:
        """See `Baseline`."""
        size, background, rows, columns, *place = np.frombuffer(data[:16], "<u2").tolist()
        kind, box = (np.uint16 if size == 2 else np.uint8), Box(*place)
        image: Image = np.full((rows, columns), background, kind)
        box.of(image)[:] = self.unpack(data[16:], box, kind)
        return image


def compressed(name: str, level: int) -> tuple[Callable[[bytes], bytes], Callable[[bytes], bytes]]:
    """A general compressor and its inverse: zstd, lz4, lz4hc or deflate."""
    if name == "zstd":
        coder, decoder = zstandard.ZstdCompressor(level=level), zstandard.ZstdDecompressor()
        return coder.compress, decoder.decompress
    if name in ("lz4", "lz4hc"):
        library = importlib.import_module("imagecodecs")
        high = name == "lz4hc"
        return (
            lambda data: bytes(library.lz4_encode(data, level=level, hc=high, header=True)),
            lambda data: bytes(library.lz4_decode(data, header=True)),
        )
    return lambda data: zlib.compress(data, level), zlib.decompress


Predictor = tuple[Callable[[Image], Image], Callable[[Image], Image]]


def _across(crop: Image) -> Image:
    change = crop.copy()
    change[:, 1:] -= crop[:, :-1]
    return change


def _two_way(crop: Image) -> Image:
    across = _across(crop)
    change = across.copy()
    change[1:] -= across[:-1]
    return change


def _sum_across(change: Image) -> Image:
    np.cumsum(change, axis=1, dtype=change.dtype, out=change)
    return change


def _sum_both(change: Image) -> Image:
    np.cumsum(change, axis=0, dtype=change.dtype, out=change)
    return _sum_across(change)


PREDICTORS: Final[dict[str, Predictor]] = {
    "none": (lambda crop: crop, lambda crop: crop),
    "row difference": (_across, _sum_across),
    "two-way": (_two_way, _sum_both),
    "two-way, zigzag": (lambda crop: zigzag(_two_way(crop)), lambda coded: _sum_both(unzigzag(coded))),
}


def _shuffled(numbers: Image) -> bytes:
    return numbers.view(np.uint8).reshape(-1, numbers.itemsize).T.tobytes()


def _unshuffled(data: bytes, box: Box, kind: Any) -> Image:
    planes = np.frombuffer(data, np.uint8).reshape(np.dtype(kind).itemsize, box.height, box.width)
    numbers: Image = planes[0] | (planes[1].astype(np.uint16) << 8) if len(planes) == 2 else planes[0]
    return numbers


def _bits(numbers: Image) -> bytes:
    bits = np.unpackbits(numbers.view(np.uint8).reshape(-1, numbers.itemsize), axis=1)
    return np.packbits(bits.T).tobytes()


def _unbits(data: bytes, box: Box, kind: Any) -> Image:
    size, count = np.dtype(kind).itemsize, box.height * box.width
    bits = np.unpackbits(np.frombuffer(data, np.uint8), count=8 * size * count).reshape(8 * size, count)
    numbers: Image = np.packbits(bits.T).view(kind).reshape(box.height, box.width)
    return numbers


def predicted(predictor: str, layout: str, library: str, level: int) -> Cropped:
    """Crop, predict (16-bit images only), put bytes or bits of a kind together, compress."""
    forth, back = PREDICTORS[predictor]
    squeeze, expand = compressed(library, level)
    lay, unlay = {"bytes": (_shuffled, _unshuffled), "bits": (_bits, _unbits)}[layout]

    def pack(crop: Image) -> bytes:
        return squeeze(lay(forth(crop) if crop.itemsize == 2 else crop))

    def unpack(data: bytes, box: Box, kind: Any) -> Image:
        crop = unlay(expand(data), box, kind)
        return back(crop) if crop.itemsize == 2 else crop

    return Cropped(pack, unpack)


def rivals() -> list[Baseline]:
    """Every other way that is measured. Raises MissingLibrary without imagecodecs."""
    try:
        library: Any = importlib.import_module("imagecodecs")
    except ImportError as error:
        raise MissingLibrary(f"bench codec needs 'imagecodecs': pip install 'bodyseg[bench]' ({error})") from error

    def whole(encode: Callable[[Image], bytes], decode: Callable[[bytes], Image]) -> Cropped:
        return Cropped(lambda crop: bytes(encode(crop)), lambda data, box, kind: decode(data))

    def blosc(compressor: str, shuffle: str, level: int) -> Cropped:
        def pack(crop: Image) -> bytes:
            coded = library.blosc2_encode(
                crop, level=level, compressor=compressor, shuffle=shuffle, typesize=crop.itemsize, numthreads=1
            )
            return bytes(coded)

        def unpack(data: bytes, box: Box, kind: Any) -> Image:
            image: Image = np.frombuffer(library.blosc2_decode(data), kind).reshape(box.height, box.width)
            return image

        return Cropped(pack, unpack)

    found: list[tuple[str, Cropped]] = [
        ("JPEG-LS", whole(library.jpegls_encode, library.jpegls_decode)),
        ("LERC", whole(lambda crop: library.lerc_encode(crop, level=0), library.lerc_decode)),
        *(
            (f"JPEG XL, effort {effort}", whole(lambda crop, e=effort: _jpeg_xl(crop, e), library.jpegxl_decode))  # type: ignore[misc]
            for effort in (1, 5)
        ),
        ("Blosc2: bytes, lz4", blosc("lz4", "shuffle", 5)),
        ("Blosc2: bytes, zstd 5", blosc("zstd", "shuffle", 5)),
        ("Blosc2: bits, zstd 5", blosc("zstd", "bitshuffle", 5)),
        *((f"{name} {level}", predicted("none", "bytes", name, level)) for name, level in (("zstd", 1), ("zstd", 9))),
        ("row, bytes, zstd 1", predicted("row difference", "bytes", "zstd", 1)),
        *(
            (f"two-way, {layout}, {name} {level}", predicted("two-way", layout, name, level))
            for layout, name, level in (
                ("bytes", "lz4", 1),
                ("bytes", "lz4hc", 9),
                ("bytes", "zstd", 1),
                ("bytes", "zstd", 9),
                ("bytes", "zstd", 19),
                ("bytes", "deflate", 6),
                ("bits", "zstd", 1),
            )
        ),
        ("two-way zigzag, bytes, zstd 1", predicted("two-way, zigzag", "bytes", "zstd", 1)),
        ("two-way zigzag, bytes, zstd 19", predicted("two-way, zigzag", "bytes", "zstd", 19)),
    ]
    plain = Baseline("PNG", lambda image, background: encode_png(image), decode_png)
    return [plain, *(Baseline(name, way.encode, way.decode) for name, way in found)]


def _jpeg_xl(crop: Image, effort: int) -> bytes:
    library: Any = importlib.import_module("imagecodecs")
    return bytes(library.jpegxl_encode(crop, lossless=True, effort=effort, numthreads=1))
