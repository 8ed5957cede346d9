"""Shapes of masks, against SciPy's binary morphology."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from bodyseg_model.sensor_fit.losses import filled
from bodyseg_model.sensor_fit.recording import closing, dilated, eroded


@pytest.mark.parametrize("share", [0.1, 0.5, 0.8])
@pytest.mark.parametrize("radius", [1, 2])
def test_squares_grow_and_shrink_masks(share: float, radius: int) -> None:
    mask = np.random.default_rng(0).random((40, 31)) < share
    square = np.ones((2 * radius + 1,) * 2, np.bool_)
    np.testing.assert_array_equal(dilated(mask, radius), ndimage.binary_dilation(mask, square))
    np.testing.assert_array_equal(eroded(mask, radius), ndimage.binary_erosion(mask, square))
    wide = np.pad(mask, 8)
    np.testing.assert_array_equal(closing(mask, radius), ndimage.binary_closing(wide, square)[8:-8, 8:-8])
    assert (closing(mask, radius) >= mask).all()


@pytest.mark.parametrize("seed", range(4))
def test_holes_are_what_the_border_does_not_reach(seed: int) -> None:
    mask = np.random.default_rng(seed).random((50, 60)) < 0.5
    closed = closing(mask, 2)
    np.testing.assert_array_equal(filled(mask, np.zeros_like(mask)), ndimage.binary_fill_holes(closed))


def test_a_hole_that_shows_what_is_behind_is_none() -> None:
    mask = np.ones((13, 13), np.bool_)
    mask[2:11, 2:11] = False
    behind = np.zeros_like(mask)
    assert filled(mask, behind).all()
    behind[6, 6] = True
    np.testing.assert_array_equal(filled(mask, behind), mask)
