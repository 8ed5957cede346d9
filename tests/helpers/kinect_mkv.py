"""A Matroska file as Azure Kinect's recorder writes it: raw big-endian 16-bit tracks, and the calibration attached."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np


def element(name: str, *parts: bytes | int | str) -> bytes:
    """An EBML element of its id in hexadecimal and content; sizes take eight bytes."""
    data = b"".join(
        part if isinstance(part, bytes) else part.encode() if isinstance(part, str) else part.to_bytes(8, "big")
        for part in parts
    )
    return bytes.fromhex(name) + struct.pack(">Q", len(data) | 1 << 56) + data


def calibration(parameters: Sequence[float], location: str = "CALIBRATION_CameraLocationD0") -> bytes:
    camera = {"Intrinsics": {"ModelParameters": list(parameters)}, "Location": location}
    return json.dumps({"CalibrationInformation": {"Cameras": [camera]}}).encode() + b"\0"


def write_mkv(
    path: Path, tracks: Mapping[str, np.ndarray[Any, Any]], attached: bytes | None = None, codec: bytes = b"b16g"
) -> Path:
    """Tracks [N, H, W] of uint16 by their titles, 30 frames a second."""
    entries, blocks = [], []
    for number, (title, stack) in enumerate(tracks.items(), 1):
        count, rows, columns = stack.shape
        bitmap = struct.pack("<IiiHH4sIiiII", 40, columns, rows, 1, 16, codec, rows * columns * 2, 0, 0, 0, 0)
        video = element("e0", element("b0", columns), element("ba", rows))
        numbers = element("d7", number) + element("73c5", number) + element("83", 1)
        entries.append(
            element(
                "ae", numbers, element("536e", title), element("86", "V_MS/VFW/FOURCC"), element("63a2", bitmap), video
            )
        )
        for index in range(count):
            start = struct.pack(">BhB", 0x80 | number, round(index * 1000 / 30), 0x80)
            blocks.append((index, start + stack[index].astype(">u2").tobytes()))
    cluster = element("1f43b675", element("e7", 0), *(element("a3", block) for _, block in sorted(blocks)))
    file = b""
    if attached is not None:
        names = element("466e", "calibration.json") + element("4660", "application/octet-stream") + element("46ae", 9)
        file = element("1941a469", element("61a7", names, element("465c", attached)))
    info = element("1549a966", element("2ad7b1", 1_000_000))
    header = element("1a45dfa3", element("4282", "matroska"), element("4287", 2), element("4285", 2))
    path.write_bytes(header + element("18538067", info, element("1654ae6b", *entries), file, cluster))
    return path
