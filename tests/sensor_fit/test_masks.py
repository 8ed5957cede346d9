"""Shapes of masks, against SciPy's binary morphology."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from bodyseg_model.sensor_fit.recording import closing, connected, dilated, eroded, holes, opening


@pytest.mark.parametrize("share", [0.1, 0.5, 0.8])
@pytest.mark.parametrize("radius", [1, 2])
def test_squares_grow_and_shrink_masks(share: float, radius: int) -> None:
    mask = np.random.default_rng(0).random((40, 31)) < share
    square = np.ones((2 * radius + 1,) * 2, np.bool_)
    np.testing.assert_array_equal(dilated(mask, radius), ndimage.binary_dilation(mask, square))
    np.testing.assert_array_equal(eroded(mask, radius), ndimage.binary_erosion(mask, square))
    np.testing.assert_array_equal(opening(mask, radius), ndimage.binary_opening(mask, square))
    wide = np.pad(mask, 8)
    np.testing.assert_array_equal(closing(mask, radius), ndimage.binary_closing(wide, square)[8:-8, 8:-8])
    assert (closing(mask, radius) >= mask).all()


@pytest.mark.parametrize("seed", range(4))
def test_holes_are_what_the_border_does_not_reach(seed: int) -> None:
    mask = np.random.default_rng(seed).random((50, 60)) < 0.5
    none = np.zeros_like(mask)
    np.testing.assert_array_equal(holes(mask, none), ndimage.binary_fill_holes(mask) & ~mask)
    groups, count = ndimage.label(mask)
    first = int(np.flatnonzero(mask)[0])
    assert count > 1
    np.testing.assert_array_equal(connected(mask, first), groups == groups.ravel()[first])


def test_a_hole_that_shows_what_is_behind_is_none() -> None:
    mask = np.ones((9, 9), np.bool_)
    mask[2:7, 2:7] = False
    behind = np.zeros_like(mask)
    assert holes(mask, behind).sum() == 25
    behind[4, 4] = True
    assert not holes(mask, behind).any()
