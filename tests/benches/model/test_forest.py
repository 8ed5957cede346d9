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
    ForestScale,
    depth_differences,
    draw_offsets,
    fit_forest,
    from_sklearn,
    walk,
)

from bodyseg_data.core import BadConfig, MissingLibrary
from bodyseg_data.labels import PART_COUNT
from bodyseg_data.loading import RangeImages
from bodyseg_model.evaluation import ConfusionMatrix
from bodyseg_model.networks import predict

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


def test_a_forest_learns_its_images(figures_set: Path) -> None:
    pytest.importorskip("sklearn")
    images = RangeImages(figures_set, "all", "train")
    forest = fit_forest(images, SMALL)
    shown = images[int(images.order(0)[0])]
    labels = predict(forest, shown["range"][None]).labels[0]
    matrix = ConfusionMatrix()
    matrix.add(shown["labels"].numpy(), labels.numpy())
    assert matrix.average_per_class_accuracy() > 0.4, "a guess is right once in 33"
    again = fit_forest(images, SMALL)
    for first, second in zip(forest.trees, again.trees, strict=True):
        np.testing.assert_array_equal(first, second)
    assert not np.array_equal(forest.trees[0], fit_forest(images, SMALL, seed=1).trees[0])


def test_there_must_be_images_and_the_library(figures_set: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    images = RangeImages(figures_set, "all", "train")
    with pytest.raises(BadConfig, match="a forest of 17 training images needs as many, found 16"):
        fit_forest(images, ForestScale(images=17))

    def absent(name: str) -> Any:
        raise ImportError(f"no {name}")

    monkeypatch.setattr(forests, "import_module", absent)
    with pytest.raises(MissingLibrary, match=r"needs the package 'scikit-learn': pip install scikit-learn \(no skl"):
        fit_forest(images, SMALL)
