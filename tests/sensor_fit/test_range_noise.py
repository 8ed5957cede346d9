"""Noise of range, in recordings with known noise and in plain numbers."""

from __future__ import annotations

import numpy as np
import pytest
from benches.model.sensor_fit.recordings import in_steps
from known_sensors import recorded

from bodyseg_data.artifacts import Noise
from bodyseg_model.sensor_fit.finding import NEEDED, NOT_SEEN
from bodyseg_model.sensor_fit.noise import before_equal_rounding, clipped_variance, measure_noise


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("sigma_mm", [1.0, 12.0, 80.0])
def test_noise_of_one_deviation(sigma_mm: float, moving: bool) -> None:
    found = measure_noise(recorded(Noise(sigma_mm, sigma_mm), moving=moving))
    assert found.verdict == NEEDED and found.estimates["sigma_mm"].error < 0.1 * sigma_mm
    assert found.strengths["low_mm"] == found.strengths["high_mm"] == pytest.approx(sigma_mm, rel=0.05)


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("sigma_mm", [1.0, 3.0])
def test_rounding_of_stored_values_is_noise(sigma_mm: float, moving: bool) -> None:
    found = measure_noise(in_steps(recorded(Noise(sigma_mm, sigma_mm), moving=moving), 8.0))
    assert found.estimates["sigma_mm"].value == pytest.approx(np.hypot(sigma_mm, 8 / np.sqrt(12)), rel=0.15)
    assert ("most of it by steps of 8 mm" in found.reason) is (sigma_mm == 1.0)


def test_files_in_millimetres_have_no_noise_by_that() -> None:
    assert measure_noise(in_steps(recorded(), 1.0)).verdict == NOT_SEEN


def test_each_frame_may_have_a_deviation_of_its_own() -> None:
    found = measure_noise(recorded(Noise(0.0, 40.0), frames=10))
    assert found.verdict == NEEDED and "its own deviation" in found.reason
    assert found.strengths["low_mm"] < 12 and 28 < found.strengths["high_mm"] < 60


@pytest.mark.parametrize("sigma", [0.05, 0.25, 0.3, 1.0])
def test_the_variance_about_the_truth_follows_from_differences_of_rounded_values(sigma: float) -> None:
    generator = np.random.default_rng(0)
    truth = generator.uniform(0, 1000, 100_000)
    first, second = (np.rint(truth + sigma * generator.standard_normal(len(truth))) for _ in range(2))
    half = float(np.mean((first - second) ** 2)) / 2
    assert before_equal_rounding(half, 1.0) == pytest.approx(float(np.var(first - truth)), rel=0.03)


def test_outliers_do_not_count() -> None:
    values = np.random.default_rng(0).standard_normal(100_000)
    values[::100] = 50.0
    assert clipped_variance(values, 0.0) == pytest.approx(1.0, rel=0.02)
