"""PNGs for tests."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

RAMP = np.arange(0, 65536, 13, dtype=np.uint16)[:5040].reshape(60, 84)


def png(image: np.ndarray[Any, Any] = RAMP, **options: Any) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "PNG", **options)
    return buffer.getvalue()


def pixels(path: Path) -> np.ndarray[Any, Any]:
    """What an image file holds. Compare these, not files: one image may be compressed into other bytes each time."""
    with Image.open(path) as picture:
        return np.asarray(picture).copy()


def chunk(kind: bytes, data: bytes) -> bytes:
    """A chunk of a PNG with its checksum."""
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
