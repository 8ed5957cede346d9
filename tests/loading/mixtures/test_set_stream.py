"""Order in which a set gives its samples, with and without sample weights."""

from __future__ import annotations

import pickle
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bodyseg_data import RangeImages
from bodyseg_data.core import BadConfig
from bodyseg_data.loading.image_set import Request
from bodyseg_data.loading.mixture import SetStream


@pytest.fixture(scope="module")
def images(figures_set: Path) -> RangeImages:
    return RangeImages(figures_set, "all", "train", seed=3)


def taken(stream: SetStream, start: int, count: int, shuffle: bool = True) -> list[Request]:
    return stream.take(start, count, shuffle).part(0, count)


def test_a_pass_is_the_epoch_of_the_set_itself(images: RangeImages) -> None:
    stream = SetStream(images)
    found = taken(stream, 0, 3 * 16)
    expected = [request for number in range(3) for request in images.requests(number).part(0, 16)]
    assert found == expected
    assert taken(stream, 0, 20, shuffle=False) == [(0, n) for n in range(16)] + [(1, n) for n in range(4)]


@pytest.mark.parametrize("weights", [None, [1, 0, 3, 0.5] * 4])
@pytest.mark.parametrize("shuffle", [True, False])
def test_any_stretch_of_the_sequence_can_be_asked_for(images: RangeImages, weights: Any, shuffle: bool) -> None:
    whole = taken(SetStream(images, weights), 0, 100, shuffle)
    stream = SetStream(images, weights)
    for start, count in ((90, 10), (0, 3), (3, 1), (15, 2), (16, 16), (10, 60), (99, 1), (40, 0)):
        assert taken(stream, start, count, shuffle) == whole[start : start + count]


@given(weights=st.lists(st.floats(0, 1e6), min_size=16, max_size=16).filter(any), number=st.integers(0, 10**9))
def test_a_sample_comes_floor_or_ceil_of_its_expected_number(
    images: RangeImages, weights: list[float], number: int
) -> None:
    found = taken(SetStream(images, weights), 16 * number, 16)
    times = Counter(index for _, index in found)
    for index, weight in enumerate(weights):
        expected = weight / max(weights) * 16 / sum(each / max(weights) for each in weights)
        assert np.floor(expected - 1e-9) <= times[index] <= np.ceil(expected + 1e-9)
        assert weight or not times[index]
    assert len(set(found)) == 16, "every occurrence has draws of its own"


def test_no_draw_comes_twice_over_the_passes(images: RangeImages) -> None:
    weights = np.arange(16) ** 2
    found = taken(SetStream(images, weights), 0, 16 * 200)
    assert len(set(found)) == 16 * 200


def test_expected_numbers_are_proportional_to_the_weights(images: RangeImages) -> None:
    weights = np.arange(16, dtype=float)
    passes = 3000
    times = np.bincount(SetStream(images, weights).take(0, 16 * passes, True).indices, minlength=16)
    expected = weights / weights.sum() * 16
    spread = np.sqrt((expected % 1) * (1 - expected % 1) * passes)  # of a number that is floor or ceil in each pass
    assert times[0] == 0
    assert np.all(np.abs(times - expected * passes) <= 4.5 * spread + 1e-6)


def test_samples_of_equal_weight_come_once_each(images: RangeImages) -> None:
    found = taken(SetStream(images, np.full(16, 0.1)), 0, 64)
    for number in range(4):
        assert sorted(found[16 * number : 16 * number + 16]) == [(number, index) for index in range(16)]


def test_every_pass_has_another_choice_of_rare_samples(images: RangeImages) -> None:
    """Neighbours in stored order are not tied together, as they would be without an order for every pass."""
    weights = [1.5] * 8 + [0.5] * 8
    stream = SetStream(images, weights)
    rare = [frozenset(index for _, index in taken(stream, 16 * n, 16) if index >= 8) for n in range(60)]
    assert len(set(rare)) > 40
    assert 0.4 < np.mean([len(each) for each in rare]) / 8 < 0.6


def test_the_digest_is_of_weights_up_to_a_factor(images: RangeImages) -> None:
    weights = np.linspace(0, 3, 16)
    assert SetStream(images).digest is None
    assert SetStream(images, weights).digest == SetStream(images, weights * 4).digest
    assert SetStream(images, weights).digest != SetStream(images, weights[::-1]).digest


def test_a_tiny_weight_is_not_lost(images: RangeImages) -> None:
    stream = SetStream(images, [1e-300] + [1.0] * 15)
    assert stream.digest != SetStream(images, [0.0] + [1.0] * 15).digest


def test_samples_that_stand_for_a_set_follow_its_weights(images: RangeImages) -> None:
    assert SetStream(images).evenly_sampled(4).tolist() == [0, 5, 10, 15]
    assert SetStream(images, [0, 1, 3, *[0] * 13]).evenly_sampled(8).tolist() == [1, 1, 2, 2, 2, 2, 2, 2]


def test_a_stream_is_pickled_without_its_orders(images: RangeImages) -> None:
    stream = SetStream(images)
    size = len(pickle.dumps(stream))
    expected = taken(stream, 0, 40)
    assert len(pickle.dumps(stream)) == size
    assert taken(pickle.loads(pickle.dumps(stream)), 0, 40) == expected


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        ("many", "sample weights must be numbers, found str"),
        ([[1], [2, 3]], "sample weights must be numbers, found list"),
        ([1.0, 2.0], r"there must be a sample weight for each of 16 samples, found \(2,\)"),
        (1.0, r"there must be a sample weight for each of 16 samples, found \(\)"),
        ([0.0] * 16, "sample weights must be finite, at least 0 and not all 0, found 0 to 0"),
        ([-1.0, *[1.0] * 15], "sample weights must be finite, at least 0 and not all 0, found -1 to 1"),
        ([np.nan, *[1.0] * 15], "sample weights must be finite, at least 0 and not all 0, found nan to nan"),
        ([np.inf, *[1.0] * 15], "sample weights must be finite, at least 0 and not all 0, found 1 to inf"),
    ],
)
def test_sample_weights_fit_the_set(images: RangeImages, weights: Any, message: str) -> None:
    with pytest.raises(BadConfig, match=f"^{message}$"):
        SetStream(images, weights)
