from __future__ import annotations

import numpy as np
import pytest

from bodyseg_data.errors import BadConfig
from bodyseg_data.parts import BACKGROUND
from bodyseg_model.scores import ConfusionMatrix


def image(*labels: int) -> np.ndarray:
    return np.array([labels], np.uint8)


def test_small_parts_weigh_as_much_as_large_ones() -> None:
    matrix = ConfusionMatrix()
    matrix.add(image(0, 0, 0, 0, 7, 7, BACKGROUND), image(0, 0, 0, 7, 7, 0, 3))
    assert matrix.counts[0].tolist()[:8] == [3, 0, 0, 0, 0, 0, 0, 1]
    assert matrix.counts.sum() == 6, "background does not count"
    assert matrix.per_class_accuracy()[[0, 7]].tolist() == [0.75, 0.5]
    assert np.isnan(matrix.per_class_accuracy()[1])
    assert matrix.average_per_class_accuracy() == (0.75 + 0.5) / 2


def test_images_add_up_to_one_matrix() -> None:
    generator = np.random.default_rng(0)
    truth, predicted = (generator.integers(0, 33, (4, 50, 40)).astype(np.uint8) for _ in range(2))
    truth[generator.random(truth.shape) < 0.3] = BACKGROUND
    piecewise, whole = ConfusionMatrix(), ConfusionMatrix()
    for one, other in zip(truth, predicted, strict=True):
        piecewise.add(one, other)
    whole.add(truth, predicted)
    assert np.array_equal(piecewise.counts, whole.counts)
    expected = [np.mean(predicted[truth == label] == label) for label in range(33)]
    assert whole.per_class_accuracy() == pytest.approx(expected)


def test_nothing_counted_is_no_score() -> None:
    matrix = ConfusionMatrix()
    matrix.add(image(BACKGROUND), image(0))
    assert np.isnan(matrix.average_per_class_accuracy())


def test_images_that_do_not_fit_are_refused() -> None:
    with pytest.raises(BadConfig, match="one shape"):
        ConfusionMatrix().add(image(0, 1), image(0))
    with pytest.raises(BadConfig, match="found 255 in the prediction"):
        ConfusionMatrix().add(image(0), image(255))
    with pytest.raises(BadConfig, match="found 40 in the truth"):
        ConfusionMatrix().add(image(40), image(0))
