"""Calibration of confidences and risk-coverage, from counts whose size does not grow with the number of images.

Confidences are counted in bins of 1/1500 from 1 down to 0; the first bin, which has most pixels, is divided into 1500
finer ones. Every score here is exact, except that the area under the risk-coverage curve assumes pixels of one bin to
be in random order.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.parts import PART_COUNT

STEPS: Final = 1500
FINER: Final = 1500
CELLS: Final = FINER + STEPS - 1
ECE_BINS: Final = 15
THRESHOLD_STEPS: Final = 30
"""Counts by class are kept in bins of 1/30, so thresholds are multiples of it: 50, 60, 70, 80, 90 % are among them."""

_ROUNDING: Final = 1e-4  # softmax and interpolation may exceed 1 by as much


@dataclass(frozen=True)
class ConfidentPixels:
    """Pixels above a threshold of confidence: their share of all, and their accuracy.

    average_per_class_accuracy: over the classes that have such pixels.
    """

    share_of_pixels: float
    pixel_accuracy: float
    average_per_class_accuracy: float


@dataclass(frozen=True)
class Reliability:
    """One of 15 bins of confidence. confidence, accuracy: means over its pixels, NaN in an empty bin."""

    confidence_above: float
    up_to: float
    pixels: int
    confidence: float
    accuracy: float


class Confidences:
    """Counts of right and wrong pixels by confidence.

    counts: int64 [2, CELLS], row 0 right, row 1 wrong, most confident first; sums: float64 [CELLS], of confidences;
    by_class: int64 [C, 2, 30], by true class, right or wrong, and bin of 1/30, most confident first.
    """

    def __init__(self, classes: int = PART_COUNT) -> None:
        truth, predicted = np.divmod(np.arange(classes**2), classes)
        # Pair number -> 1 if it is wrong, and the flat index of its first bin in `by_class`.
        self._wrong = (truth != predicted).astype(np.int64)
        self._first_bin = (2 * truth + self._wrong) * THRESHOLD_STEPS
        self.counts: NDArray[np.int64] = np.zeros((2, CELLS), np.int64)
        self.sums: NDArray[np.float64] = np.zeros(CELLS)
        self.by_class: NDArray[np.int64] = np.zeros((classes, 2, THRESHOLD_STEPS), np.int64)

    def __repr__(self) -> str:
        return f"Confidences({self.pixels} pixels, mean {self.mean():.3f})"

    def add(self, pairs: NDArray[np.int64], confidence: NDArray[np.float32]) -> None:
        """Count pixels by their pair numbers, int64 [N] (`scores.pairs_of`), and confidences, float32 [N], 0 to 1.

        Raises BadConfig for confidences outside 0 to 1.
        """
        if not pairs.size:
            return
        least, most = float(confidence.min()), float(confidence.max())
        if not (least >= -_ROUNDING and most <= 1 + _ROUNDING):  # also for NaN
            raise BadConfig(f"confidences must be 0 to 1, found {least:g} to {most:g}")
        scaled = np.clip(np.float32(1) - confidence, 0, 1) * np.float32(STEPS)
        step = np.minimum(scaled.astype(np.int64), STEPS - 1)
        cell = np.where(step == 0, (scaled * np.float32(FINER)).astype(np.int64), step + (FINER - 1))
        self.sums += np.bincount(cell, confidence, CELLS)
        cell += CELLS * self._wrong.take(pairs)
        self.counts += np.bincount(cell, minlength=2 * CELLS).reshape(2, CELLS)
        step //= STEPS // THRESHOLD_STEPS
        step += self._first_bin.take(pairs)
        self.by_class += np.bincount(step, minlength=self.by_class.size).reshape(self.by_class.shape)

    def merge(self, other: Confidences) -> None:
        """Add the counts of other pixels."""
        self.counts += other.counts
        self.sums += other.sums
        self.by_class += other.by_class

    @property
    def pixels(self) -> int:
        """Number of pixels counted."""
        return int(self.counts.sum())

    def mean(self) -> float:
        """Mean confidence; NaN if nothing was counted."""
        return float(self.sums.sum()) / self.pixels if self.pixels else float("nan")

    def reliability(self) -> list[Reliability]:
        """Confidence and accuracy in 15 bins of equal width, open below and closed above, lowest first."""
        width = STEPS // ECE_BINS
        starts = [0, *(FINER - 1 + width * number for number in range(1, ECE_BINS))]
        right, wrong = np.add.reduceat(self.counts, starts, axis=1)
        sums = np.add.reduceat(self.sums, starts)
        rows = []
        for number in reversed(range(ECE_BINS)):
            pixels = int(right[number] + wrong[number])
            above = 1 - (number + 1) / ECE_BINS
            means = (sums[number] / pixels, right[number] / pixels) if pixels else (float("nan"), float("nan"))
            rows.append(Reliability(above, above + 1 / ECE_BINS, pixels, float(means[0]), float(means[1])))
        return rows

    def ece(self) -> float:
        """Expected calibration error: mean over pixels of |confidence - accuracy| of their bin, 15 uniform bins.

        Guo et al., "On calibration of modern neural networks", ICML 2017, equation 3. NaN if nothing was counted.
        """
        if not self.pixels:
            return float("nan")
        gaps = sum(row.pixels * abs(row.confidence - row.accuracy) for row in self.reliability() if row.pixels)
        return float(gaps / self.pixels)

    def aurc(self) -> float:
        """Area under the risk-coverage curve: mean over k of the share of wrong pixels among the k most confident.

        Geifman, Uziel and El-Yaniv, "Bias-reduced uncertainty estimation for deep neural classifiers", ICLR 2019.
        NaN if nothing was counted.
        """
        if not self.pixels:
            return float("nan")
        inside = self.counts.sum(axis=0)
        filled = inside > 0
        inside, wrong = inside[filled].astype(np.float64), self.counts[1][filled].astype(np.float64)
        before, wrong_before = np.cumsum(inside) - inside, np.cumsum(wrong) - wrong
        # Wrong pixels are uniform within a bin: the integral of (E + rho t) / (N + t) for t from 0 to the bin's size.
        rho = wrong / inside
        grown = np.log1p(np.divide(inside, before, out=np.zeros_like(inside), where=before > 0))
        return float((wrong + (wrong_before - rho * before) * grown).sum()) / self.pixels

    def curve(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Coverage and risk at the end of every bin, float64 [M] each: share of pixels kept, and of these wrong."""
        inside = self.counts.sum(axis=0)
        filled = inside > 0
        kept = np.cumsum(inside[filled])
        return kept / max(self.pixels, 1), np.cumsum(self.counts[1][filled]) / kept

    def above(self, threshold: float) -> ConfidentPixels:
        """Share and accuracy of the pixels whose confidence is above `threshold`.

        Raises BadConfig unless the threshold is a multiple of 1/30 from 0 to below 1.
        """
        scaled = (1 - threshold) * THRESHOLD_STEPS
        steps = round(scaled) if 0.5 < scaled <= THRESHOLD_STEPS else 0  # 0 for NaN
        if not steps or abs(scaled - steps) > 1e-6:
            raise BadConfig(f"a threshold must be a multiple of 1/30 from 0 to below 1, found {threshold:g}")
        right, wrong = self.by_class[:, :, :steps].sum(axis=2).T
        kept = right + wrong
        if not kept.any():
            return ConfidentPixels(0.0 if self.pixels else float("nan"), float("nan"), float("nan"))
        shown = kept > 0
        average = float((right[shown] / kept[shown]).mean())
        return ConfidentPixels(float(kept.sum() / self.pixels), float(right.sum() / kept.sum()), average)
