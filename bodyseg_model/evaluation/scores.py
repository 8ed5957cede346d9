"""Accuracy and IoU of a segmentation, from one integer confusion matrix; background is ignored everywhere."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.parts import BACKGROUND, PART_COUNT


def pairs_of(truth: NDArray[np.uint8], predicted: NDArray[np.uint8], classes: int = PART_COUNT) -> NDArray[np.int64]:
    """Pair number, `classes` truth + prediction, of every pixel whose true label is a class: int64 [N], reading order.

    truth, predicted: label images of one shape, uint8. classes: their number, C. Raises BadConfig for different shapes,
    a label of C or more in the prediction on the body, or one in the truth that is neither below C nor background.
    """
    if truth.shape != predicted.shape:
        raise BadConfig(f"truth and prediction must have one shape, found {truth.shape} and {predicted.shape}")
    where = np.flatnonzero(truth != BACKGROUND)
    rows, columns = truth.ravel().take(where), predicted.ravel().take(where)
    for name, labels in (("truth", rows), ("prediction", columns)):
        if labels.size and (labels.min() < 0 or labels.max() >= classes):
            raise BadConfig(f"labels must be 0 to {classes - 1}, found {labels.max()} in the {name}")
    return rows.astype(np.int64) * classes + columns


def count_pairs(pairs: NDArray[np.int64], classes: int = PART_COUNT) -> NDArray[np.int64]:
    """Count each pair number of C classes, int64 [C, C], row truth, column prediction."""
    return np.bincount(pairs, minlength=classes**2).reshape(classes, classes)


class ConfusionMatrix:
    """Counts of pixels by true and predicted class. counts: int64 [C, C], row truth, column prediction.

    classes: their number C, by default of the 33 parts.
    """

    def __init__(self, classes: int = PART_COUNT) -> None:
        self.counts: NDArray[np.int64] = np.zeros((classes, classes), np.int64)

    def __repr__(self) -> str:
        accuracy = self.average_per_class_accuracy()
        return f"ConfusionMatrix({self.pixels} pixels, average per-class accuracy {accuracy:.3f})"

    def add(self, truth: NDArray[np.uint8], predicted: NDArray[np.uint8]) -> None:
        """Count the pixels of label images of one shape, uint8; pixels whose truth is background do not count.

        Raises BadConfig as `pairs_of`.
        """
        classes = len(self.counts)
        self.counts += count_pairs(pairs_of(truth, predicted, classes), classes)

    @property
    def pixels(self) -> int:
        """Number of pixels counted."""
        return int(self.counts.sum())

    def per_class_accuracy(self) -> NDArray[np.float64]:
        """TP / (TP + FN) of every class, float64 [C]; NaN for a class that the truth never shows."""
        return _ratios(self.counts.diagonal(), self.counts.sum(axis=1))

    def average_per_class_accuracy(self) -> float:
        """Mean of `per_class_accuracy` over the classes that the truth shows, so that all count equally.

        The paper's headline score (section 3.6, after Shotton et al. 2011). NaN if nothing was counted.
        """
        return _mean(self.per_class_accuracy())

    def pixel_accuracy(self) -> float:
        """Share of pixels whose predicted class is right. NaN if nothing was counted."""
        return float(self.counts.trace()) / self.pixels if self.pixels else float("nan")

    def intersection_over_union(self) -> NDArray[np.float64]:
        """TP / (TP + FP + FN) of every class, float64 [C]; NaN for one that neither truth nor prediction shows."""
        right = self.counts.diagonal()
        return _ratios(right, self.counts.sum(axis=0) + self.counts.sum(axis=1) - right)

    def mean_iou(self) -> float:
        """Mean of `intersection_over_union` over the classes shown by truth or prediction. NaN if there are none."""
        return _mean(self.intersection_over_union())


class PerImageAccuracy:
    """Mean and standard deviation of accuracy over images; every image counts once, however many pixels it has.

    Entries 0 to C - 1 are of the classes, over the images that show them; entry C is of the average per-class accuracy,
    over images that show any class. images: int64 [C + 1], number; sums, squares: float64 [C + 1], of accuracies.
    """

    def __init__(self, classes: int = PART_COUNT) -> None:
        self.images: NDArray[np.int64] = np.zeros(classes + 1, np.int64)
        self.sums: NDArray[np.float64] = np.zeros(classes + 1)
        self.squares: NDArray[np.float64] = np.zeros(classes + 1)

    def __repr__(self) -> str:
        return f"PerImageAccuracy({self.images[-1]} images, mean {self.mean()[-1]:.3f})"

    def add(self, counts: NDArray[np.int64]) -> float:
        """Add one image by its confusion matrix; returns its average per-class accuracy, NaN if it shows nothing."""
        accuracy = _ratios(counts.diagonal(), counts.sum(axis=1))
        average = _mean(accuracy)
        values = np.append(accuracy, average)
        shown = ~np.isnan(values)
        values = np.where(shown, values, 0.0)
        self.images += shown
        self.sums += values
        self.squares += values**2
        return average

    def merge(self, other: PerImageAccuracy) -> None:
        """Add other images."""
        self.images += other.images
        self.sums += other.sums
        self.squares += other.squares

    def mean(self) -> NDArray[np.float64]:
        """Mean over images, float64 [C + 1]; NaN where there is none."""
        return _ratios(self.sums, self.images)

    def deviation(self) -> NDArray[np.float64]:
        """Standard deviation over images, divisor n - 1, float64 [C + 1]; NaN for fewer than two."""
        squares = np.maximum(self.squares - self.images * np.nan_to_num(self.mean()) ** 2, 0.0)
        found: NDArray[np.float64] = np.sqrt(_ratios(squares, np.maximum(self.images - 1, 0)))
        return found


def _ratios(part: NDArray[Any], whole: NDArray[np.int64]) -> NDArray[np.float64]:
    """Quotients, float64, NaN where `whole` is 0."""
    shares = np.full(whole.shape, np.nan)
    np.divide(part, whole, out=shares, where=whole > 0)
    return shares


def _mean(values: NDArray[np.float64]) -> float:
    """Mean of the values that are not NaN; NaN if there are none."""
    shown = values[~np.isnan(values)]
    return float(shown.mean()) if shown.size else float("nan")
