"""The noise's normals against the exact distribution, and the noise of images against one another.

Streams are fixed, so a test passes always or never. Its bounds are those that a right generator would cross once in
some hundred thousand streams.
"""

from __future__ import annotations

import hashlib
from statistics import NormalDist

import numpy as np
import pytest
from numpy.typing import NDArray
from samples import body_info
from scipy import stats

from bodyseg_data.artifacts import Augmentation, MissingData, Noise, VariantName, load_sensor_model
from bodyseg_data.artifacts.constants import SEGMENTS
from bodyseg_data.artifacts.missing_data import kept_pixels
from bodyseg_data.artifacts.noise import add_noise, normals, steps_of
from bodyseg_data.core import BadConfig, Draws
from bodyseg_data.labels import BACKGROUND
from bodyseg_data.rigs import Camera, Rig
from bodyseg_data.samples import Sample

SIGMAS = 5.0
"""How many of its own standard deviations an estimate may be off: once in 1.7 million."""

SIDE = 300
INFO = body_info()
CAMERA = Camera(SIDE, SIDE, 300.0, (150.0, 150.0), (0.0, 0.0, 0.0), (0.0, 0.0, 2.5))


def noise_of(key: str, count: int) -> NDArray[np.float32]:
    return normals(Draws(0, 0, key).pixels("noise", count, np.uint32))


def exact(codes: NDArray[np.integer]) -> NDArray[np.float64]:
    """What the highest bit and the 31 others of a draw stand for."""
    size = np.array([-NormalDist().inv_cdf((int(code & 0x7FFFFFFF) + 0.5) / 2**32) for code in codes])
    return np.where(codes >> 31, size, -size)


def test_normals_are_the_inverse_distribution_function_to_a_millionth_in_the_farthest_tails_too() -> None:
    draws = np.random.default_rng(0)
    codes = [np.arange(3000), 2**31 - 1 - np.arange(3000), (2.0 ** draws.uniform(0, 31, 40_000)).astype(np.int64)]
    codes += [draws.integers(0, 2**32, 40_000), 2 ** np.arange(31), 2 ** np.arange(1, 32) - 1]
    every = np.concatenate([*codes, np.concatenate(codes) ^ (1 << 31)])
    found = normals(every.astype(np.uint32))
    assert found.dtype == np.float32
    assert np.abs(found - exact(every)).max() < 2e-6
    assert found.max() == -found.min() == pytest.approx(6.33795, abs=1e-5)


def test_normals_never_turn_back_and_are_symmetric() -> None:
    codes = np.unique(np.concatenate([np.arange(20_000), np.arange(0, 2**31, 4099)])).astype(np.uint32)
    assert (np.diff(normals(codes)) >= 0).all()
    assert np.array_equal(normals(codes), -normals(codes | np.uint32(1 << 31)))


def test_the_bits_of_normals_are_pinned() -> None:
    assert hashlib.sha256(SEGMENTS.astype("<f4").tobytes()).hexdigest()[:16] == "10977080b3c4be63"
    assert normals(np.array([2720071503, 2556194740, 1398818602], np.uint32)).tolist() == [
        1.1108522415161133,
        1.3096303939819336,
        -0.451851487159729,
    ]


def test_moments_are_those_of_a_normal() -> None:
    count = 4_000_000
    found = noise_of("moments", count).astype(np.float64)
    for power, expected, variance in ((1, 0, 1), (2, 1, 2), (3, 0, 15), (4, 3, 96)):
        assert abs(np.mean(found**power) - expected) < SIGMAS * np.sqrt(variance / count), f"moment {power}"


def test_tails_hold_what_they_should() -> None:
    pieces, each = 20, 1_000_000
    counts = {(side, bound): 0 for side in (-1, 1) for bound in (2, 3, 4, 5)}
    for piece in range(pieces):
        found = noise_of(f"tails-{piece}", each)
        for side, bound in counts:
            counts[side, bound] += int(np.count_nonzero(found * side > bound))
    for (side, bound), count in counts.items():
        low, high = stats.binom.interval(1 - 1e-4, pieces * each, stats.norm.sf(bound))
        assert low <= count <= high, f"{count} beyond {side * bound} sigma"
    low, high = stats.binom.interval(1 - 1e-4, pieces * each, 2 * stats.norm.sf(5))
    assert 1 <= low <= counts[-1, 5] + counts[1, 5] <= high, "a law cut off at 5 sigma would have none"


@pytest.mark.parametrize("sigma_mm", [0.02, 0.1, 1.0, 40.0, 100.0])
def test_rounded_noise_follows_the_exact_law(sigma_mm: float) -> None:
    """Kolmogorov's distance, steps included: P(change <= n) is the normal's at n + 1/2 steps."""
    count = 1_000_000
    draws = Draws(0, 0, f"law-{sigma_mm}").pixels("noise", count, np.uint32)
    change = add_noise(np.full(count, 25_000, np.uint16), steps_of(sigma_mm, 1e-4), draws).astype(int) - 25_000
    values, counts = np.unique(change, return_counts=True)
    expected = stats.norm.cdf((values + 0.5) / float(steps_of(sigma_mm, 1e-4)))
    below = np.cumsum(counts) / count
    assert np.abs(below - expected).max() < 2.5 / np.sqrt(count)  # once in 130 000


def test_noise_rounds_to_the_nearest_step() -> None:
    draws = Draws(0, 0, "round").pixels("noise", 50_000, np.uint32)
    noisy = add_noise(np.full(50_000, 30_000, np.uint16), np.float32(3), draws)
    assert np.abs(noisy - (30_000 + normals(draws).astype(np.float64) * 3)).max() <= 0.5 + 4e-3  # float32 at 30 000


@pytest.mark.parametrize("start", [1, 65_535])
def test_noise_at_the_ends_of_16_bits_stays_within(start: int) -> None:
    draws = Draws(0, 0, "k").pixels("noise", 10_000, np.uint32)
    noisy = add_noise(np.full(10_000, start, np.uint16), np.float32(1000), draws)
    assert noisy.min() >= 1
    assert np.count_nonzero(noisy == start) > 4_000, "half of the draws point outwards and stop at the end"
    assert np.abs(noisy.astype(int) - start).max() < 6_500


@pytest.mark.parametrize("step_mm", [0.1, 0.5, 1.0, 4.0])
@pytest.mark.usefixtures("either_form")
def test_sigma_is_in_millimetres_whatever_the_step(step_mm: float) -> None:
    """Rounding adds a uniform error: its variance is a twelfth of the step's square."""
    sigma_mm, at = 40.0, round(2500 / step_mm)
    wall_in_steps, full = np.full((SIDE, SIDE), at, np.uint16), np.ones((SIDE, SIDE), np.bool_)
    sample = Sample("a", wall_in_steps, wall_in_steps, np.zeros((SIDE, SIDE), np.uint8), full, INFO)
    rig = Rig("wall", 2.5, CAMERA, CAMERA, range_step_mm=step_mm)
    fixed = load_sensor_model().with_artifacts(Noise(sigma_mm, sigma_mm))
    made = Augmentation(rig, "noise", 0, fixed)(sample, 0)
    change_mm = (made.range.astype(np.float64) - at) * step_mm
    expected = np.sqrt(sigma_mm**2 + step_mm**2 / 12)
    assert np.std(change_mm) == pytest.approx(expected, rel=SIGMAS / np.sqrt(2) / SIDE)
    assert abs(change_mm.mean()) < SIGMAS * expected / SIDE
    exact = normals(Draws(0, 0, "a").pixels("noise", SIDE * SIDE, np.uint32)) * sigma_mm
    assert np.abs(change_mm.ravel() - exact).max() <= step_mm / 2 + 1e-3


def test_noise_of_no_strength_changes_nothing() -> None:
    ranges = np.arange(1, 65_536, dtype=np.uint16)
    draws = Draws(0, 0, "k").pixels("noise", 65_535, np.uint32)
    assert np.array_equal(add_noise(ranges, np.float32(0), draws), ranges)


def test_sigma_is_uniform_from_0_to_100_mm() -> None:
    drawn = np.sort([Noise().draw(Draws(0, 0, f"k{number}"))["sigma_mm"] for number in range(5_000)])
    places = (np.arange(5_000) + 0.5) / 5_000
    assert np.abs(drawn / 100 - places).max() < 2.5 / np.sqrt(5_000)
    assert 0 <= drawn[0] < 100 * 15 / 5_000
    assert 100 - 100 * 15 / 5_000 < drawn[-1] < 100
    draws = Draws(0, 0, "k")
    assert Noise(20.0, 30.0).draw(draws) == {"sigma_mm": 20 + 10 * draws.chance("sigma")}


def wall() -> NDArray[np.uint16]:
    return np.full((SIDE, SIDE), 25_000, np.uint16)


def image(key: str = "a", epoch: int = 0, seed: int = 0, variant: VariantName = "noise") -> NDArray[np.float64]:
    """The change of a flat wall, as an image of steps; NaN where pixels are lost."""
    full = np.ones((SIDE, SIDE), np.bool_)
    sample = Sample(key, wall(), wall(), np.zeros((SIDE, SIDE), np.uint8), full, INFO)
    strengths = load_sensor_model().with_artifacts(Noise(40.0, 40.0), MissingData(rates=(0.5,)))
    made = Augmentation(Rig("wall", 2.5, CAMERA, CAMERA), variant, seed, strengths)(sample, epoch)
    assert np.array_equal(made.labels == BACKGROUND, made.range == 0)
    return np.where(made.range > 0, made.range.astype(np.float64) - 25_000, np.nan)


def correlation(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    return float(np.corrcoef(a.ravel(), b.ravel())[0, 1])


def test_neighbouring_pixels_are_independent() -> None:
    change = image()
    bound = SIGMAS / SIDE
    for down in range(4):
        for across in range(-3, 4):
            if (down, across) > (0, 0):
                left, right = max(0, -across), SIDE - max(0, across)
                here, there = change[: SIDE - down, left:right], change[down:, left + across : right + across]
                assert abs(correlation(here, there)) < bound, f"{down} down, {across} across"
                assert abs(correlation(here**2, there**2)) < bound, f"sizes, {down} down, {across} across"


def test_every_row_and_column_has_noise_of_its_own() -> None:
    change = image() / float(steps_of(40.0, 1e-4))
    for axis in (0, 1):
        # Means of 300 independent normals: variance 1/300, itself known to a factor of 1 +- sqrt(2/300).
        assert np.var(change.mean(axis=axis)) * SIDE == pytest.approx(1, abs=SIGMAS * np.sqrt(2 / SIDE))
        assert np.mean(change.var(axis=axis, ddof=1)) == pytest.approx(1, abs=SIGMAS * np.sqrt(2) / SIDE)


def test_samples_epochs_and_seeds_are_independent() -> None:
    first = image()
    others = {
        "key": image(key="b"),
        "longer key": image(key="aa"),
        "epoch": image(epoch=1),
        "seed": image(seed=1),
        "seed and epoch": image(seed=1, epoch=1),
        "far epoch": image(epoch=2**32),
    }
    for name, other in others.items():
        assert abs(correlation(first, other)) < SIGMAS / SIDE, name
        # Shifted copies, the whole way round, too: one stream begun at another place would show.
        spectrum = np.fft.rfft(first.ravel()) * np.conj(np.fft.rfft(other.ravel()))
        shifted = np.fft.irfft(spectrum, SIDE * SIDE) / np.sqrt((first**2).sum() * (other**2).sum())
        assert np.abs(shifted).max() < 6.5 / SIDE, name  # 90 000 of them: once in 140 000


def test_noise_and_missing_data_are_independent() -> None:
    change, lost = image(), np.isnan(image(variant="md"))
    assert abs(correlation(change, lost)) < SIGMAS / SIDE
    assert abs(correlation(np.abs(change), lost)) < SIGMAS / SIDE
    # The noise's words would lose other pixels than the missing data's do: half of them agree by chance.
    words = Draws(0, 0, "a").pixels("noise", SIDE * SIDE, np.uint16)
    assert np.mean(kept_pixels(0.5, words) == ~lost.ravel()) == pytest.approx(0.5, abs=SIGMAS * 0.5 / SIDE)


def test_how_strong_noise_is_says_nothing_about_how_much_is_lost() -> None:
    count, rig = 2_000, Rig("dot", 2.5, *[Camera(1, 1, 1.0, (0.5, 0.5), (0.0, 0.0, 0.0), (0.0, 0.0, 2.5))] * 2)
    augmentation = Augmentation(rig, "all", sensor=load_sensor_model().with_artifacts(MissingData(between=(0.0, 1.0))))
    dot = np.ones((1, 1), np.uint16)
    drawn = [
        augmentation(Sample(f"k{number}", dot, dot, np.zeros((1, 1), np.uint8), dot > 0, INFO))
        for number in range(count)
    ]
    sigma, rate = ([image.drawn[name] for image in drawn] for name in ("sigma_mm", "missing_rate"))
    assert abs(np.corrcoef(sigma, rate)[0, 1]) < SIGMAS / np.sqrt(count)


@pytest.mark.parametrize(("low", "high"), [(-1.0, 100.0), (50.0, 20.0), (0.0, 1001.0), (float("nan"), 1.0)])
def test_settings_that_make_no_sense_are_refused(low: float, high: float) -> None:
    with pytest.raises(BadConfig, match="from 0 to 1000, found|low_mm must be at most high_mm, found 50.0"):
        Noise(low, high)
