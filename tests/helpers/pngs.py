"""PNGs for tests."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from PIL import Image

RAMP = np.arange(0, 65536, 13, dtype=np.uint16)[:5040].reshape(60, 84)


def png(image: np.ndarray[Any, Any] = RAMP, **options: Any) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "PNG", **options)
    return buffer.getvalue()
