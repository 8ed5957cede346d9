"""Surfaces in range images: compiled and NumPy forms agree at every border, and edges and widths are what they say."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from kernel_forms import by_both
from numpy.typing import NDArray

from bodyseg_data.artifacts import silhouettes, widened
from bodyseg_data.artifacts.surface import incidence
from bodyseg_data.rigs import Camera

SHAPES = [(1, 1), (1, 9), (9, 1), (2, 2), (7, 40), (33, 5)]


def image_of(shape: tuple[int, int], share: float) -> NDArray[np.uint16]:
    """Ranges near 2 m that differ from pixel to pixel, in steps of 1 mm; a share of the pixels is background."""
    random = np.random.default_rng(shape[0] * 100 + shape[1])
    return (random.integers(1900, 2100, shape) * (random.random(shape) >= share)).astype(np.uint16)


def in_both_forms(function: Callable[..., Any], *arguments: Any) -> Any:
    """What the NumPy form gives, after comparing with the compiled one."""
    compiled, plain = by_both(lambda: function(*arguments))
    np.testing.assert_array_equal(compiled, plain)
    return plain


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("share", [0.0, 0.4])
def test_both_forms_give_the_same_bits(shape: tuple[int, int], share: float) -> None:
    image = image_of(shape, share)
    camera = Camera(*shape, 300.0, (shape[1] / 2, shape[0] / 2), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    in_both_forms(incidence, image, camera, np.flatnonzero(image))
    for jump in (0.5, 60.0, 1e6):
        marked = in_both_forms(silhouettes, image, jump)
        for pixels in (0, 1, 3, 50):
            in_both_forms(widened, marked, pixels)


def test_a_jump_is_more_than_the_limit() -> None:
    image = np.array([[100, 100, 130, 131, 0, 50]], np.uint16)
    for jump, marked in ((30.0, [0, 0, 0, 1, 0, 1]), (29.9, [0, 1, 1, 1, 0, 1])):
        found = in_both_forms(silhouettes, image, jump)
        np.testing.assert_array_equal(found[0], np.array(marked, np.bool_))


def test_a_mark_grows_to_a_square() -> None:
    marked = np.zeros((9, 9), np.bool_)
    marked[4, 4] = marked[0, 8] = True
    found = in_both_forms(widened, marked, 2)
    expected = np.zeros((9, 9), np.bool_)
    expected[2:7, 2:7] = expected[:3, 6:] = True
    np.testing.assert_array_equal(found, expected)
