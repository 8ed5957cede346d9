from __future__ import annotations

import numpy as np
import pytest

from bodyseg_data.core import BadConfig
from bodyseg_data.labels import BACKGROUND
from bodyseg_model.evaluation import ConfusionMatrix, Evaluation, Scores, count_pairs, pairs_of
from bodyseg_model.evaluation.scores import PerImageAccuracy


def image(*labels: int) -> np.ndarray:
    return np.array([labels], np.uint8)


def test_small_parts_weigh_as_much_as_large_ones() -> None:
    matrix = ConfusionMatrix()
    matrix.add(image(0, 0, 0, 0, 7, 7, BACKGROUND), image(0, 0, 0, 7, 7, 0, 3))
    assert matrix.counts[0].tolist()[:8] == [3, 0, 0, 0, 0, 0, 0, 1]
    assert matrix.pixels == 6, "background does not count"
    assert matrix.per_class_accuracy()[[0, 7]].tolist() == [0.75, 0.5]
    assert np.isnan(matrix.per_class_accuracy()[1])
    assert matrix.average_per_class_accuracy() == (0.75 + 0.5) / 2
    assert matrix.pixel_accuracy() == 4 / 6


def test_intersection_over_union_also_counts_parts_that_are_only_predicted() -> None:
    matrix = ConfusionMatrix()
    matrix.add(image(0, 0, 0, 0, 7, 7), image(0, 0, 0, 7, 7, 5))
    assert matrix.intersection_over_union()[[0, 5, 7]].tolist() == [3 / 4, 0, 1 / 3]
    assert matrix.mean_iou() == pytest.approx((3 / 4 + 0 + 1 / 3) / 3)
    assert matrix.average_per_class_accuracy() == (0.75 + 0.5) / 2, "part 5 has no pixel that could be right"


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
    union = [np.sum((truth == label) | ((predicted == label) & (truth != BACKGROUND))) for label in range(33)]
    right = [np.sum((truth == label) & (predicted == label)) for label in range(33)]
    assert whole.intersection_over_union() == pytest.approx(np.divide(right, union))


def test_nothing_counted_is_no_score() -> None:
    matrix = ConfusionMatrix()
    matrix.add(image(BACKGROUND), image(0))
    assert np.isnan(matrix.average_per_class_accuracy())
    assert np.isnan(matrix.pixel_accuracy())
    assert np.isnan(matrix.mean_iou())


@pytest.mark.parametrize(
    ("truth", "predicted", "message"),
    [
        (image(0, 1), image(0), r"must have one shape, found \(1, 2\) and \(1, 1\)"),
        (image(0, 33), image(0, 1), "labels must be 0 to 32, found 33 in the truth"),
        (image(0, 1), image(0, BACKGROUND), "labels must be 0 to 32, found 255 in the prediction"),
        (image(0, 1), np.array([[2, -1]]), "labels must be 0 to 32, found -1 in the prediction"),
    ],
)
def test_what_is_no_label_is_refused(truth: np.ndarray, predicted: np.ndarray, message: str) -> None:
    with pytest.raises(BadConfig, match=message):
        ConfusionMatrix().add(truth, predicted)


def test_spread_counts_every_image_once() -> None:
    images = [
        (image(0, 0, 0, 0, 7, 7), image(0, 0, 0, 1, 7, 0)),  # part 0: 0.75, part 7: 0.5
        (image(0, 0), image(0, 1)),  # part 0: 0.5
        (image(BACKGROUND), image(BACKGROUND)),
    ]
    spread, rest = PerImageAccuracy(), PerImageAccuracy()
    averages = [
        part.add(count_pairs(pairs_of(truth, predicted)))
        for part, (truth, predicted) in zip((spread, rest, rest), images, strict=True)
    ]
    spread.merge(rest)
    assert averages[:2] == [0.625, 0.5]
    assert np.isnan(averages[2])
    assert spread.images[[0, 1, 7, 33]].tolist() == [2, 0, 1, 2]
    assert spread.mean()[[0, 7, 33]].tolist() == [0.625, 0.5, 0.5625]
    assert spread.deviation()[[0, 33]] == pytest.approx([np.std([0.75, 0.5], ddof=1), np.std([0.625, 0.5], ddof=1)])
    assert np.isnan(spread.mean()[1])
    assert np.isnan(spread.deviation()[[1, 7]]).all(), "one image has no deviation"
    for _ in range(3):  # of accuracy 0.8, whose squares are rounded below
        spread.add(count_pairs(pairs_of(image(*[9] * 5), image(9, 9, 9, 9, 2))))
    assert spread.deviation()[9] == 0


def test_counts_print_in_one_line() -> None:
    matrix, scores = ConfusionMatrix(), Scores()
    matrix.add(np.array([[0, 1, 1]], np.uint8), np.array([[0, 1, 2]], np.uint8))
    assert repr(matrix) == "ConfusionMatrix(3 pixels, average per-class accuracy 0.750)"
    scores.confusion.counts += matrix.counts
    assert repr(scores) == f"Scores(0 images, {matrix!r})"
    assert repr(Evaluation(subsets={"A": scores})) == f"Evaluation(subsets={{'A': {scores!r}}})"
