"""Noise against range and incidence, in recordings with known noise and in plain numbers."""

from __future__ import annotations

import numpy as np
import pytest
from known_sensors import RIG, recorded

from bodyseg_data.artifacts import AxialNoise, Noise
from bodyseg_data.artifacts.range_errors import RangeRounding, StereoNoise
from bodyseg_model.sensor_fit.finding import NEEDED, NOT_SEEN, UNKNOWN, Finding
from bodyseg_model.sensor_fit.noise import fit_positive, measure_noise, unrounded
from bodyseg_model.sensor_fit.recording import MarkedRecording
from bodyseg_model.sensor_fit.residuals import Residuals, Steps, measure_steps, residuals_of


def noise_of(recording: MarkedRecording, baseline_m: float | None = 0.075) -> dict[str, Finding]:
    steps, _ = measure_steps(recording, None)
    found = measure_noise(residuals_of(recording), steps, RIG.camera.focal_px, baseline_m, ragged=False)
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
    assert found["stereo_noise"].written and strengths["focal_px"] == 525.0
    assert strengths["subpixel_px"] / strengths["baseline_m"] == pytest.approx(0.1 / 0.075, rel=0.05)


def test_growth_at_grazing_angles_is_told_from_the_constant() -> None:
    """The figure's few steep pixels say that noise grows, not by how much; `tools/bench sensor_fit` measures bodies."""
    found = noise_of(recorded(AxialNoise(3.0, 1.0, 0.3), frames=6, wall=True))["axial_noise"]
    assert found.verdict == NEEDED and found.strengths["grazing_mm"] > 0.05
    assert found.strengths["constant_mm"] == pytest.approx(3.0, rel=0.1)


def test_formulas_that_are_equal_over_the_ranges_seen_cannot_be_told_apart() -> None:
    z = np.repeat(np.linspace(2.0, 3.0, 6), 2000)
    normal = np.random.default_rng(2).standard_normal(len(z))
    flat = np.zeros(len(z))
    steps = Steps(1e-4)
    for sigma_mm, told in ((2.5 * z**2, False), (8 * (z - 0.4) ** 2, True)):
        residuals = [Residuals("temporal", False, normal * sigma_mm / 1000, z, flat, flat, 0.0)]
        found = {each.artifact: each for each in measure_noise(residuals, steps, 525.0, 0.075, ragged=False)}
        if told:
            assert found["axial_noise"].verdict == NEEDED and found["stereo_noise"].verdict == NOT_SEEN
            continue
        assert {found[name].verdict for name in ("axial_noise", "stereo_noise")} == {UNKNOWN}
        assert found["stereo_noise"].written and not found["axial_noise"].written
        assert found["stereo_noise"].estimates["per_m2_mm"].value == pytest.approx(2.5, rel=0.03)
        assert "explains as much" in found["stereo_noise"].reason


def test_limbs_are_no_noise_at_grazing_angles() -> None:
    generator = np.random.default_rng(3)
    angle = np.radians(np.repeat(np.arange(5, 78, 4), 4000)).astype(np.float64)
    slope = 0.0038 * np.tan(angle)
    z = np.full(len(angle), 2.0)
    for per_pixel, grows in ((0.18, False), (0.9, True)):
        sigma = np.hypot(0.003, per_pixel * slope)
        values = sigma * generator.standard_normal(len(angle))
        residuals = [Residuals("spatial", True, values, z, slope, angle, 0.0)]
        found = {each.artifact: each for each in measure_noise(residuals, Steps(1e-4), 525.0, 0.075, ragged=False)}
        assert (found["noise"].verdict == NEEDED) is not grows
        assert (found["axial_noise"].verdict == NEEDED) is grows


def test_edges_that_strong_noise_hides_are_no_noise_at_grazing_angles() -> None:
    """A relief of half a pixel may be such edges beside 20 mm of noise, but not beside 5 mm."""
    generator = np.random.default_rng(3)
    angle = np.radians(np.repeat(np.arange(5, 78, 2), 8000)).astype(np.float64)
    slope, z = 0.0038 * np.tan(angle), np.full(len(angle), 2.0)
    for sigma_m, grows in ((0.02, False), (0.005, True)):
        values = np.hypot(sigma_m, 0.5 * slope) * generator.standard_normal(len(angle))
        residuals = [Residuals("spatial", True, values, z, slope, angle, 0.0)]
        found = {each.artifact: each for each in measure_noise(residuals, Steps(1e-4), 525.0, 0.075, ragged=False)}
        assert (found["axial_noise"].verdict == NEEDED) is grows


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
