"""Plain 16-bit and 8-bit PNG by Pillow, for shards that any image tool opens."""

from __future__ import annotations

import io
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.shards.codecs.bodyseg_images import MAX_SIDE

_MAGIC: Final = b"\x89PNG\r\n\x1a\n"


def encode_png(image: NDArray[Any]) -> bytes:
    """A uint8 or uint16 image [H, W] as a PNG; 16-bit greyscale is lossless in Pillow."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "PNG")
    return buffer.getvalue()


def decode_png(data: bytes) -> NDArray[Any]:
    """The inverse. Raises ValueError, saying what is wrong, for anything but a greyscale PNG of at most `MAX_SIDE`."""
    from PIL import Image

    # Asked before opening: Pillow allocates, and warns, by what a file claims, also in chunks besides the pixels.
    chunks = _chunks(data)
    if chunks[:1] != [b"IHDR"] or chunks[-1:] != [b"IEND"] or set(chunks[1:-1]) != {b"IDAT"}:
        raise ValueError(f"not a readable PNG: it holds IHDR, IDAT and IEND alone, found {b' '.join(chunks[:9])!r}")
    columns, rows = int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")
    if not (1 <= rows <= MAX_SIDE and 1 <= columns <= MAX_SIDE):
        raise ValueError(f"not a readable PNG: an image side is 1 to {MAX_SIDE} pixels, found {rows} x {columns}")
    try:
        with Image.open(io.BytesIO(data), formats=["PNG"]) as picture:
            if picture.mode not in ("L", "I;16"):
                raise ValueError(f"a PNG must be 8- or 16-bit greyscale, found mode {picture.mode}")
            return np.asarray(picture).copy()
    except (OSError, SyntaxError) as error:
        raise ValueError(f"not a readable PNG: {error}") from error


def _chunks(data: bytes) -> list[bytes]:
    """The names of a PNG's chunks, as far as they follow each other."""
    names, place = [], len(_MAGIC)
    while data.startswith(_MAGIC) and place + 12 <= len(data):
        names.append(data[place + 4 : place + 8])
        place += 12 + int.from_bytes(data[place : place + 4], "big")
    return names
