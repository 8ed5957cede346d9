"""The compiled loops of the shapes of surfaces, beside their NumPy forms: the same bits."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from kernel_forms import by_both

from bodyseg_data.core.rig import Camera
from bodyseg_model.segmentation.people.shape_network import shape_image, shipped_shape_network
from bodyseg_model.segmentation.people.surface_shape import SurfaceShape, surface_shape


def both(shape: tuple[int, int], shown: float, middle_m: float, seed: int) -> tuple[SurfaceShape, SurfaceShape]:
    """Shape of a noisy, holey surface by the compiled loops and by NumPy."""
    draws = np.random.default_rng(seed)
    frame = draws.normal(middle_m, 0.01, shape).astype(np.float32)
    pixels = np.flatnonzero(draws.random(shape) < shown)
    if not len(pixels):
        pixels = np.array([frame.size // 2])
    camera = Camera(*shape, 131.0, (shape[1] / 2, shape[0] / 3), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    return by_both(lambda: surface_shape(pixels, frame, camera))


@settings(max_examples=60)
@given(
    st.tuples(st.integers(1, 80), st.integers(1, 80)),
    st.sampled_from([0.02, 0.6, 0.95, 1.0]),
    st.sampled_from([0.2, 0.6, 1.5, 4.0]),
    st.integers(0, 2**32 - 1),
)
def test_compiled_shapes_are_those_of_numpy(shape: tuple[int, int], shown: float, middle_m: float, seed: int) -> None:
    one, other = both(shape, shown, middle_m, seed)
    np.testing.assert_array_equal(one.measures, other.measures)
    np.testing.assert_array_equal(one.cells, other.cells)
    assert one.cells.dtype == other.cells.dtype and np.isfinite(one.measures).all()


@settings(max_examples=40)
@given(
    st.tuples(st.integers(1, 60), st.integers(1, 60)),
    st.sampled_from([0.0, 0.5, 0.9, 1.0]),
    st.integers(0, 2**32 - 1),
)
def test_the_compiled_network_of_shapes_gives_the_odds_of_numpy(
    shape: tuple[int, int], filled: float, seed: int
) -> None:
    draws = np.random.default_rng(seed)
    cells = np.where(draws.random(shape) < filled, draws.normal(2.5, draws.uniform(0, 0.6), shape), np.nan)
    measures, network = draws.normal(size=16), shipped_shape_network()
    np.testing.assert_array_equal(*by_both(lambda: shape_image(cells)))
    one, other = by_both(lambda: network.logit(shape_image(cells), measures))
    assert one == other and np.isfinite(one)
