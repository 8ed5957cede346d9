"""An encoder of RVL, pixel by pixel, for what the package decodes."""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import NDArray


def encode_rvl(image: NDArray[np.uint16]) -> bytes:
    """As ROS writes it: columns and rows, then runs, pixel by pixel."""
    pieces: list[int] = []

    def put(value: int) -> None:
        more = True
        while more:
            low, value = value & 7, value >> 3
            more = value > 0
            pieces.append(low | 8 * more)

    flat: list[int] = image.ravel().tolist()
    at = before = 0
    while at < len(flat):
        end = next((i for i in range(at, len(flat)) if flat[i]), len(flat))
        put(end - at)
        at, end = end, next((i for i in range(end, len(flat)) if not flat[i]), len(flat))
        put(end - at)
        for value in flat[at:end]:
            put(2 * (value - before) if value >= before else 2 * (before - value) - 1)
            before = value
        at = end
    pieces += [0] * (-len(pieces) % 8)
    words = [int("".join(f"{piece:x}" for piece in pieces[i : i + 8]), 16) for i in range(0, len(pieces), 8)]
    return struct.pack("<ii", image.shape[1], image.shape[0]) + np.array(words, "<u4").tobytes()
