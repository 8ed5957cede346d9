"""Shares of sets: exact sums, exact means, and the same numbers in whatever order epochs are asked for."""

from __future__ import annotations

import math
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from bodyseg_data.core import BadConfig
from bodyseg_data.loading.mixture import Shares, read_schedule


def counts(shares: Shares, epoch: int) -> list[int]:
    return [end - start for start, end in zip(shares.before(epoch), shares.before(epoch + 1), strict=True)]


def constant(*weights: float) -> list[Any]:
    return [read_schedule(weight) for weight in weights]


def test_whole_shares_are_the_same_in_every_epoch() -> None:
    shares = Shares(constant(3, 1), 400)
    assert [counts(shares, epoch) for epoch in (0, 1, 999, 10**12)] == [[300, 100]] * 4


def test_a_third_is_made_up_for_in_the_next_epochs() -> None:
    shares = Shares(constant(1, 2), 10)
    assert [counts(shares, epoch) for epoch in range(6)] == [[3, 7], [4, 6], [3, 7]] * 2


@given(
    weights=st.lists(st.floats(0, 100), min_size=1, max_size=6).filter(lambda weights: sum(weights) > 1e-6),
    samples=st.integers(1, 1000),
    epoch=st.one_of(st.integers(0, 50), st.integers(0, 10**6)),
)
@example(weights=[1.0, 0.0, 0.0], samples=7, epoch=3)  # nothing is left to divide
def test_shares_of_constant_weights_are_exact_over_all_epochs(weights: list[float], samples: int, epoch: int) -> None:
    shares = Shares(constant(*weights), samples)
    before = shares.before(epoch)
    assert sum(before) == samples * epoch
    total = sum(map(Fraction, weights))
    for found, weight in zip(before, weights, strict=True):
        exact = Fraction(weight) / total * samples * epoch
        assert abs(found - exact) <= Fraction(len(weights) - 1, 2) + Fraction(1, 1000)
    this = counts(shares, epoch)
    assert sum(this) == samples
    assert min(this) >= 0
    assert all(not found for found, weight in zip(this, weights, strict=True) if not weight)


KNOTS = st.dictionaries(st.integers(0, 20), st.floats(0, 10), min_size=1, max_size=4)


@given(
    knots=st.lists(KNOTS, min_size=1, max_size=4),
    samples=st.integers(1, 50),
    epochs=st.permutations(range(0, 40, 3)),
)
def test_schedules_give_whole_samples_whatever_epoch_is_asked_for_first(
    knots: list[dict[int, float]], samples: int, epochs: list[int]
) -> None:
    schedules = [read_schedule([*sorted(each.items()), (30, 1.0)]) for each in knots]
    schedules.append(read_schedule(0.5))
    shares = Shares(schedules, samples)
    expected = np.zeros(len(schedules), np.int64)
    slow: list[list[int]] = []
    for epoch in range(41):
        slow.append(expected.tolist())
        expected += np.asarray(counts(Shares(schedules, samples), epoch))
    for epoch in epochs:
        assert shares.before(epoch) == slow[epoch]
        this = counts(shares, epoch)
        assert sum(this) == samples
        assert min(this) >= 0
        weights = [each.at(epoch) for each in schedules]
        assert all(not found for found, weight in zip(this, weights, strict=True) if not weight)
        share = weights[0] / math.fsum(weights)
        assert abs(this[0] - samples * share) < 1 + 1e-6


def test_a_schedule_is_a_straight_line_between_knots_and_constant_outside() -> None:
    schedule = read_schedule([(2, 1.0), (6, 3.0), (7, 0)])
    assert [schedule.at(epoch) for epoch in (0, 2, 3, 4, 6, 7, 8, 10**9)] == [1, 1, 1.5, 2, 3, 0, 0, 0]
    assert schedule.to_json() == [[2, 1.0], [6, 3.0], [7, 0.0]]
    assert read_schedule(np.float32(0.5)).to_json() == 0.5


def test_a_set_comes_in_as_its_schedule_says() -> None:
    shares = Shares([read_schedule([(0, 0), (4, 4)]), read_schedule([(0, 4), (4, 0)])], 8)
    assert [counts(shares, epoch)[0] for epoch in range(7)] == [0, 2, 4, 6, 8, 8, 8]


@pytest.mark.parametrize("weight", ["1", None, True, {}, [], [1, 2], [(0, 1, 2)], [(0, "1")], ((0, None),)])
def test_a_weight_is_a_number_or_knots(weight: Any) -> None:
    with pytest.raises(BadConfig, match=r"^a weight must be a number or knots \(epoch, weight\), found "):
        read_schedule(weight)


@pytest.mark.parametrize("weight", [-1, math.nan, math.inf, [(0, 1), (3, -0.5)]])
def test_a_weight_is_finite_and_at_least_0(weight: Any) -> None:
    with pytest.raises(BadConfig, match=r"^a weight must be finite and at least 0, found (-1|nan|inf|-0.5)$"):
        read_schedule(weight)


@pytest.mark.parametrize("epochs", [(3, 3), (4, 2), (0, 100_001)])
def test_epochs_of_knots_rise(epochs: tuple[int, int]) -> None:
    with pytest.raises(BadConfig, match=r"^epochs of a weight's knots must rise, up to 100000, found \["):
        read_schedule([(epoch, 1.0) for epoch in epochs])


def test_an_epoch_of_nothing_is_refused() -> None:
    for weights, epoch in (([0, 0], 0), ([[(0, 1), (5, 0), (9, 1)], 0], 5), ([[(0, 1), (7, 0)], [(0, 1), (3, 0)]], 7)):
        with pytest.raises(BadConfig, match=rf"sum above 0 and finite, found 0 in epoch {epoch}$"):
            Shares([read_schedule(weight) for weight in weights], 10)  # type: ignore[arg-type]  # a list of both kinds
    with pytest.raises(BadConfig, match=r"sum above 0 and finite, found inf in epoch 0$"):
        Shares(constant(1e308, 1e308), 10)
