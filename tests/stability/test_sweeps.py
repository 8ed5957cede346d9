"""Sweeps, and what those of stored samples do to an image."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from bodyseg_data import RangeImages
from bodyseg_data.core import BadConfig
from bodyseg_data.rigs import Rig
from bodyseg_data.samples import Sample
from bodyseg_model.stability import SWEEPS, chosen
from bodyseg_model.stability.scenes import CLEAN, DEPTHS_M, SweepPoint, corrupted

OTHERS = "hard", "turned", "remnants"
STORED = [name for name, sweep in SWEEPS.items() if sweep.origin == "stored" and name not in OTHERS]
SHARES = ("missing", "patches", "stripes")


@pytest.fixture(scope="module")
def images(figures_set: Path) -> RangeImages:
    return RangeImages(figures_set, "none", "test")


@pytest.fixture(scope="module")
def sample(images: RangeImages) -> Sample:
    return images.clean(0)


@pytest.fixture(scope="module")
def rig(images: RangeImages) -> Rig:
    return images.manifest.rig


def extent(shown: NDArray[np.bool_]) -> tuple[int, int]:
    places = np.flatnonzero(shown)
    return int(places[0]), int(places[-1]) + 1


@pytest.mark.parametrize("name", SWEEPS)
def test_sweeps_begin_clean_and_go_one_way(name: str) -> None:
    sweep = SWEEPS[name]
    conditions = sweep.conditions(name)
    assert conditions[0] == CLEAN[sweep.origin]
    assert conditions[1:] == [SweepPoint(name, strength) for strength in sweep.strengths[1:]]
    steps = np.diff(sweep.strengths)
    assert (steps > 0).all() or (steps < 0).all()


@pytest.mark.parametrize("name", STORED)
def test_what_is_changed_is_a_copy_on_the_body(name: str, sample: Sample, rig: Rig) -> None:
    before = sample.range.copy()
    for strength in SWEEPS[name].strengths[1:]:
        image = corrupted(sample, SweepPoint(name, strength), rig, 0)
        np.testing.assert_array_equal(image, corrupted(sample, SweepPoint(name, strength), rig, 0))
        assert image.dtype == np.uint16 and image.shape == sample.range.shape
        assert not image[sample.range == 0].any()
        finer = name == "depth_steps" and (DEPTHS_M[1] - DEPTHS_M[0]) / (2**strength - 1) <= rig.range_step_m
        assert (image != sample.range).any() != finer, "steps no coarser than the stored ones change nothing"
    np.testing.assert_array_equal(sample.range, before)
    assert corrupted(sample, CLEAN["stored"], rig, 0) is sample.range


LOSING = [name for name in STORED if name not in ("noise", "depth_steps", "mixed", "speed", "clothes", "ambient")]


@pytest.mark.parametrize("name", LOSING)
def test_what_is_lost_stays_lost_and_the_rest_is_as_it_was(name: str, sample: Sample, rig: Rig) -> None:
    before = sample.range
    for strength in SWEEPS[name].strengths[1:]:
        image = corrupted(sample, SweepPoint(name, strength), rig, 0)
        assert ((image == before) | (image == 0)).all()
        assert np.count_nonzero(image) < np.count_nonzero(before)
        before = image


@pytest.mark.parametrize("name", SHARES)
def test_shares_are_of_the_body(name: str, sample: Sample, rig: Rig) -> None:
    pixels = np.count_nonzero(sample.range)
    for share in SWEEPS[name].strengths[1:]:
        lost = pixels - np.count_nonzero(corrupted(sample, SweepPoint(name, share), rig, 0))
        chance = 5 * np.sqrt(pixels * share * (1 - share)) if name == "missing" else 0.5
        assert lost == pytest.approx(share * pixels, abs=chance)


def test_noise_has_the_sigma_asked_for(sample: Sample, rig: Rig) -> None:
    body = sample.range > 0
    off = {
        sigma: (corrupted(sample, SweepPoint("noise", sigma), rig, 0)[body].astype(float) - sample.range[body])
        * rig.range_step_mm
        for sigma in (10, 40)
    }
    for sigma, each in off.items():
        assert each.std() == pytest.approx(sigma, rel=0.05)
        assert abs(each.mean()) < 0.05 * sigma
    np.testing.assert_allclose(
        off[40], 4 * off[10], atol=5 * rig.range_step_mm, err_msg="the same draws, four times as strong"
    )
    assert (
        corrupted(sample, SweepPoint("noise", 10), rig, 1) != corrupted(sample, SweepPoint("noise", 10), rig, 0)
    ).any()


def test_fringes_lose_and_err_more_where_their_cause_is_stronger(sample: Sample, rig: Rig) -> None:
    def left_and_error_mm(name: str) -> list[tuple[int, float]]:
        images = [corrupted(sample, SweepPoint(name, strength), rig, 0) for strength in SWEEPS[name].strengths[1:]]
        errors = [(image.astype(float) - sample.range)[image > 0] * rig.range_step_mm for image in images]
        return [(len(each), float(np.abs(each).mean())) for each in errors]

    for name in ("speed", "clothes"):
        left = [pixels for pixels, _ in left_and_error_mm(name)]
        assert left[-1] < 0.9 * np.count_nonzero(sample.range) and sorted(left, reverse=True) == left
    errors = [error for _, error in left_and_error_mm("ambient")]
    assert errors[-1] > 1.5 * errors[0] and sorted(errors) == errors


def test_remnants_are_added_beside_the_body_farther_away_the_wider(sample: Sample, rig: Rig) -> None:
    added = []
    for strength in SWEEPS["remnants"].strengths[1:]:
        image = corrupted(sample, SweepPoint("remnants", strength), rig, 0)
        np.testing.assert_array_equal(image, corrupted(sample, SweepPoint("remnants", strength), rig, 0))
        np.testing.assert_array_equal(image[sample.range > 0], sample.range[sample.range > 0])
        added.append(np.count_nonzero(image[sample.range == 0]))
    assert sorted(added) == added and added[0] > 0


def test_few_bits_leave_few_depths(sample: Sample, rig: Rig) -> None:
    body = sample.range > 0
    for bits in (12, 8):
        step_mm = 1000 * (DEPTHS_M[1] - DEPTHS_M[0]) / (2**bits - 1)
        image = corrupted(sample, SweepPoint("depth_steps", bits), rig, 0)
        depths_mm = np.unique(image[body]) * rig.range_step_mm
        assert (
            np.abs(image[body].astype(float) - sample.range[body]).max() * rig.range_step_mm
            <= (step_mm + rig.range_step_mm) / 2
        )
        codes = (depths_mm - 1000 * DEPTHS_M[0]) / step_mm
        np.testing.assert_allclose(codes, np.rint(codes), atol=rig.range_step_mm / 2 / step_mm + 1e-6)
    assert len(depths_mm) < 60 < len(np.unique(sample.range[body])), "8 bits: a step of 15.7 mm"


def test_depths_beyond_the_interval_are_its_ends(sample: Sample, rig: Rig) -> None:
    image = np.zeros_like(sample.range)
    image[0, :3] = np.rint(np.array([0.1, 2.5, 6.0]) / rig.range_step_m)
    made = corrupted(Sample("k", image, None, sample.labels, sample.faces_projector, sample.info),
                   SweepPoint("depth_steps", 8), rig, 0)  # fmt: skip
    assert made[0, [0, 2, 3]].tolist() == [round(0.5 / rig.range_step_m), round(4.5 / rig.range_step_m), 0]


def test_crops_take_their_share_from_their_side(sample: Sample, rig: Rig) -> None:
    top, bottom = extent(sample.range.any(axis=1))
    left, right = extent(sample.range.any(axis=0))
    shown = {
        name: corrupted(sample, SweepPoint(name, 0.3), rig, 0) for name in ("crop_below", "crop_above", "crop_side")
    }
    tall, wide = round(0.3 * (bottom - top)), round(0.3 * (right - left))
    assert not shown["crop_below"][bottom - tall :].any()
    np.testing.assert_array_equal(shown["crop_below"][: bottom - tall], sample.range[: bottom - tall])
    assert not shown["crop_above"][: top + tall].any()
    np.testing.assert_array_equal(shown["crop_above"][top + tall :], sample.range[top + tall :])
    assert not shown["crop_side"][:, : left + wide].any()
    np.testing.assert_array_equal(shown["crop_side"][:, left + wide :], sample.range[:, left + wide :])


def test_an_empty_image_stays_empty(sample: Sample, rig: Rig) -> None:
    nothing = np.zeros_like(sample.range)
    empty = Sample("k", nothing, None, np.full_like(sample.labels, 255), nothing > 0, sample.info)
    for name in STORED:
        assert not corrupted(empty, SweepPoint(name, SWEEPS[name].strengths[-1]), rig, 0).any()


def test_sweeps_are_chosen_by_name() -> None:
    assert list(chosen((), hard=True)) == list(SWEEPS)
    assert list(chosen((), hard=False)) == [name for name in SWEEPS if name != "hard"]
    assert list(chosen(("tilt", "noise"), hard=False)) == ["noise", "tilt"]
    with pytest.raises(BadConfig, match="a sweep must be one of noise, .*, found 'rain'"):
        chosen(("rain",), hard=False)
    with pytest.raises(BadConfig, match="needs a set of hard poses: give --hard"):
        chosen(("hard",), hard=False)
    with pytest.raises(BadConfig, match="'hard', which is not among noise, tilt"):
        chosen(("noise", "tilt"), hard=True)
