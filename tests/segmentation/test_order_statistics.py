"""Order statistics by the compiled loop and by NumPy: the same values."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from kernel_forms import by_both
from numpy.typing import NDArray

from bodyseg_model.segmentation.order_statistics import median, value_at

SHARES = (0.0, 0.03, 0.5, 0.75, 0.97, 1.0)


def values_of(kind: str, count: int, seed: int) -> NDArray[np.float64]:
    """Values as surfaces have them, and others that lie as unevenly as may be."""
    draws = np.random.default_rng(seed)
    return {
        "ranges": lambda: draws.uniform(2, 2.5, count).astype(np.float32).astype(np.float64),
        "few values": lambda: draws.integers(0, 3, count).astype(np.float64),
        "one value": lambda: np.full(count, 2.5),
        "one far off": lambda: np.append(draws.normal(0, 1e-9, count - 1), 1e9),
        "many sizes": lambda: 10.0 ** draws.uniform(-300, 300, count),
        "nearly equal": lambda: 1 + draws.integers(0, 9, count) * np.finfo(np.float64).eps,
        "as far apart as numbers are": lambda: 1.7e308 * draws.uniform(-1, 1, count),
        "subnormal": lambda: draws.integers(0, 9, count) * np.finfo(np.float64).smallest_subnormal,
    }[kind]()


@settings(max_examples=120)
@given(
    st.sampled_from(
        [
            "ranges",
            "few values",
            "one value",
            "one far off",
            "many sizes",
            "nearly equal",
            "as far apart as numbers are",
            "subnormal",
        ],
    ),
    st.integers(1, 900),
    st.integers(0, 2**32 - 1),
    st.booleans(),
)
def test_the_values_are_those_of_sorting(kind: str, count: int, seed: int, single: bool) -> None:
    values = values_of(kind, count, seed)
    if single:
        values = np.clip(values, -1e38, 1e38).astype(np.float32)
    kept, ascending = values.copy(), np.sort(values)
    for form in by_both(lambda: [value_at(values, share) for share in SHARES]):
        assert form == [ascending[min(int(share * count), count - 1)] for share in SHARES]
    expected = float(np.median(ascending.astype(np.float64)))
    assert by_both(lambda: median(values)) == (expected, expected)
    np.testing.assert_array_equal(values, kept)


def test_nothing_has_no_value() -> None:
    assert by_both(lambda: value_at(np.empty(0), 0.5)) == (0.0, 0.0)


@pytest.mark.parametrize("odd", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("place", [0, 450, 899])
def test_values_that_are_not_finite_are_sorted_and_count_in_no_bin(odd: float, place: int) -> None:
    """A bin's number computed from them lies far outside of the bins, where a loop would write."""
    values = np.random.default_rng(0).uniform(1, 2, 900)
    values[place] = odd
    expected = np.sort(values)[450]
    assert by_both(lambda: value_at(values, 0.5)) == (expected, expected)
