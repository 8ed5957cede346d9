"""The projector's coarse range: the same shadows, whatever the scene."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from small_rig import SMALL

from bodyseg_data.artifacts import ShadowTest
from bodyseg_data.packing import occluders as coarsening
from bodyseg_data.packing.occluders import COARSEST_STEP, coarsened

SHAPE = (24, 18)
STEPS_MM = 0.1, 0.3, 1.0, 2.0, 10.0
TESTS = {step_mm: ShadowTest(replace(SMALL, range_step_mm=step_mm)) for step_mm in STEPS_MM}
TEST = TESTS[0.1]


def scene(number: int, test: ShadowTest = TEST) -> tuple[NDArray[np.uint16], Any, Any, Any]:
    """Surfaces at several depths, steep and flat, with holes; points on, before and behind them, some at thresholds."""
    gap, edge = int(test.gap_steps), int(test.edge_steps)
    generator = np.random.default_rng(number)
    rows, columns = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]]
    slope, depth = generator.integers(-gap // 2, gap // 2 + (gap < 60), 2), generator.integers(15_000, 30_000)
    image = depth + slope[0] * rows + slope[1] * columns
    near = (rows - 12) ** 2 + (columns - 8) ** 2 < generator.integers(9, 90)
    image = np.where(
        near, image - generator.choice((gap + gap // 6, 150 * gap // 60, edge + 50 * gap // 60, 2000, 9000)), image
    )
    image = np.where(generator.random(SHAPE) < 0.2, 0, image) if number % 2 else image
    count = 300
    x = generator.uniform(-0.5, SHAPE[1] - 0.51, count).astype(np.float32)
    y = generator.uniform(-0.5, SHAPE[0] - 0.51, count).astype(np.float32)
    near_gap, near_edge = (gap - 1, gap, gap + 1, gap + 2), (edge - 1, edge, edge + 1)
    behind = generator.choice((-50, 0, gap // 2, *near_gap, 150 * gap // 60, *near_edge, edge + gap, 2000, 9100), count)
    under = image[np.clip(np.rint(y), 0, 23).astype(int), np.clip(np.rint(x), 0, 17).astype(int)]
    away = (np.where(under > 0, under, depth) + behind + generator.choice((0, 0.5), count)).astype(np.float32)
    return image.astype(np.uint16), x, y, away


@pytest.mark.parametrize("number", range(30))
def test_light_reaches_the_same_points(number: int) -> None:
    image, *points = scene(number)
    coarse = coarsened(TEST, image, *points)
    assert np.array_equal(TEST.reached(coarse, *points), TEST.reached(image, *points))
    assert not coarse[image == 0].any(), "nothing is put where nothing was"
    assert (coarse[coarse > 0] % 8 == 0).mean() > 0.5, "rounded"


@pytest.mark.parametrize("step_mm", STEPS_MM[1:])
@pytest.mark.parametrize("number", range(6))
def test_light_reaches_the_same_points_in_other_steps(number: int, step_mm: float) -> None:
    test = TESTS[step_mm]
    image, *points = scene(number, test)
    coarse = coarsened(test, image, *points)
    assert np.array_equal(test.reached(coarse, *points), test.reached(image, *points))
    assert not coarse[image == 0].any() and np.count_nonzero(coarse) < np.count_nonzero(image)


@pytest.mark.parametrize("step_mm", STEPS_MM)
@pytest.mark.parametrize("number", range(20))
def test_texels_anywhere_within_their_bounds_give_the_same_answers(number: int, step_mm: float) -> None:
    """So the bounds alone prove it, and the question asked afterwards is never needed."""
    test = TESTS[step_mm]
    image, x, y, away = scene(number, test)
    texels = coarsening.texel_indices(image.shape, x, y)
    answers = test.reached(image, x, y, away)
    lowest, highest = coarsening.texel_bounds(test, image, texels, (x, y, away), answers)
    assert (lowest <= highest).all()
    generator = np.random.default_rng(number)
    for _ in range(20):
        part = generator.choice((0, 1, generator.random(lowest.shape).mean()), lowest.shape)
        other = np.where(highest < 65535, lowest + np.rint(part * (highest - lowest)) + 1, 0)
        other = other.astype(np.uint16).reshape(SHAPE)
        assert np.array_equal(test.reached(other, x, y, away), answers)


def test_ranges_become_as_round_as_they_may() -> None:
    """One point, deep in the shadow of a plane: its four texels may be anything up to 2 cm before it."""
    image = np.full(SHAPE, 20_123, np.uint16)
    point = np.array([3.3], np.float32), np.array([5.5], np.float32), np.array([29_000], np.float32)
    coarse = coarsened(TEST, image, *point)
    assert np.flatnonzero(coarse).tolist() == [5 * 18 + 3, 5 * 18 + 4, 6 * 18 + 3, 6 * 18 + 4]
    assert set(coarse[coarse > 0].tolist()) == {round(20_123 / COARSEST_STEP) * COARSEST_STEP}


def test_what_shades_nothing_is_not_kept() -> None:
    image = np.full(SHAPE, 20_000, np.uint16)
    point = np.array([3.3], np.float32), np.array([5.5], np.float32), np.array([20_050], np.float32)
    assert not coarsened(TEST, image, *point).any()


@pytest.mark.parametrize("number", range(5))
def test_were_the_bounds_wrong_exact_ranges_would_come_back(number: int, monkeypatch: pytest.MonkeyPatch) -> None:
    image, *points = scene(number)

    def wrong(*_: object) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        return np.full(image.size, 999, np.int32), np.full(image.size, 999, np.int32)

    monkeypatch.setattr(coarsening, "texel_bounds", wrong)
    coarse = coarsened(TEST, image, *points)
    assert np.array_equal(TEST.reached(coarse, *points), TEST.reached(image, *points))
    assert (coarse == 1000).any() and (coarse == image).any()
