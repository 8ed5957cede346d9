"""Conversion of stored steps to metres, compiled: one pass, where NumPy converts first and then multiplies."""

from __future__ import annotations

from typing import Any

import numpy as np

from bodyseg_data.core.kernels import compiled


def _scale(steps: Any, step_m: Any, out: Any) -> None:
    """Write float32(steps) * step_m, rounded once; steps: uint16 [N], step_m: float32, out: float32 [N]."""
    for i in range(np.uint64(out.size)):
        out[i] = np.float32(steps[i]) * step_m


scale: Any = compiled(_scale, "converting ranges in a compiled loop")
