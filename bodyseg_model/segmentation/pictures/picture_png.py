"""Encoding of the images that `bodyseg segment` writes, fast: PNGs whose rows are not filtered.

Labels and overlays hold large areas of few values. Filters, whose choice takes Pillow most of the time, make neither
smaller.
"""

from __future__ import annotations

import struct
import zlib
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.system.deflate import compress
from bodyseg_data.shards.codecs.png import SIGNATURE

_LEVEL: Final = 2
"""Of zlib and of isal. With zlib an overlay takes a third of the time of Pillow's level 3, which filters, and has about
as many bytes; with isal a quarter of zlib's time and 7 % more bytes."""

_COLOUR: Final = {2: 0, 3: 2}  # colour type of an image of so many dimensions: grey, RGB


def encode_picture(image: NDArray[Any]) -> bytes:
    """Encode an image as PNG: uint8 or uint16 grey [H, W], or uint8 sRGB [H, W, 3]."""
    rows, columns = image.shape[:2]
    big_endian = np.ascontiguousarray(image, image.dtype.newbyteorder(">"))
    filtered = np.zeros((rows, 1 + big_endian.nbytes // rows), np.uint8)  # each row begins with its filter: 0, none
    filtered[:, 1:] = big_endian.view(np.uint8).reshape(rows, -1)
    header = struct.pack(">IIBBBBB", columns, rows, 8 * image.dtype.itemsize, _COLOUR[image.ndim], 0, 0, 0)
    chunks = (b"IHDR", header), (b"IDAT", compress(filtered.data, _LEVEL)), (b"IEND", b"")
    return SIGNATURE + b"".join(_chunk(name, data) for name, data in chunks)


def _chunk(name: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(data, zlib.crc32(name)))
