"""Mixed pixels lie between two surfaces whose ranges are exact."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from kernel_forms import by_both
from planes import RIG, sample_of, shown

from bodyseg_data.artifacts import RangeImage, Scene
from bodyseg_data.artifacts.mixed_pixels import MixedPixels
from bodyseg_data.core import BadConfig, Draws


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


def test_each_image_draws_its_share_and_its_background() -> None:
    z = np.zeros((200, 160))
    z[10:190, 40:120] = 2.0
    samples = [sample_of(z, f"k{number}") for number in range(60)]

    def mixed(artifact: MixedPixels) -> tuple[list[int], list[int]]:
        images = [shown(artifact, each).range for each in samples]
        return [int((image > 20_000).sum()) for image in images], [int(image.max()) for image in images]

    edge = 2 * (180 + 80) - 4
    counts, _ = mixed(MixedPixels(1.0, 4.0, least=0.0))
    assert min(counts) < 0.1 * edge and max(counts) > 0.9 * edge and np.mean(counts) == pytest.approx(edge / 2, rel=0.2)
    assert min(mixed(MixedPixels(1.0, 4.0, least=0.5))[0]) > 0.4 * edge
    counts, farthest = mixed(MixedPixels(1.0, 4.0, nearest_m=1.0))
    behind = [reach for count, reach in zip(counts, farthest, strict=True) if count]
    assert counts.count(0) == pytest.approx(20, abs=12), "a wall nearer than the body is not behind it"
    assert set(counts) <= {0, edge - 1, edge} and min(behind) < 24_000 and 36_000 < max(behind) < 40_000


def test_nothing_and_lost_pixels_stay_nothing() -> None:
    z = np.zeros((200, 160))
    assert not shown(MixedPixels(1.0), sample_of(z)).range.any()
    z[100, 80] = 6.5535
    assert shown(MixedPixels(1.0), sample_of(z)).range.max() > 50_000


def test_both_forms_agree_at_borders_at_extremes_and_where_pixels_are_lost() -> None:
    draws = np.random.default_rng(3)
    sample = sample_of(draws.choice([0, 1e-4, 2e-4, 2.0, 6.5535], (200, 160)))
    before = sample.range * (draws.random((200, 160)) < 0.8)

    def mixed() -> Any:
        image = RangeImage(sample.key, before.copy(), sample.labels.copy(), {})
        MixedPixels(1.0, 10.0, 0.1).apply(image, Scene(sample, RIG), Draws(0, 0, "k"))
        return image.range

    loops, plain = by_both(mixed)
    np.testing.assert_array_equal(loops, plain)
    assert not loops[before == 0].any() and (loops == 65_535).any()


@pytest.mark.parametrize(
    ("strengths", "message"),
    [
        ({"share": 1.1}, "MixedPixels: share must be from 0 to 1, found 1.1"),
        ({"background_m": 0.0}, "background_m must be above 0 and at most 100, found 0.0"),
        ({"least": 0.6}, "least must be at most share, found 0.6 and 0.5"),
        ({"nearest_m": 2.0}, "nearest_m must be at most background_m, found 2.0 and None"),
        ({"nearest_m": 2.0, "background_m": 1.0}, "found 2.0 and 1.0"),
        ({"jump_mm": 0.0}, "jump_mm must be above 0 and at most 10000, found 0.0"),
    ],
)
def test_strengths_out_of_range_are_one_line(strengths: dict[str, Any], message: str) -> None:
    with pytest.raises(BadConfig, match=message):
        MixedPixels(**strengths)
