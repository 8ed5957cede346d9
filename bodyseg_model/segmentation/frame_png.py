"""A frame's bytes -> its pixels: 16-bit grey PNG, and one clear line for anything else."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.shards.codecs.png import decode_png

_SIGNATURE: Final = b"\x89PNG\r\n\x1a\n"
_KINDS: Final = {0: "grey", 2: "RGB", 3: "palette", 4: "grey with alpha", 6: "RGB with alpha"}
_LARGEST_SIDE: Final = 4096
_NEEDED: Final = (b"IHDR", b"IDAT", b"IEND")


def parse_frame(data: bytes, where: str) -> NDArray[np.uint16]:
    """The pixels of a 16-bit grey PNG, uint16 [H, W]. Raises BadConfig; `where` names the frame in its message.

    Chunks that hold no pixels are not looked at: what they claim could cost memory, and ranges need none of it.
    """
    if not data.startswith(_SIGNATURE):
        raise BadConfig(f"a frame must be a 16-bit grey PNG, found {'no PNG' if data else 'nothing at all'}: {where}")
    chunks = [(kind, chunk) for kind, chunk in _chunks(data, where) if kind in _NEEDED]
    if chunks[0][0] != b"IHDR" or len(chunks[0][1]) != 25:
        raise BadConfig(f"a PNG must begin with its size: {where}")
    columns, rows, bits, kind = struct.unpack_from(">IIBB", chunks[0][1], 8)
    if (bits, kind) != (16, 0):
        raise BadConfig(f"a frame must be a 16-bit grey PNG, found {bits}-bit {_KINDS.get(kind, kind)}: {where}")
    if not (1 <= rows <= _LARGEST_SIDE and 1 <= columns <= _LARGEST_SIDE):
        raise BadConfig(f"a frame's side must be 1 to {_LARGEST_SIDE} pixels, found {rows} x {columns}: {where}")
    try:
        image: NDArray[np.uint16] = decode_png(_SIGNATURE + b"".join(chunk for _, chunk in chunks))
    except ValueError as error:
        raise BadConfig(f"{where} is {error}") from error
    return image


def _chunks(data: bytes, where: str) -> Iterator[tuple[bytes, bytes]]:
    """Name and whole bytes of each chunk up to the end (W3C, "Portable Network Graphics", 5.3), checksums compared."""
    place, kind = len(_SIGNATURE), b""
    while kind != b"IEND":
        end = place + 12 + int.from_bytes(data[place : place + 4], "big")
        if place + 12 > len(data) or end > len(data):
            raise BadConfig(f"a PNG must be whole, found it cut off after {len(data)} bytes: {where}")
        kind = data[place + 4 : place + 8]
        stored, computed = int.from_bytes(data[end - 4 : end], "big"), zlib.crc32(data[place + 4 : end - 4])
        if stored != computed:
            raise BadConfig(
                f"a PNG's checksums must be right, found {stored:08x} instead of {computed:08x} for {kind!r}: {where}"
            )
        yield kind, data[place:end]
        place = end
