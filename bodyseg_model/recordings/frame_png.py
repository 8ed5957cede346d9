"""Decoding of a frame: a 16-bit grey PNG, and one clear line for anything else."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.shards.codecs.png import SIGNATURE, check_checksums, decode_chunks, read_chunks, read_header
from bodyseg_model.recordings.recording import LARGEST_SIDE

_KINDS: Final = {0: "grey", 2: "RGB", 3: "palette", 4: "grey with alpha", 6: "RGB with alpha"}
_NEEDED: Final = (b"IHDR", b"IDAT", b"IEND")


def parse_frame(data: bytes, where: str) -> NDArray[np.uint16]:
    """Decode the pixels of a 16-bit grey PNG, uint16 [H, W]. Raises BadConfig; `where` names the frame in its message.

    Chunks without pixels are checked but not decoded: ranges need none of them, and the sizes they claim could exhaust
    memory.
    """
    if not data.startswith(SIGNATURE):
        raise BadConfig(f"a frame must be a 16-bit grey PNG, found {'no PNG' if data else 'nothing at all'}: {where}")
    try:
        chunks = read_chunks(data)
        check_checksums(chunks)
        needed = [chunk for chunk in chunks if chunk.name in _NEEDED]
        header = read_header(needed[0])
    except ValueError as error:
        raise BadConfig(f"{error}: {where}") from error
    if (header.bits, header.colour) != (16, 0):
        kind = f"{header.bits}-bit {_KINDS.get(header.colour, header.colour)}"
        raise BadConfig(f"a frame must be a 16-bit grey PNG, found {kind}: {where}")
    if not (1 <= header.rows <= LARGEST_SIDE and 1 <= header.columns <= LARGEST_SIDE):
        raise BadConfig(
            f"a frame's side must be 1 to {LARGEST_SIDE} pixels, found {header.rows} x {header.columns}: {where}"
        )
    try:
        image: NDArray[np.uint16] = decode_chunks(needed)
    except ValueError as error:
        raise BadConfig(f"{where} is {error}") from error
    return image
