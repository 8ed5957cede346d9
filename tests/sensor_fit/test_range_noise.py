"""Noise of range, in recordings with known noise and in plain numbers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from benches.model.sensor_fit.recordings import in_steps
from known_sensors import recorded
from scipy.ndimage import gaussian_filter

from bodyseg_data.artifacts import Noise
from bodyseg_model.sensor_fit.finding import NEEDED, NOT_SEEN
from bodyseg_model.sensor_fit.noise import before_equal_rounding, clipped_variance, measure_noise
from bodyseg_model.sensor_fit.recording import MarkedFrame


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


def test_frames_that_a_driver_repeats_say_nothing_of_noise() -> None:
    once = recorded(Noise(5.0, 5.0))
    twice = replace(once, frames=tuple(np.repeat(once.frames, 2)), pairs=tuple((n, n + 1) for n in range(7)))
    assert measure_noise(twice).strengths == measure_noise(once).strengths
    alone = measure_noise(replace(once, frames=once.frames[:1] * 4))
    assert alone.strengths["low_mm"] == pytest.approx(5.0, rel=0.05) and "within frames" in alone.reason


@pytest.mark.parametrize("blur_px", [1.0, 1.5])
def test_noise_that_neighbours_share_is_no_motion(blur_px: float) -> None:
    once, generator = recorded(), np.random.default_rng(0)
    frames = []
    for frame in once.frames:
        noise = gaussian_filter(generator.standard_normal(frame.range_m.shape), blur_px)
        range_m = np.where(frame.range_m > 0, frame.range_m + 0.005 * noise / noise.std(), 0).astype(np.float32)
        frames.append(replace(frame, range_m=range_m, stored=np.rint(range_m / once.step_m).astype(np.uint16)))
    found = measure_noise(replace(once, frames=tuple(frames)))
    assert found.strengths["low_mm"] == pytest.approx(5.0, rel=0.05) and "between frames" in found.reason


def test_folds_that_sway_are_no_noise_that_neighbours_share() -> None:
    once, frames = recorded(Noise(1.0, 1.0)), []
    for shift, frame in zip((0, 1, 0, 1), once.frames, strict=True):
        folds_m = 0.012 * np.sin(2 * np.pi * (np.arange(frame.body.shape[1]) + shift) / 24)
        range_m = np.where(frame.body, frame.range_m + folds_m, 0).astype(np.float32)
        frames.append(replace(frame, range_m=range_m, stored=np.rint(range_m / once.step_m).astype(np.uint16)))
    found = measure_noise(replace(once, frames=tuple(frames)))
    assert found.strengths["low_mm"] == pytest.approx(1.0, rel=0.1) and "within frames" in found.reason


def test_frames_of_which_losses_leave_little_are_not_called_filtered() -> None:
    whole, generator, frames = recorded(Noise(3.0, 3.0)), np.random.default_rng(4), []
    upper = np.cumsum(whole.frames[0].body.any(1)) <= 120
    for frame in whole.frames:
        kept = frame.body & upper[:, None] & (generator.random(frame.body.shape) >= 0.5)
        frames.append(MarkedFrame(np.where(kept, frame.stored, 0), np.where(kept, frame.range_m, 0), kept))
    found = measure_noise(replace(whole, frames=tuple(frames)))
    assert found.strengths["low_mm"] == pytest.approx(3.0, rel=0.05) and "between frames" in found.reason


@pytest.mark.parametrize("driver", ["holds most", "holds some", "filters"])
def test_noise_that_a_driver_holds_or_filters_over_frames_is_told_within_them(driver: str) -> None:
    fresh, generator = recorded(Noise(12.0, 12.0), frames=8), np.random.default_rng(0)
    shown = [fresh.frames[0]]
    for frame in fresh.frames[1:]:
        if driver == "filters":  # so that noise is half as much in the end, sqrt(0.4 / 1.6)
            pixels = {"range_m": np.float32(0.4) * frame.range_m + np.float32(0.6) * shown[-1].range_m}
            pixels["range_m"][frame.range_m * shown[-1].range_m == 0] = 0
            pixels["stored"] = np.rint(pixels["range_m"] / fresh.step_m).astype(np.uint16)
        else:
            new = generator.random(frame.stored.shape) < (0.2 if driver == "holds most" else 0.7)
            pixels = {name: np.where(new, vars(frame)[name], vars(shown[-1])[name]) for name in ("stored", "range_m")}
        shown.append(replace(frame, **pixels))
    settled = replace(fresh, frames=tuple(shown[4:]), pairs=fresh.pairs[:3])
    found = measure_noise(settled)
    sigma_mm = 6.0 if driver == "filters" else 12.0
    assert found.strengths["low_mm"] == pytest.approx(sigma_mm, rel=0.05) and "within frames" in found.reason


@pytest.mark.parametrize("count", [2, 3])
def test_two_or_three_frames_tell_that_most_values_are_held(count: int) -> None:
    fresh, generator = recorded(Noise(12.0, 12.0)), np.random.default_rng(0)
    shown = [fresh.frames[0]]
    for frame in fresh.frames[1:count]:
        new = generator.random(frame.stored.shape) < 0.4
        pixels = {name: np.where(new, vars(frame)[name], vars(shown[-1])[name]) for name in ("stored", "range_m")}
        shown.append(replace(frame, **pixels))
    found = measure_noise(replace(fresh, frames=tuple(shown), pairs=fresh.pairs[: count - 1]))
    assert found.strengths["low_mm"] == pytest.approx(12.0, rel=0.05) and "within frames" in found.reason


def test_files_in_millimetres_have_no_noise_by_that() -> None:
    assert measure_noise(in_steps(recorded(), 1.0)).verdict == NOT_SEEN


def test_each_frame_may_have_a_deviation_of_its_own() -> None:
    found = measure_noise(recorded(Noise(0.0, 40.0), frames=10))
    assert found.verdict == NEEDED and "its own deviation" in found.reason
    assert found.strengths["low_mm"] < 12 and 28 < found.strengths["high_mm"] < 60
    errors = [found.estimates[name].error for name in ("sigma_mm", "high_mm")]
    assert 2 * errors[0] == pytest.approx(errors[1], rel=0.01)  # both by the spread of frames, not of their pairs


def test_each_frame_of_a_body_that_moves_may_have_one_too() -> None:
    recording = recorded(Noise(0.0, 40.0), moving=True)
    found, sigmas = measure_noise(recording), [1000 * frame.noise_m for frame in recording.frames]
    assert found.verdict == NEEDED and "within frames" in found.reason and "its own deviation" in found.reason
    ends = np.mean(sigmas) + np.array([-1, 1]) * np.sqrt(3) * np.std(sigmas, ddof=1)
    assert [found.strengths["low_mm"], found.strengths["high_mm"]] == pytest.approx(np.maximum(ends, 0), rel=0.1)


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
