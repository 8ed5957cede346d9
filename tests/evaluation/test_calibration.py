from __future__ import annotations

import math

import numpy as np
import pytest

from bodyseg_data.core import BadConfig
from bodyseg_data.labels import PART_COUNT
from bodyseg_model.evaluation.scores import CELLS, Confidences


def pixels(seed: int, count: int, sharp: float) -> tuple[np.ndarray, np.ndarray]:
    """Pairs and confidences of a network that is the more often right the surer it is; sharp: how sure it is."""
    generator = np.random.default_rng(seed)
    confidence = (1 - generator.random(count) ** sharp).astype(np.float32)
    truth = generator.integers(0, 33, count)
    wrong = generator.random(count) > confidence**0.5
    predicted = np.where(wrong, (truth + generator.integers(1, 33, count)) % 33, truth)
    return truth * 33 + predicted, confidence


def counted(pairs: np.ndarray, confidence: np.ndarray, pieces: int = 1) -> Confidences:
    total = Confidences()
    for some, sure in zip(np.array_split(pairs, pieces), np.array_split(confidence, pieces), strict=True):
        part = Confidences()
        part.add(some, sure)
        total.merge(part)
    return total


def is_wrong(pairs: np.ndarray) -> np.ndarray:
    return pairs // 33 != pairs % 33


def exact_aurc(pairs: np.ndarray, confidence: np.ndarray) -> float:
    order = np.argsort(-confidence, kind="stable")
    return float(np.mean(np.cumsum(is_wrong(pairs)[order]) / np.arange(1, len(pairs) + 1)))


@pytest.mark.parametrize("sharp", [1.0, 3.0, 12.0])
def test_area_under_the_curve_is_that_of_sorted_pixels(sharp: float) -> None:
    pairs, confidence = pixels(1, 200_000, sharp)
    found, expected = counted(pairs, confidence).aurc(), exact_aurc(pairs, confidence)
    assert found == pytest.approx(expected, abs=3e-5)
    coarse = np.floor(confidence * 1500) / 1500  # as from equal steps alone
    assert abs(found - expected) <= abs(exact_aurc(pairs, coarse) - expected) + 3e-5


@pytest.mark.parametrize("confidences", [(0.9, 0.6), (0.99999, 0.9997)], ids=["apart", "within the surest step"])
def test_area_by_hand(confidences: tuple[float, float]) -> None:
    surer = Confidences()
    surer.add(np.array([0, 1]), np.array(confidences, np.float32))
    # Of the surest half nothing is wrong; then wrong pixels come in evenly: the integral of (t / 2) / (1/2 + t / 2).
    assert surer.aurc() == pytest.approx((1 - math.log(2)) / 2)
    same = Confidences()
    same.add(np.array([0, 1]), np.array([0.5, 0.5], np.float32))
    assert same.aurc() == pytest.approx(0.5), "without an order, the risk is the same everywhere"


@pytest.mark.parametrize("pieces", [1, 7])
def test_calibration_error_is_exact(pieces: int) -> None:
    pairs, confidence = pixels(2, 50_000, 2.0)
    found = counted(pairs, confidence, pieces)
    right = ~is_wrong(pairs)
    expected, rows = 0.0, found.reliability()
    for number, row in enumerate(rows):
        chosen = (confidence > np.float32(number / 15)) & (confidence <= np.float32((number + 1) / 15))
        assert row.pixels == chosen.sum()
        assert row.accuracy == pytest.approx(right[chosen].mean())
        assert row.confidence == pytest.approx(confidence[chosen].mean(dtype=np.float64))
        assert (row.confidence_above, row.up_to) == pytest.approx((number / 15, (number + 1) / 15))
        expected += chosen.sum() * abs(right[chosen].mean() - confidence[chosen].mean(dtype=np.float64)) / len(pairs)
    assert len(rows) == 15
    assert found.ece() == pytest.approx(expected)
    assert found.mean() == pytest.approx(confidence.mean(dtype=np.float64))


@pytest.mark.parametrize("threshold", [0.0, 0.5, 0.7, 0.9, 29 / 30])
def test_what_is_kept_above_a_threshold_is_exact(threshold: float) -> None:
    pairs, confidence = pixels(3, 50_000, 2.0)
    kept = counted(pairs, confidence, 3).above(threshold)
    chosen = confidence > np.float32(threshold)
    truth, right = pairs // 33, ~is_wrong(pairs)
    assert kept.share_of_pixels == chosen.mean()
    assert kept.pixel_accuracy == pytest.approx(right[chosen].mean())
    by_part = [right[chosen & (truth == part)].mean() for part in range(33)]
    assert kept.average_per_class_accuracy == pytest.approx(np.mean(by_part))


def test_a_pixel_at_the_threshold_is_dropped_and_one_above_is_kept() -> None:
    at = np.float32(0.7)
    confidences = Confidences()
    confidences.add(np.array([0, 1]), np.array([at, np.nextafter(at, np.float32(1))], np.float32))
    kept = confidences.above(0.7)
    assert (kept.share_of_pixels, kept.pixel_accuracy) == (0.5, 0.0)


def test_the_curve_ends_at_all_pixels_and_their_risk() -> None:
    pairs, confidence = pixels(4, 20_000, 3.0)
    coverage, risk = counted(pairs, confidence).curve()
    assert (np.diff(coverage) > 0).all()
    assert (coverage[-1], risk[-1]) == (1, pytest.approx(is_wrong(pairs).mean()))
    order = np.argsort(-confidence)
    for place in (10, len(coverage) // 2):
        surest = order[: round(coverage[place] * len(pairs))]
        assert risk[place] == pytest.approx(is_wrong(pairs)[surest].mean())


def test_confidences_that_rounding_has_moved_out_of_0_to_1_count_at_the_ends() -> None:
    confidences = Confidences()
    confidences.add(np.array([0, 0, 1, 1]), np.array([1 + 1e-6, 1, 0, -1e-6], np.float32))
    assert confidences.counts[0, 0] == 2
    assert confidences.counts[1, CELLS - 1] == 2
    assert confidences.pixels == 4


@pytest.mark.parametrize("bad", [1.1, -0.1, math.nan])
def test_what_is_no_confidence_is_refused(bad: float) -> None:
    with pytest.raises(BadConfig, match="confidences must be 0 to 1, found"):
        Confidences().add(np.array([0, 0]), np.array([0.5, bad], np.float32))


@pytest.mark.parametrize("bad", [1.0, -1 / 30, 0.71, math.nan])
def test_a_threshold_between_the_counts_is_refused(bad: float) -> None:
    with pytest.raises(BadConfig, match="a threshold must be a multiple of 1/30 from 0 to below 1"):
        Confidences().above(bad)


def test_nothing_counted_is_no_score() -> None:
    confidences = Confidences()
    confidences.add(np.empty(0, np.int64), np.empty(0, np.float32))
    assert math.isnan(confidences.ece())
    assert math.isnan(confidences.aurc())
    assert math.isnan(confidences.mean())
    assert math.isnan(confidences.above(0.7).share_of_pixels)
    assert confidences.curve()[0].size == 0
    confidences.add(np.array([PART_COUNT**2 - 1]), np.array([0.2], np.float32))
    kept = confidences.above(0.7)
    assert kept.share_of_pixels == 0
    assert math.isnan(kept.pixel_accuracy)
