from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import samples

from bodyseg_data.artifacts.missing_data import MissingData, kept_pixels
from bodyseg_data.artifacts.noise import Noise, add_noise
from bodyseg_data.artifacts.occlusion import ShadowTest
from bodyseg_data.errors import BadConfig
from bodyseg_data.parts import BACKGROUND
from bodyseg_data.randomness import generator
from bodyseg_data.rig import Camera, Rig
from bodyseg_data.sample import Sample, SampleInfo
from bodyseg_data.streaming import RangeImages
from bodyseg_data.variants import VARIANTS, Artifacts, Augmentation, RangeImage, VariantName, check_variant


@pytest.fixture(scope="module")
def clean(figures_set: Path) -> list[Sample]:
    images = RangeImages(figures_set)
    return [images.clean(index) for index in range(len(images))]


def made(figures_set: Path, sample: Sample, epoch: int = 0, **options: Any) -> dict[str, RangeImage]:
    rig = RangeImages(figures_set).manifest.rig
    return {name: Augmentation(rig, name, **options)(sample, epoch) for name in VARIANTS}


def test_table_1() -> None:
    table = {name: (variant.occlusion, variant.noise, variant.missing_data) for name, variant in VARIANTS.items()}
    assert table == {
        "none": (False, False, False),
        "occ": (True, False, False),
        "noise": (False, True, False),
        "md": (False, False, True),
        "all": (True, True, True),
    }
    with pytest.raises(BadConfig, match="the variant must be one of none, occ, noise, md, all, found 'full'"):
        check_variant("full")


def test_the_five_variants_share_their_draws(figures_set: Path, clean: list[Sample]) -> None:
    removed = {"occ": 0, "md": 0}
    for sample in clean:
        images = made(figures_set, sample)
        kept = {name: image.range > 0 for name, image in images.items()}
        assert np.array_equal(images["none"].range, sample.range)
        assert np.array_equal(images["none"].labels, sample.labels)
        assert np.array_equal(kept["noise"], kept["none"])
        assert np.array_equal(kept["all"], kept["occ"] & kept["md"])
        assert np.array_equal(images["all"].range[kept["all"]], images["noise"].range[kept["all"]])
        for name in ("occ", "md"):
            assert np.array_equal(images[name].range[kept[name]], sample.range[kept[name]])
            removed[name] += int((kept["none"] & ~kept[name]).sum())
        assert images["all"].sigma_mm == images["noise"].sigma_mm
        assert images["all"].missing_rate == images["md"].missing_rate
        for image in images.values():
            # A pixel the variant removed has nothing to classify; all others keep their label.
            assert np.array_equal(image.labels, np.where(image.range > 0, sample.labels, BACKGROUND))
    assert removed["occ"] > 0
    assert removed["md"] > 0


def test_the_occluded_variant_is_the_shadow_test(figures_set: Path, clean: list[Sample]) -> None:
    test = ShadowTest(RangeImages(figures_set).manifest.rig)
    for sample in clean[:4]:
        lit = test.lit(sample.range, sample.projector_range, sample.faces_projector)
        assert np.array_equal(made(figures_set, sample)["occ"].range > 0, lit)


def test_draws_differ_by_epoch_seed_and_sample(figures_set: Path, clean: list[Sample]) -> None:
    first = made(figures_set, clean[0])["noise"].range
    assert np.array_equal(first, made(figures_set, clean[0])["noise"].range)
    assert not np.array_equal(first, made(figures_set, clean[0], epoch=1)["noise"].range)
    assert not np.array_equal(first, made(figures_set, clean[0], seed=1)["noise"].range)
    assert len({made(figures_set, sample)["noise"].sigma_mm for sample in clean}) == len(clean)


@given(sample=samples(), sigma=st.sampled_from([0.0, 100.0, 1000.0]), rate=st.sampled_from([0.0, 0.5, 1.0]))
def test_no_pixel_appears_vanishes_by_rounding_or_wraps_around(sample: Sample, sigma: float, rate: float) -> None:
    noisy = add_noise(sample.range[sample.range > 0], sigma, generator(0, 0, sample.key, "noise"))
    assert noisy.dtype == np.uint16
    assert (noisy > 0).all()
    if sigma == 0:
        assert np.array_equal(noisy, sample.range[sample.range > 0])
    change = noisy.astype(int) - sample.range[sample.range > 0]
    # Six sigma, in steps: a value that wrapped around would be off by up to 65536.
    assert (np.abs(change) <= sigma * 10 * 6).all()
    kept = kept_pixels(len(noisy), rate, generator(0, 0, sample.key, "missing data"))
    assert kept.all() == (rate == 0 or not len(noisy)) or 0 < rate < 1
    assert kept.any() == (rate < 1 and len(noisy) > 0) or 0 < rate < 1


@pytest.mark.parametrize("start", [1, 65535])
def test_noise_at_the_ends_of_16_bits_stays_within(start: int) -> None:
    noisy = add_noise(np.full(10_000, start, np.uint16), 100.0, generator(0, 0, "k", "noise"))
    assert noisy.min() >= 1
    assert np.count_nonzero(noisy == start) > 4_000, "half of the draws point outwards and stop at the end"
    assert np.abs(noisy.astype(int) - start).max() < 6_000


def test_noise_is_gaussian_with_the_drawn_sigma() -> None:
    count = 200_000
    noisy = add_noise(np.full(count, 25_000, np.uint16), 40.0, generator(0, 0, "k", "noise"))
    errors = (noisy.astype(float) - 25_000) / 10  # millimetres
    assert abs(errors.mean()) < 5 * 40 / np.sqrt(count)
    assert errors.std() == pytest.approx(40, rel=5 / np.sqrt(2 * count))
    within = [np.mean(np.abs(errors) < k * 40) for k in (1, 2, 3)]
    assert within == pytest.approx([0.6827, 0.9545, 0.9973], abs=0.005)
    assert abs(np.corrcoef(errors[1:], errors[:-1])[0, 1]) < 5 / np.sqrt(count)


def test_sigma_is_uniform_from_0_to_100_mm() -> None:
    drawn = np.sort([Noise().draw_sigma_mm(generator(0, 0, f"k{number}", "noise")) for number in range(2_000)])
    # Kolmogorov-Smirnov distance to the uniform law; 1.95 / sqrt(n) is exceeded once in a thousand.
    assert np.abs(drawn / 100 - (np.arange(2_000) + 0.5) / 2_000).max() < 1.95 / np.sqrt(2_000)


def test_missing_rates_are_0_5_and_50_percent_by_default() -> None:
    drawn = [MissingData().draw_rate(generator(0, 0, f"k{number}", "missing data")) for number in range(3_000)]
    for rate in (0.0, 0.05, 0.5):
        assert drawn.count(rate) == pytest.approx(1_000, abs=5 * np.sqrt(3_000 * 2 / 9))
    assert set(drawn) == {0.0, 0.05, 0.5}


def test_missing_rates_from_a_range_are_one_setting_away() -> None:
    settings = MissingData(between=(0.0, 0.5))
    drawn = [settings.draw_rate(generator(0, 0, f"k{number}", "missing data")) for number in range(1_000)]
    assert 0 <= min(drawn) < 0.01
    assert 0.49 < max(drawn) <= 0.5
    assert np.mean(drawn) == pytest.approx(0.25, abs=5 * 0.5 / np.sqrt(12 * 1_000))


@pytest.mark.parametrize("rate", [0.05, 0.5])
def test_pixels_are_lost_independently_at_the_drawn_rate(rate: float) -> None:
    count = 200_000
    lost = ~kept_pixels(count, rate, generator(0, 0, "k", "missing data"))
    assert lost.mean() == pytest.approx(rate, abs=5 * np.sqrt(rate * (1 - rate) / count))
    assert abs(np.corrcoef(lost[1:], lost[:-1])[0, 1]) < 5 / np.sqrt(count)


@pytest.mark.parametrize(
    ("kind", "options", "message"),
    [
        (Noise, {"low_mm": -1.0}, "0 <= low <= high <= 1000 mm, found low -1.0"),
        (Noise, {"low_mm": 50.0, "high_mm": 20.0}, "found low 50.0 and high 20.0"),
        (MissingData, {"rates": ()}, "shares from 0 to 1, found \\[\\]"),
        (MissingData, {"rates": (0.5, 50.0)}, "shares from 0 to 1, found \\[0.5, 50.0\\]"),
        (MissingData, {"between": (0.5, 0.1)}, "0 <= low <= high <= 1, found \\(0.5, 0.1\\)"),
    ],
)
def test_settings_that_make_no_sense_are_refused(kind: Any, options: dict[str, Any], message: str) -> None:
    with pytest.raises(BadConfig, match=message):
        kind(**options)


def _synthetic() -> tuple[Rig, Sample]:
    """A slope and a plate before it, by formula: nothing here depends on a renderer."""
    camera = Camera(24, 20, 40.0, (10.0, 12.0), (0.0, 0.0, 0.0), (0.0, 0.0, 2.0))
    projector = replace(camera, position_m=(-0.6, 0.0, 0.0))
    rows, columns = np.mgrid[:24, :20]
    plate = (rows >= 6) & (rows < 16) & (columns >= 4) & (columns < 10)
    ranges = np.where(plate, 14_000, 20_000 + 10 * rows).astype(np.uint16)
    ranges[:2] = 0
    seen = np.where((rows >= 6) & (rows < 16) & (columns >= 12) & (columns < 19), 15_000, 21_000).astype(np.uint16)
    labels = np.where(ranges == 0, BACKGROUND, (rows + columns) % 33).astype(np.uint8)
    info = SampleInfo("open", "A", "A", "posture-00", "standing", 215, 0, "train")
    facing = (ranges > 0) & (columns < 18)
    return Rig("small", 2.0, camera, projector), Sample("pinned", ranges, seen, labels, facing, info)


PINNED = {
    "none": "61bf1849b19ef709",
    "occ": "e729783d4a545aca",
    "noise": "c93d8fae3d0b55d8",
    "md": "1193e1daede92984",
    "all": "e439800a9896b9e5",
}


@pytest.mark.parametrize("name", VARIANTS)
def test_the_bits_of_every_variant_are_pinned(name: VariantName) -> None:
    """A set described by (shards, variant, seed, epoch) must stay what it was."""
    rig, sample = _synthetic()
    sample.check()
    images = [Augmentation(rig, name, seed=5)(replace(sample, key=f"pinned-{n}"), epoch=2) for n in range(4)]
    data = b"".join(image.range.astype("<u2").tobytes() + image.labels.tobytes() for image in images)
    assert hashlib.sha256(data).hexdigest()[:16] == PINNED[name]


def test_settings_reach_the_images(figures_set: Path, clean: list[Sample]) -> None:
    artifacts = Artifacts(Noise(10.0, 10.0), MissingData(rates=(1.0,)))
    images = made(figures_set, clean[0], artifacts=artifacts)
    assert images["noise"].sigma_mm == 10
    assert not images["md"].range.any()
    assert (images["md"].labels == BACKGROUND).all()
