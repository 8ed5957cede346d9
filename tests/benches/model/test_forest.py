"""The forest of depth differences, against a slow loop of the formula and against scikit-learn's own answers."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from benches.model.networks import architectures_forest as forests
from benches.model.networks.architectures_forest import (
    FAR_M,
    DepthForest,
    ForestScale,
    Trees,
    depth_differences,
    draw_offsets,
    fit_forest,
    from_sklearn,
    smoothed,
    walk,
)

from bodyseg_data.core.errors import BadConfig, MissingLibrary
from bodyseg_data.core.parts import BACKGROUND, PART_COUNT
from bodyseg_data.loading.range_images import RangeImages
from bodyseg_model.evaluation.scores import ConfusionMatrix
from bodyseg_model.networks.registry import predict

SMALL = ForestScale(images=6, candidates=30, tried=10, depth=12, window=3)


def scene() -> np.ndarray[Any, np.dtype[np.float32]]:
    """A relief with holes, beside background."""
    draws = np.random.default_rng(7)
    range_m = draws.uniform(1.5, 3.0, (23, 17)).astype(np.float32)
    range_m[draws.random(range_m.shape) < 0.3] = 0
    range_m[:4] = 0
    return range_m


def difference(range_m: Any, row: int, column: int, offset: Any) -> np.float32:
    """Equation (1) of Shotton et al., word by word."""

    def d(down: np.float32, right: np.float32) -> np.float32:
        here = range_m[row, column]
        y, x = row + math.floor(down / here + np.float32(0.5)), column + math.floor(right / here + np.float32(0.5))
        inside = 0 <= y < range_m.shape[0] and 0 <= x < range_m.shape[1]
        return np.float32(range_m[y, x]) if inside and range_m[y, x] > 0 else FAR_M

    return d(offset[0], offset[1]) - d(offset[2], offset[3])


def test_differences_are_those_of_the_formula() -> None:
    range_m, offsets = scene(), draw_offsets(ForestScale(candidates=40, tried=1, reach=30.0), 3)
    pixels = np.flatnonzero(range_m)
    found = depth_differences(range_m, pixels, offsets)
    slow = [[difference(range_m, *divmod(pixel, 17), offset) for offset in offsets] for pixel in pixels.tolist()]
    np.testing.assert_array_equal(found, np.array(slow, np.float32))
    assert (found > 5).any() and (found < -5).any() and (abs(found) < 2).any(), "holes and none, on either side"


def test_a_difference_by_hand() -> None:
    range_m = np.zeros((5, 5), np.float32)
    range_m[2, 2], range_m[2, 4], range_m[1, 2] = 2.0, 2.25, 1.5
    offsets = np.array([[0, 4, 0, 0], [-2, 0, 0, 4], [0, 6, 0, 0], [1, 0, 0, 0]], np.float32)
    # Two columns to the right; one row up against that; beyond the image; half a pixel down, which is one: nothing.
    expected = [[0.25, 1.5 - 2.25, FAR_M - 2, FAR_M - 2]]
    assert depth_differences(range_m, np.array([12]), offsets).tolist() == expected


def test_offsets_reach_everywhere_and_belong_to_the_seed() -> None:
    scale = ForestScale(candidates=400, reach=100.0)
    offsets = draw_offsets(scale, 1)
    assert offsets.shape == (400, 4) and offsets.dtype == np.float32
    assert not offsets[::2, 2:].any() and offsets[1::2, 2:].all()
    assert -100 <= offsets.min() < -95 and 95 < offsets.max() <= 100
    np.testing.assert_array_equal(offsets, draw_offsets(scale, 1))
    assert not np.array_equal(offsets, draw_offsets(scale, 2))


def test_holes_are_filled_by_what_is_around_them() -> None:
    range_m = scene()
    found = smoothed(range_m, 5)
    for row, column in np.ndindex(range_m.shape):
        around = range_m[max(0, row - 2) : row + 3, max(0, column - 2) : column + 3]
        expected = around[around > 0].mean() if around.any() else 0.0
        assert found[row, column] == pytest.approx(expected, rel=1e-5, abs=0)
    np.testing.assert_array_equal(smoothed(range_m, 1), range_m)


def sklearn_forest(pixels: Any, range_m: Any, offsets: Any) -> Any:
    ensemble = pytest.importorskip("sklearn.ensemble")
    labels = (pixels % 17 // 3 * 4 + (pixels // 17 > 12)).astype(np.uint8)  # not every part
    forest = ensemble.RandomForestClassifier(3, max_depth=6, random_state=0)
    return forest.fit(depth_differences(range_m, pixels, offsets), labels)


def test_trees_are_walked_as_scikit_learn_walks_them() -> None:
    range_m, offsets = scene(), draw_offsets(ForestScale(candidates=20, tried=1, reach=15.0), 0)
    pixels = np.flatnonzero(range_m)
    theirs = sklearn_forest(pixels, range_m, offsets)
    ours = from_sklearn(theirs, offsets)
    expected = np.zeros((len(pixels), PART_COUNT))
    expected[:, theirs.classes_] = theirs.predict_proba(depth_differences(range_m, pixels, offsets))
    plain = np.zeros((len(pixels), PART_COUNT), np.float32)
    walk(range_m, pixels, *ours.trees, FAR_M, plain)
    np.testing.assert_allclose(plain, expected, atol=1e-6)
    for threads in (1, 3):
        torch.set_num_threads(threads)
        np.testing.assert_array_equal(ours.probabilities(range_m, pixels), plain)
    splits = sum(tree.tree_.node_count - tree.tree_.n_leaves for tree in theirs.estimators_)
    leaves = sum(tree.tree_.n_leaves for tree in theirs.estimators_)
    assert ours.learned == 2 * splits + 33 * leaves


def test_it_answers_as_a_network() -> None:
    range_m, offsets = scene(), draw_offsets(ForestScale(candidates=20, tried=1, reach=15.0), 0)
    pixels = np.flatnonzero(range_m)
    forest = from_sklearn(sklearn_forest(pixels, range_m, offsets), offsets)
    both = torch.from_numpy(np.stack([range_m, np.zeros_like(range_m), range_m])[:, None])
    answer = predict(forest, both)
    shares = forest.probabilities(range_m, pixels)
    for image in (0, 2):
        np.testing.assert_array_equal(answer.labels[image].ravel()[pixels], shares.argmax(1))
        np.testing.assert_allclose(answer.confidence[image].ravel()[pixels], shares.max(1), rtol=1e-5)
    assert (answer.labels[1] == BACKGROUND).all() and (answer.labels[0].numpy() == BACKGROUND).sum() == range_m.size - (
        len(pixels)
    )
    with pytest.raises(BadConfig, match="range images must be"):
        forest(torch.zeros(1, 5, 5))


def test_pixels_are_spread_over_the_parts() -> None:
    labels = np.full((20, 30), BACKGROUND, np.uint8)
    labels[:10], labels[12:19], labels[19, :3] = 4, 31, 7
    chosen = forests._spread_over_parts(labels, 60, np.random.default_rng(0))
    assert np.array_equal(chosen, np.unique(chosen))
    parts, counts = np.unique(labels.ravel()[chosen], return_counts=True)
    assert dict(zip(parts.tolist(), counts.tolist(), strict=True)) == {4: 20, 7: 3, 31: 20}
    other = forests._spread_over_parts(labels, 60, np.random.default_rng(1))
    assert not np.array_equal(chosen, other)
    empty = np.full((3, 3), BACKGROUND, np.uint8)
    assert not len(forests._spread_over_parts(empty, 60, np.random.default_rng(0)))


def test_a_forest_learns_its_images(figures_set: Path) -> None:
    pytest.importorskip("sklearn")
    images, read = RangeImages(figures_set, "all", "train"), []
    forest = fit_forest(images, SMALL, progress=lambda *numbers: read.append(numbers))
    assert read == [(6, 6)]
    shown = images[int(images.order(0)[0])]
    labels = predict(forest, shown["range"][None]).labels[0]
    matrix = ConfusionMatrix()
    matrix.add(shown["labels"].numpy(), labels.numpy())
    assert matrix.average_per_class_accuracy() > 0.4, "a guess is right once in 33"
    again = fit_forest(images, SMALL)
    for first, second in zip(forest.trees, again.trees, strict=True):
        np.testing.assert_array_equal(first, second)
    assert not np.array_equal(forest.trees[0], fit_forest(images, SMALL, seed=1).trees[0])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"images": 0}, "images of a forest must be at least 1, found 0"),
        ({"depth": -1}, "depth of a forest must be at least 1, found -1"),
        ({"window": 4}, "window of a forest must be odd and at most 63, found 4"),
        ({"candidates": 5, "tried": 6}, "a forest has 5 candidates and cannot try 6 at each split"),
    ],
)
def test_scales_that_cannot_be(changes: dict[str, int], message: str) -> None:
    with pytest.raises(BadConfig, match=message):
        ForestScale(**changes)


def test_there_must_be_images_and_the_library(figures_set: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    images = RangeImages(figures_set, "all", "train")
    with pytest.raises(BadConfig, match="a forest of 17 training images needs as many, found 16"):
        fit_forest(images, ForestScale(images=17))

    def absent(name: str) -> Any:
        raise ImportError(f"no {name}")

    monkeypatch.setattr(forests, "import_module", absent)
    with pytest.raises(MissingLibrary, match=r"needs the package 'scikit-learn': pip install scikit-learn \(no skl"):
        fit_forest(images, SMALL)


def test_a_forest_has_nothing_to_train() -> None:
    trees = Trees(
        np.zeros((1, 4), np.float32),
        np.zeros(1),
        np.array([[-1, 0]], np.int32),
        np.full((1, PART_COUNT), 1 / PART_COUNT, np.float32),
        np.zeros(1, np.int32),
    )
    forest = DepthForest(trees)
    assert forest.learned == PART_COUNT and not list(forest.parameters())
    scores = forest(torch.ones(1, 1, 2, 3))
    assert scores.shape == (1, PART_COUNT, 2, 3)
    np.testing.assert_allclose(scores.numpy(), -math.log(PART_COUNT), rtol=1e-6)
