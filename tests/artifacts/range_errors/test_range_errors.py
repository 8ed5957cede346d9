"""Errors of range against their formulas, on tilted planes and steps whose ranges and angles are exact."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from planes import CAMERA, RIG, plane, sample_of, shown

from bodyseg_data.artifacts import Artifact, AxialNoise, angles, shown_with
from bodyseg_data.artifacts.range_errors import (
    POWERS,
    REACH,
    DisparityRounding,
    LateralNoise,
    MixedPixels,
    RangeRounding,
    StereoNoise,
)
from bodyseg_data.artifacts.surface import grazing
from bodyseg_data.core import BadConfig
from bodyseg_data.labels import BACKGROUND
from bodyseg_data.samples import Sample


def errors_mm(artifact: Artifact, sample: Sample, columns: slice = slice(60, 100)) -> NDArray[np.float64]:
    """Errors of the middle columns, mm."""
    inside = (slice(30, -30), columns)
    made = shown(artifact, sample).range[inside].astype(np.float64)
    return (made - sample.range[inside]) * 0.1


@pytest.mark.parametrize("range_m", [0.8, 2.0, 3.5])
@pytest.mark.parametrize("tilt_deg", [0, 30, 60, 75])
def test_axial_noise_has_the_sigma_of_its_formula(range_m: float, tilt_deg: float) -> None:
    errors = errors_mm(AxialNoise(), plane(range_m, tilt_deg), slice(78, 82))
    theta = math.radians(tilt_deg)
    sigma = 1.2 + 1.9 * (range_m - 0.4) ** 2 + 0.1 / math.sqrt(range_m) * (theta / (math.pi / 2 - theta)) ** 2
    assert errors.std() == pytest.approx(sigma, rel=0.08)
    assert abs(errors.mean()) < 4 * sigma / math.sqrt(errors.size)


@pytest.mark.parametrize("power", POWERS)
def test_the_grazing_term_has_its_power(power: float) -> None:
    artifact = AxialNoise(0.0, 0.0, 0.0, 2.0, power)
    theta = np.float32(1.2)
    for range_m in (0.5, 1.0, 4.0):
        sigma = artifact.sigma_m(np.array([range_m], np.float32), np.array([theta]))
        assert sigma[0] == pytest.approx(2e-3 * range_m**power * (1.2 / (math.pi / 2 - 1.2)) ** 2, rel=1e-5)


def test_angles_are_those_of_the_surface() -> None:
    degrees = np.array([0, 1, 10, 45, 60, 80, 84.9], np.float64)
    slant = (1 / np.cos(np.radians(degrees)) ** 2).astype(np.float32)
    np.testing.assert_allclose(np.degrees(angles(slant)), degrees, atol=0.02)
    np.testing.assert_allclose(np.degrees(angles(np.float32([1e4, np.inf, 0.9]))), [85, 85, 0], atol=0.01)
    np.testing.assert_allclose(grazing(np.float32([0, np.pi / 4])), [0, 1], rtol=1e-6)


@pytest.mark.parametrize(("focal_px", "baseline_m"), [(None, None), (800.0, None), (800.0, 0.05)])
def test_stereo_noise_grows_with_the_square_of_the_range(focal_px: float | None, baseline_m: float | None) -> None:
    artifact = StereoNoise(0.2, focal_px, baseline_m)
    for range_m in (1.0, 3.0):
        sigma = range_m**2 * 0.2 / ((focal_px or 400) * (baseline_m or 0.075)) * 1000
        assert errors_mm(artifact, plane(range_m)).std() == pytest.approx(sigma, rel=0.05)


def test_disparities_are_whole_steps() -> None:
    sample = plane(2.0, 40)
    made = shown(DisparityRounding(0.5), sample)
    kept = made.range > 0
    disparity = 400 * 0.075 / (made.range[kept] * 1e-4)
    # Ranges are whole steps of 0.1 mm, which is up to so much of disparity.
    slack = disparity**2 / (400 * 0.075) * 0.5e-4 + 1e-9
    assert (np.abs(disparity / 0.5 - np.rint(disparity / 0.5)) * 0.5 <= slack).all()
    assert len(np.unique(made.range)) < 80 and np.array_equal(kept, sample.range > 0)
    half = sample.range[kept] ** 2.0 * 1e-8 * 0.25 / (400 * 0.075) / 1e-4
    assert (np.abs(made.range[kept].astype(float) - sample.range[kept]) <= half * 1.3 + 1).all()


def test_a_range_whose_disparity_is_none_is_lost() -> None:
    made = shown(DisparityRounding(60.0), plane(2.0))
    assert not made.range.any() and (made.labels == BACKGROUND).all()


def test_ranges_are_whole_steps() -> None:
    sample = plane(2.0, 40)
    made = shown(RangeRounding(2.5), sample).range
    assert (made % 25 == 0).all() and np.array_equal(made > 0, sample.range > 0)
    assert np.abs(made.astype(int) - sample.range).max() <= 13
    assert set(np.unique(shown(RangeRounding(1000.0), plane(0.35)).range)) == {0, 10_000}, "no range rounds to nothing"


def test_lateral_noise_moves_pixels_by_its_sigma() -> None:
    """On a plane of slope b, a shift of sigma pixels changes the range by sigma times the slope."""
    sample = plane(2.0, 30)
    inside = (slice(30, -30), slice(60, 100))
    slope = np.gradient(sample.range.astype(np.float64), axis=1)[inside]
    made = shown(LateralNoise(1.5, 0.0), sample)
    shift = (made.range.astype(np.float64) - sample.range)[inside] / slope
    assert shift.std() == pytest.approx(math.sqrt(1.5**2 + 1 / 12), rel=0.05)  # rounded to whole pixels
    flat = errors_mm(LateralNoise(1.5, 0.0), plane(2.0))
    assert not flat.any()
    theta = math.radians(30)
    more = shown(LateralNoise(1.0, 2.0), sample)
    shift = (more.range.astype(np.float64) - sample.range)[inside] / slope
    assert shift.std() == pytest.approx(math.sqrt((1 + 2 * theta / (math.pi / 2 - theta)) ** 2 + 1 / 12), rel=0.08)


def test_lateral_noise_makes_silhouettes_ragged_and_labels_follow() -> None:
    sample = plane(2.0)
    made = shown(LateralNoise(), sample)
    gained, lost = (made.range > 0) & (sample.range == 0), (made.range == 0) & (sample.range > 0)
    assert gained.sum() == pytest.approx(lost.sum(), rel=0.3) and gained.sum() > 50
    assert np.flatnonzero(gained.any(axis=1)).min() >= 20 - REACH
    assert ((made.range > 0) == (made.labels != BACKGROUND)).all()
    beside = made.labels[30:-30] != sample.labels[30:-30]
    borders = np.flatnonzero(beside.any(axis=1)) % 10
    assert beside.any() and set(borders) <= {0, 1, 2, 7, 8, 9}, "labels change at borders of parts alone"


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_mixed_pixels_lie_between_the_surfaces(share: float) -> None:
    z = np.full((200, 160), 2.0)
    z[:, 80:] = 3.0
    z[:10] = 0
    sample = sample_of(z)
    made = shown(MixedPixels(share), sample).range
    changed = made != sample.range
    assert set(np.flatnonzero(changed.any(axis=0))) <= {79}
    assert changed.sum() == pytest.approx(190 * share, abs=4 * math.sqrt(190 * share * (1 - share)) + 1e-9)
    if share == 1:
        position = (made[10:, 79] - 20_000) / 10_000
        assert position.min() >= 0 and position.max() < 1
        assert position.mean() == pytest.approx(0.5, abs=0.1) and position.std() == pytest.approx(0.289, abs=0.06)
    behind = shown(MixedPixels(1.0, background_m=5.0), sample).range
    assert (behind[10, :80] > 20_000).all() and (behind[10, 80:] > 30_000).all() and behind[:10].max() == 0
    assert not (shown(MixedPixels(1.0, jump_mm=1500.0), sample).range != sample.range).any()


@pytest.mark.parametrize(
    "artifact", [AxialNoise(), LateralNoise(), StereoNoise(), DisparityRounding(), RangeRounding(), MixedPixels(1.0)]
)
def test_nothing_and_lost_pixels_stay_nothing(artifact: Artifact) -> None:
    nothing = sample_of(np.zeros((200, 160)))
    assert not shown(artifact, nothing).range.any()
    single = np.zeros((200, 160))
    single[100, 80] = 6.5535
    assert shown(artifact, sample_of(single)).range.max() > 50_000 or isinstance(artifact, LateralNoise)


@pytest.mark.parametrize(
    ("kind", "strengths", "message"),
    [
        (AxialNoise, {"constant_mm": -1.0}, "AxialNoise: constant_mm must be from 0 to 1000, found -1.0"),
        (AxialNoise, {"from_m": math.inf}, "AxialNoise: from_m must be from -100 to 100, found inf"),
        (AxialNoise, {"grazing_power": 0.3}, "grazing_power must be one of -0.5, 0, 0.5, 1, 1.5, 2, found 0.3"),
        (LateralNoise, {"grazing_px": math.nan}, "LateralNoise: grazing_px must be from 0 to 20, found nan"),
        (StereoNoise, {"subpixel_px": 11.0}, "subpixel_px must be from 0 to 10, found 11.0"),
        (StereoNoise, {"baseline_m": 0.0}, "baseline_m must be above 0 and at most 100, found 0.0"),
        (DisparityRounding, {"step_px": 0.0}, "step_px must be above 0 and at most 100, found 0.0"),
        (DisparityRounding, {"focal_px": -1.0}, "focal_px must be above 0 and at most 1e[+]06, found -1.0"),
        (RangeRounding, {"step_mm": 0.0}, "step_mm must be above 0 and at most 1000, found 0.0"),
        (MixedPixels, {"share": 1.1}, "MixedPixels: share must be from 0 to 1, found 1.1"),
        (MixedPixels, {"background_m": 0.0}, "background_m must be above 0 and at most 100, found 0.0"),
        (MixedPixels, {"jump_mm": 0.0}, "jump_mm must be above 0 and at most 10000, found 0.0"),
    ],
)
def test_strengths_out_of_range_are_one_line(kind: Any, strengths: dict[str, Any], message: str) -> None:
    with pytest.raises(BadConfig, match=message):
        kind(**strengths)


def test_a_rig_without_baseline_needs_the_sensors() -> None:
    rig = replace(RIG, projector=CAMERA)
    for kind in (StereoNoise, DisparityRounding):
        with pytest.raises(BadConfig, match="rig small has no baseline: give the sensor's as 'baseline_m'"):
            shown_with(kind(), plane(2.0), rig, 0)
        shown_with(kind(baseline_m=0.1), plane(2.0), rig, 0)
