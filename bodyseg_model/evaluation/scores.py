"""Accuracy and IoU of a segmentation, from one integer confusion matrix; background is ignored everywhere."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.parts import BACKGROUND, PART_COUNT

PAIRS: Final = PART_COUNT**2
"""Number of pairs (true part, predicted part); the pair number is 33 truth + prediction."""


def pairs_of(truth: NDArray[np.uint8], predicted: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Pair number of every pixel whose true label is a part, int64 [N], in reading order.

    truth, predicted: label images of one shape, uint8. Raises BadConfig for different shapes, a label above 32 in the
    prediction on the body, or one in the truth that is neither 0..32 nor background.
    """
    if truth.shape != predicted.shape:
        raise BadConfig(f"truth and prediction must have one shape, found {truth.shape} and {predicted.shape}")
    where = np.flatnonzero(truth != BACKGROUND)
    rows, columns = truth.ravel().take(where), predicted.ravel().take(where)
    for name, labels in (("truth", rows), ("prediction", columns)):
        if labels.size and (labels.min() < 0 or labels.max() >= PART_COUNT):
            raise BadConfig(f"labels must be 0 to {PART_COUNT - 1}, found {labels.max()} in the {name}")
    return rows.astype(np.int64) * PART_COUNT + columns


def count_pairs(pairs: NDArray[np.int64]) -> NDArray[np.int64]:
    """Count each pair number, int64 [33, 33], row truth, column prediction."""
    return np.bincount(pairs, minlength=PAIRS).reshape(PART_COUNT, PART_COUNT)


class ConfusionMatrix:
    """Counts of pixels by true and predicted part. counts: int64 [33, 33], row truth, column prediction."""

    def __init__(self) -> None:
        self.counts: NDArray[np.int64] = np.zeros((PART_COUNT, PART_COUNT), np.int64)

    def __repr__(self) -> str:
        accuracy = self.average_per_class_accuracy()
        return f"ConfusionMatrix({self.pixels} pixels, average per-class accuracy {accuracy:.3f})"

    def add(self, truth: NDArray[np.uint8], predicted: NDArray[np.uint8]) -> None:
        """Count the pixels of label images of one shape, uint8; pixels whose truth is background do not count.

        Raises BadConfig as `pairs_of`.
        """
        self.counts += count_pairs(pairs_of(truth, predicted))

    @property
    def pixels(self) -> int:
        """Number of pixels counted."""
        return int(self.counts.sum())

    def per_class_accuracy(self) -> NDArray[np.float64]:
        """TP / (TP + FN) of every part, float64 [33]; NaN for a part that the truth never shows."""
        return _ratios(self.counts.diagonal(), self.counts.sum(axis=1))

    def average_per_class_accuracy(self) -> float:
        """Mean of `per_class_accuracy` over the parts that the truth shows, so that all parts count equally.

        The paper's headline score (section 3.6, after Shotton et al. 2011). NaN if nothing was counted.
        """
        return _mean(self.per_class_accuracy())

    def pixel_accuracy(self) -> float:
        """Share of pixels whose predicted part is right. NaN if nothing was counted."""
        return float(self.counts.trace()) / self.pixels if self.pixels else float("nan")

    def intersection_over_union(self) -> NDArray[np.float64]:
        """TP / (TP + FP + FN) of every part, float64 [33]; NaN for one that neither truth nor prediction shows."""
        right = self.counts.diagonal()
        return _ratios(right, self.counts.sum(axis=0) + self.counts.sum(axis=1) - right)

    def mean_iou(self) -> float:
        """Mean of `intersection_over_union` over the parts shown by truth or prediction. NaN if there are none."""
        return _mean(self.intersection_over_union())


class PerImageAccuracy:
    """Mean and standard deviation of accuracy over images; every image counts once, however many pixels it has.

    Entries 0..32 are of the parts, over the images that show them; entry 33 is of the average per-class accuracy, over
    images that show any part. images: int64 [34], number; sums, squares: float64 [34], of accuracies.
    """

    def __init__(self) -> None:
        self.images: NDArray[np.int64] = np.zeros(PART_COUNT + 1, np.int64)
        self.sums: NDArray[np.float64] = np.zeros(PART_COUNT + 1)
        self.squares: NDArray[np.float64] = np.zeros(PART_COUNT + 1)

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
        """Mean over images, float64 [34]; NaN where there is none."""
        return _ratios(self.sums, self.images)

    def deviation(self) -> NDArray[np.float64]:
        """Standard deviation over images, divisor n - 1, float64 [34]; NaN for fewer than two."""
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
