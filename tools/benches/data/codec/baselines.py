"""Other ways to store a sample's images without loss, for `bench codec`.

Each takes the same three images, camera range, label bytes and projector range, and gives one piece of bytes for each.
A label byte holds facing, too, so that others need no fourth image.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import numpy as np
import zstandard
from numpy.typing import NDArray

from bodyseg_data.labels import BACKGROUND, UNLABELLED
from bodyseg_data.machine import required
from bodyseg_data.shards.codecs.png import decode_png, encode_png
from bodyseg_data.shards.codecs.residuals import Box, bounding_box, unzigzag, zigzag

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
        box = bounding_box(image != background)
        fields = [image.itemsize, background, *image.shape, box.top, box.left, box.height, box.width]
        return np.array(fields, "<u2").tobytes() + self.pack(np.ascontiguousarray(box.crop(image)))

    def decode(self, data: bytes) -> Image:
        """See `Baseline`."""
        size, background, rows, columns, *edges = np.frombuffer(data[:16], "<u2").tolist()
        kind, box = (np.uint16 if size == 2 else np.uint8), Box(*edges)
        image: Image = np.full((rows, columns), background, kind)
        box.crop(image)[:] = self.unpack(data[16:], box, kind)
        return image


def _two_way(crop: Image) -> Image:
    change = crop.copy()
    change[:, 1:] -= crop[:, :-1]
    change[1:] -= change[:-1].copy()
    return change


def _summed(change: Image) -> Image:
    np.cumsum(change, axis=0, dtype=change.dtype, out=change)
    np.cumsum(change, axis=1, dtype=change.dtype, out=change)
    return change


PREDICTORS: Final[dict[str, tuple[Callable[[Image], Image], Callable[[Image], Image]]]] = {
    "none": (lambda crop: crop, lambda crop: crop),
    "two-way": (_two_way, _summed),
    "two-way, zigzag": (lambda crop: zigzag(_two_way(crop)), lambda coded: _summed(unzigzag(coded))),
}


def predicted(predictor: str, level: int) -> Cropped:
    """Crop, predict (16-bit images only), put first and second bytes together, compress by zstd."""
    forth, back = PREDICTORS[predictor]
    coder, decoder = zstandard.ZstdCompressor(level=level), zstandard.ZstdDecompressor()

    def pack(crop: Image) -> bytes:
        numbers = forth(crop) if crop.itemsize == 2 else crop
        return coder.compress(numbers.view(np.uint8).reshape(-1, numbers.itemsize).T.tobytes())

    def unpack(data: bytes, box: Box, kind: Any) -> Image:
        planes = np.frombuffer(decoder.decompress(data), np.uint8).reshape(-1, box.height, box.width)
        return back(planes[0] | (planes[1].astype(np.uint16) << 8)) if len(planes) == 2 else planes[0]

    return Cropped(pack, unpack)


def label_bytes(labels: Image, facing: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Labels and facing in one image, uint8 [H, W]: 255 for background, else the part, 62 for none, and 64 for facing.

    labels: of the 33 parts, 254 or 255. So formats before 7 stored both, which `split_label_bytes` reads.
    """
    joined = np.where(labels == UNLABELLED, np.uint8(62), labels) | (facing.view(np.uint8) << np.uint8(6))
    return np.where(labels == BACKGROUND, np.uint8(BACKGROUND), joined)


def baselines() -> list[Baseline]:
    """All other ways that are measured: the front's, and those that are widely used. Raises MissingLibrary without
    imagecodecs.
    """
    library = required("imagecodecs", "bench codec", "bench")

    def whole(encode: Callable[[Image], bytes], decode: Callable[[bytes], Image]) -> Cropped:
        return Cropped(lambda crop: bytes(encode(crop)), lambda data, box, kind: decode(data))

    def jpeg_xl(effort: int) -> Cropped:
        coder = partial(library.jpegxl_encode, lossless=True, effort=effort, numthreads=1)
        return whole(coder, library.jpegxl_decode)

    def blosc(compressor: str) -> Cropped:
        coder = partial(library.blosc2_encode, level=5, compressor=compressor, shuffle="shuffle", numthreads=1)

        def unpack(data: bytes, box: Box, kind: Any) -> Image:
            image: Image = np.frombuffer(library.blosc2_decode(data), kind).reshape(box.height, box.width)
            return image

        return Cropped(lambda crop: bytes(coder(crop, typesize=crop.itemsize)), unpack)

    found = {
        "JPEG-LS": whole(library.jpegls_encode, library.jpegls_decode),
        "LERC": whole(partial(library.lerc_encode, level=0), library.lerc_decode),
        "JPEG XL, effort 1": jpeg_xl(1),
        "JPEG XL, effort 5": jpeg_xl(5),
        "Blosc2: bytes, lz4": blosc("lz4"),
        "Blosc2: bytes, zstd 5": blosc("zstd"),
        "zstd 9": predicted("none", 9),
        "two-way, bytes, zstd 1": predicted("two-way", 1),
        "two-way zigzag, bytes, zstd 1": predicted("two-way, zigzag", 1),
    }
    plain = Baseline("PNG", lambda image, background: encode_png(image), decode_png)
    return [plain, *(Baseline(name, way.encode, way.decode) for name, way in found.items())]
