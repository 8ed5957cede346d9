"""Scores of a segmentation, from one integer confusion matrix; background is ignored everywhere."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.errors import BadConfig
from bodyseg_data.parts import BACKGROUND, PART_COUNT


class ConfusionMatrix:
    """Counts pixels by true and predicted part. `counts`: int64 [33, 33], row truth, column prediction."""

    def __init__(self) -> None:
        self.counts: NDArray[np.int64] = np.zeros((PART_COUNT, PART_COUNT), np.int64)

    def add(self, truth: NDArray[np.uint8], predicted: NDArray[np.uint8]) -> None:
        """Count the pixels of label images of one shape, uint8; pixels whose truth is background do not count.

        A prediction must name a part at every pixel of the body: raises BadConfig for shapes that differ or labels that
        are neither 0..32 nor, for the truth, background.
        """
        if truth.shape != predicted.shape:
            raise BadConfig(f"truth and prediction must have one shape, found {truth.shape} and {predicted.shape}")
        foreground = truth != BACKGROUND
        rows, columns = truth[foreground].astype(np.int64), predicted[foreground].astype(np.int64)
        for name, labels in (("truth", rows), ("prediction", columns)):
            if labels.size and (labels.min() < 0 or labels.max() >= PART_COUNT):
                raise BadConfig(f"labels must be 0 to {PART_COUNT - 1}, found {labels.max()} in the {name}")
        flat = np.bincount(rows * PART_COUNT + columns, minlength=PART_COUNT**2)
        self.counts += flat.reshape(PART_COUNT, PART_COUNT)

    def per_class_accuracy(self) -> NDArray[np.float64]:
        """TP / (TP + FN) of every part, float64 [33]; NaN for a part that the truth never shows."""
        total = self.counts.sum(axis=1)
        shown = total > 0
        accuracy = np.full(PART_COUNT, np.nan)
        accuracy[shown] = self.counts.diagonal()[shown] / total[shown]
        return accuracy

    def average_per_class_accuracy(self) -> float:
        """Mean of `per_class_accuracy` over the parts that the truth shows, so that small parts weigh as much as large.

        The paper's headline score (section 3.6, after Shotton et al. 2011). NaN if nothing was counted.
        """
        accuracy = self.per_class_accuracy()
        shown = accuracy[~np.isnan(accuracy)]
        return float(shown.mean()) if shown.size else float("nan")
