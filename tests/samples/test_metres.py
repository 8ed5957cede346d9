"""Conversion of steps to metres, in place or into a new array, rounded once."""

from __future__ import annotations

import numpy as np
import pytest

from bodyseg_data.samples import metres

STEPS = np.arange(65536, dtype=np.uint16).reshape(64, 1024)


@pytest.mark.parametrize("step_m", [1e-4, 1e-3, 0.0007])
def test_steps_become_metres_rounded_once(step_m: float) -> None:
    expected = STEPS.astype(np.float32) * np.float32(step_m)
    out = np.full((64, 2048), np.nan, np.float32)
    metres(STEPS, step_m, out[:, ::2])
    np.testing.assert_array_equal(out[:, ::2], expected)
    np.testing.assert_array_equal(metres(STEPS, step_m), expected)
