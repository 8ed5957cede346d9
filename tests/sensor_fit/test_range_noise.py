"""Noise against range and incidence, in recordings with known noise and in plain numbers."""

from __future__ import annotations

import numpy as np
import pytest
from known_sensors import RIG, recorded

from bodyseg_data.artifacts.noise import Noise
from bodyseg_data.artifacts.range_errors.axial_noise import AxialNoise
from bodyseg_data.artifacts.range_errors.rounding import RangeRounding
from bodyseg_data.artifacts.range_errors.stereo import StereoNoise
from bodyseg_model.sensor_fit.finding import NEEDED, NOT_SEEN, UNKNOWN, Finding
from bodyseg_model.sensor_fit.noise.bins import unrounded
from bodyseg_model.sensor_fit.noise.formulas import measure_noise
from bodyseg_model.sensor_fit.noise.least_squares import fit_positive
from bodyseg_model.sensor_fit.noise.residuals import residuals_of
from bodyseg_model.sensor_fit.recording import Recording
from bodyseg_model.sensor_fit.rounding import measure_steps


def noise_of(recording: Recording, baseline_m: float | None = 0.075) -> dict[str, Finding]:
    steps, _ = measure_steps(recording, None)
    found = measure_noise(residuals_of(recording)[0], steps, RIG.camera.focal_px, baseline_m, ragged=False)
    return {finding.artifact: finding for finding in found}


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("sigma_mm", [2.0, 12.0])
def test_noise_of_one_deviation(sigma_mm: float, moving: bool) -> None:
    found = noise_of(recorded(Noise(sigma_mm, sigma_mm), moving=moving))
    assert found["noise"].verdict == NEEDED
    assert found["noise"].strengths["low_mm"] == pytest.approx(sigma_mm, rel=0.1)
    assert found["noise"].strengths["low_mm"] == found["noise"].strengths["high_mm"]
    assert found["lateral_noise"].verdict == NOT_SEEN


def test_noise_that_grows_with_range() -> None:
    found = noise_of(recorded(AxialNoise(1.0, 3.0, grazing_mm=0.0), frames=6, wall=True))
    strengths = found["axial_noise"].strengths
    sigma = strengths["constant_mm"] + strengths["quadratic_mm"] * (np.array([2.0, 3.0]) - 0.4) ** 2
    assert sigma == pytest.approx([1.0 + 3.0 * 1.6**2, 1.0 + 3.0 * 2.6**2], rel=0.05)
    assert found["noise"].verdict == NOT_SEEN


@pytest.mark.parametrize("baseline_m", [0.075, None])
def test_stereo_noise_is_written_for_any_baseline(baseline_m: float | None) -> None:
    found = noise_of(recorded(StereoNoise(0.1), frames=6, wall=True), baseline_m)
    strengths = found["stereo_noise"].strengths
    assert found["stereo_noise"].verdict == NEEDED and strengths["focal_px"] == 525.0
    assert strengths["subpixel_px"] / strengths["baseline_m"] == pytest.approx(0.1 / 0.075, rel=0.05)


def test_each_frame_may_have_a_deviation_of_its_own() -> None:
    found = noise_of(recorded(Noise(0.0, 40.0), frames=10))
    assert found["noise"].verdict == NEEDED and "its own deviation" in found["noise"].reason
    assert found["noise"].strengths["low_mm"] < 12 and 28 < found["noise"].strengths["high_mm"] < 60
    assert found["axial_noise"].verdict == UNKNOWN


def test_noise_below_the_step_cannot_be_told() -> None:
    found = noise_of(recorded(Noise(0.5, 0.5), RangeRounding(20.0), moving=True))
    assert {finding.verdict for finding in found.values()} == {UNKNOWN}
    assert "hidden by steps of 20 mm" in found["noise"].reason


@pytest.mark.parametrize("sigma", [0.15, 0.4, 1.0, 3.0])
def test_the_variance_before_rounding_comes_back(sigma: float) -> None:
    generator = np.random.default_rng(0)
    truth = generator.uniform(0, 1000, 400_000)
    first, second = (np.rint(truth + sigma * generator.standard_normal(len(truth))) for _ in range(2))
    assert unrounded(float(np.mean((first - second) ** 2)) / 2, 1.0, temporal=True) == pytest.approx(sigma**2, rel=0.03)
    assert unrounded(float(np.var(first - truth)), 1.0, temporal=False) == pytest.approx(sigma**2, rel=0.15, abs=0.02)
    assert unrounded(0.01, 1.0, temporal=False) == 0.0


def test_positive_least_squares_find_a_line_and_stop_at_zero() -> None:
    x = np.linspace(0, 5, 40)
    noise = 0.01 * np.random.default_rng(1).standard_normal(40)
    fit = fit_positive(("a", "b"), lambda each: each["a"] + each["b"] * x, 2 + 0.5 * x + noise, np.full(40, 0.01))
    assert fit.parameters["a"][0] == pytest.approx(2, abs=0.01) and fit.parameters["b"][0] == pytest.approx(
        0.5, abs=0.01
    )
    assert 0.001 < fit.parameters["a"][1] < 0.01 and 15 < fit.chi2 < 70
    bound = fit_positive(("a", "b"), lambda each: each["a"] + each["b"] * x, 2 - 0.5 * x, np.full(40, 0.01))
    assert bound.parameters["b"][0] == 0.0
