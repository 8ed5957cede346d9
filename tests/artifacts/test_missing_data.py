"""Missing data against the binomial law; streams are fixed, so a test passes always or never."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from bodyseg_data.artifacts import MissingData
from bodyseg_data.artifacts.missing_data import kept_pixels, threshold
from bodyseg_data.core import BadConfig, Draws

SIGMAS = 5.0
SIDE = 400


def lost(key: str, rate: float, count: int = SIDE * SIDE) -> NDArray[np.bool_]:
    return ~kept_pixels(rate, Draws(0, 0, key).pixels("missing data", count, np.uint16))


def rates(settings: MissingData, count: int) -> list[float]:
    return [settings.draw(Draws(0, 0, f"k{number}"))["missing_rate"] for number in range(count)]


@pytest.mark.parametrize("rate", [0.0, 2**-17, 0.05, 1 / 3, 0.5, 1 - 2**-17, 1.0])
def test_exactly_the_nearest_share_of_all_draws_loses_a_pixel(rate: float) -> None:
    kept = kept_pixels(rate, np.arange(65_536, dtype=np.uint16))
    assert np.count_nonzero(~kept) == threshold(rate)
    assert abs(threshold(rate) / 65_536 - rate) <= 2**-17


@pytest.mark.parametrize("rate", [0.0, 1.0])
def test_none_and_all_mean_none_and_all(rate: float) -> None:
    assert (lost("k", rate) == bool(rate)).all()


@pytest.mark.parametrize("rate", [0.001, 0.05, 0.5, 0.95])
def test_counts_follow_the_binomial_law(rate: float) -> None:
    images, pixels = 400, 10_000
    counts = np.array([lost(f"count-{number}", rate, pixels).sum() for number in range(images)])
    share = threshold(rate) / 65_536
    low, high = stats.binom.interval(1 - 1e-5, images * pixels, share)
    assert low <= counts.sum() <= high
    # The spread between images: chi-square, so pixels that are lost together, or a fixed count, would show.
    spread = ((counts - pixels * share) ** 2).sum() / (pixels * share * (1 - share))
    assert stats.chi2.ppf(1e-5, images) < spread < stats.chi2.ppf(1 - 1e-5, images)


@pytest.mark.parametrize("rate", [0.05, 0.5])
def test_neighbouring_pixels_are_lost_independently(rate: float) -> None:
    image = lost("neighbours", rate).reshape(SIDE, SIDE)
    for shift in range(1, 9):
        for axis in (0, 1):
            here, there = (np.delete(image, np.s_[part], axis) for part in (slice(0, shift), slice(SIDE - shift, None)))
            assert abs(np.corrcoef(here.ravel(), there.ravel())[0, 1]) < SIGMAS / SIDE, f"{shift} along {axis}"
    for axis in (0, 1):
        spread = image.sum(axis).var() / (SIDE * image.mean() * (1 - image.mean()))
        assert spread == pytest.approx(1, abs=SIGMAS * np.sqrt(2 / SIDE)), "rows and columns lose alike"


def test_runs_of_lost_pixels_are_as_long_as_chance_makes_them() -> None:
    image = lost("runs", 0.5, 1_000_000)
    lengths = np.diff(np.flatnonzero(np.diff(image.astype(np.int8))))
    found = np.bincount(np.minimum(lengths, 12), minlength=13)[1:]
    expected = len(lengths) * np.array([*0.5 ** np.arange(1, 12), 0.5**11])
    assert stats.chi2.sf(((found - expected) ** 2 / expected).sum(), 11) > 1e-5


def test_samples_epochs_and_seeds_lose_other_pixels() -> None:
    def of(*identity: Any) -> NDArray[np.bool_]:
        return kept_pixels(0.5, Draws(*identity).pixels("missing data", SIDE * SIDE, np.uint16))

    first = of(0, 0, "a")
    for identity in ((0, 0, "b"), (0, 1, "a"), (1, 0, "a"), (1, 1, "a")):
        assert np.mean(of(*identity) == first) == pytest.approx(0.5, abs=SIGMAS * 0.5 / SIDE), identity


def test_rates_are_0_5_and_50_percent_by_default_each_as_likely() -> None:
    drawn = rates(MissingData(), 6_000)
    assert set(drawn) == {0.0, 0.05, 0.5}
    counts = [drawn.count(rate) for rate in (0.0, 0.05, 0.5)]
    assert stats.chisquare(counts).pvalue > 1e-5


def test_other_rates_are_drawn_evenly_too(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = rates(MissingData(rates=tuple(number / 7 for number in range(7))), 7_000)
    assert stats.chisquare([drawn.count(number / 7) for number in range(7)]).pvalue > 1e-5
    monkeypatch.setattr(Draws, "chance", lambda *_: 1 - 2**-53)
    assert MissingData(rates=(0.1, 0.2)).draw(Draws(0, 0, "k")) == {"missing_rate": 0.2}


def test_rates_from_a_range_are_one_setting_away() -> None:
    drawn = np.sort(rates(MissingData(between=(0.1, 0.5)), 4_000))
    assert 0.1 <= drawn[0] < 0.1 + 0.4 * 15 / 4_000
    assert 0.5 - 0.4 * 15 / 4_000 < drawn[-1] < 0.5
    places = 0.1 + 0.4 * (np.arange(4_000) + 0.5) / 4_000
    assert np.abs(drawn - places).max() / 0.4 < 2.5 / np.sqrt(4_000)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rates": ()}, "must have one rate at least, found none"),
        ({"rates": (0.5, 50.0)}, "rates must be from 0 to 1, found \\(0.5, 50.0\\)"),
        ({"rates": (float("nan"),)}, "rates must be from 0 to 1, found \\(nan,\\)"),
        ({"between": (0.5, 0.1)}, "with low <= high, found \\(0.5, 0.1\\)"),
        ({"between": (0.1, 0.5), "rates": (0.2,)}, "rates or between, not both, found \\(0.2,\\) and \\(0.1, 0.5\\)"),
    ],
)
def test_settings_that_make_no_sense_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(BadConfig, match=message):
        MissingData(**options)
