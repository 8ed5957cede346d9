"""Bits of bfloat16 in compiled loops."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from bodyseg_data.core.kernels import compiled

BITS: Final = np.uint32(16)
"""Bits of a number: the upper ones of float32."""

_HALF_LESS_ONE, _LAST = np.uint32(0x7FFF), np.uint32(1)


def _nearest(exact: Any) -> Any:
    """Round the bits of a float32, uint32, to those of the nearest bfloat16, ties to even, as the lower ones of 32."""
    return (exact + _HALF_LESS_ONE + ((exact >> BITS) & _LAST)) >> BITS


nearest: Any = compiled(_nearest, "bfloat16 in compiled loops")
