"""Conversion of steps to metres: the compiled loop has the bits of NumPy's product, whatever arrays it gets."""

from __future__ import annotations

import numpy as np
import pytest
from kernel_forms import FORMS, computed_by

from bodyseg_data.samples import metres

STEPS = np.arange(65536, dtype=np.uint16).reshape(64, 1024)


@pytest.mark.parametrize("step_m", [1e-4, 1e-3, 0.0007])
def test_both_forms_give_the_same_bits(step_m: float) -> None:
    expected = STEPS.astype(np.float32) * np.float32(step_m)
    for form in FORMS:
        out = np.full(STEPS.shape, np.nan, np.float32)
        with computed_by(form):
            assert metres(STEPS, step_m, out) is out
        np.testing.assert_array_equal(out.view(np.uint32), expected.view(np.uint32))
    np.testing.assert_array_equal(metres(STEPS, step_m), expected)


def test_arrays_that_are_parts_of_others_are_converted_in_place() -> None:
    out = np.zeros((64, 2048), np.float32)
    metres(STEPS[:, ::2], 1e-3, out[:, ::4])
    np.testing.assert_array_equal(out[:, ::4], STEPS[:, ::2].astype(np.float32) * np.float32(1e-3))
    assert not out[:, 1::4].any()


def test_steps_that_cannot_be_written_to_are_converted() -> None:
    fixed = STEPS.copy()
    fixed.flags.writeable = False
    out = np.empty(STEPS.shape, np.float32)
    np.testing.assert_array_equal(metres(fixed, 1e-3, out), fixed.astype(np.float32) * np.float32(1e-3))
