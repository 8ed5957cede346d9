"""What confidences are worth: calibration and risk-coverage, from counts whose size does not grow with the images.

Confidences are counted in steps of 1/1500 from 1 down to 0, the first step, where most pixels lie, in 1500 steps of its
own. Every number here but the area under the risk-coverage curve is exact; for that one, pixels of one step are taken
to be in random order.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.parts import PART_COUNT
from bodyseg_model.evaluation.scores import PAIRS

STEPS: Final = 1500
FINER: Final = 1500
CELLS: Final = FINER + STEPS - 1
ECE_BINS: Final = 15
THRESHOLD_STEPS: Final = 30
"""Thresholds are multiples of 1/30, at which counts are kept part by part: 50, 60, 70, 80, 90 % are among them."""

_ROUNDING: Final = 1e-4  # softmax and interpolation may end up as far above 1

_TRUTH, _PREDICTED = np.divmod(np.arange(PAIRS), PART_COUNT)
_WRONG: Final = (_TRUTH != _PREDICTED).astype(np.int64)
_FIRST_PLACE: Final = (2 * _TRUTH + _WRONG) * THRESHOLD_STEPS
"""Pair number -> whether it is wrong, and where its counts by part begin."""


@dataclass(frozen=True)
class ConfidentPixels:
    """What is left when unsure pixels are dropped: their share, and how much of it is right.

    average_per_class_accuracy: over the parts of which pixels are left.
    """

    share: float
    pixel_accuracy: float
    average_per_class_accuracy: float


@dataclass(frozen=True)
class Reliability:
    """The pixels of one of 15 bins of confidence; means are NaN in an empty one."""

    above: float
    up_to: float
    pixels: int
    confidence: float
    accuracy: float


class Confidences:
    """Counts pixels by confidence and by whether they are right.

    counts: int64 [2, CELLS], right and wrong, the surest first; sums: float64 [CELLS], of confidences;
    by_part: int64 [33, 2, 30], by true part, right and wrong, and step of 1/30, the surest first.
    """

    def __init__(self) -> None:
        self.counts: NDArray[np.int64] = np.zeros((2, CELLS), np.int64)
        self.sums: NDArray[np.float64] = np.zeros(CELLS)
        self.by_part: NDArray[np.int64] = np.zeros((PART_COUNT, 2, THRESHOLD_STEPS), np.int64)

    def add(self, pairs: NDArray[np.int64], confidence: NDArray[np.float32]) -> None:
        """Count pixels by their pair numbers, int64 [N] (`scores.pairs_of`), and confidences, float32 [N], 0 to 1.

        Raises BadConfig for confidences that are none.
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
        cell += CELLS * _WRONG.take(pairs)
        self.counts += np.bincount(cell, minlength=2 * CELLS).reshape(2, CELLS)
        step //= STEPS // THRESHOLD_STEPS
        step += _FIRST_PLACE.take(pairs)
        self.by_part += np.bincount(step, minlength=self.by_part.size).reshape(self.by_part.shape)

    def merge(self, other: Confidences) -> None:
        """Count all of another one's pixels."""
        self.counts += other.counts
        self.sums += other.sums
        self.by_part += other.by_part

    @property
    def pixels(self) -> int:
        """How many pixels were counted."""
        return int(self.counts.sum())

    def mean(self) -> float:
        """Mean confidence, NaN if nothing was counted."""
        return float(self.sums.sum()) / self.pixels if self.pixels else float("nan")

    def reliability(self) -> list[Reliability]:
        """Confidence and accuracy in 15 bins of equal width, open below and closed above, the lowest first."""
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
        """Area under the risk-coverage curve: mean over k of the share of wrong pixels among the k surest.

        Geifman, Uziel and El-Yaniv, "Bias-reduced uncertainty estimation for deep neural classifiers", ICLR 2019.
        NaN if nothing was counted.
        """
        if not self.pixels:
            return float("nan")
        inside = self.counts.sum(axis=0)
        held = inside > 0
        inside, wrong = inside[held].astype(np.float64), self.counts[1][held].astype(np.float64)
        before, wrong_before = np.cumsum(inside) - inside, np.cumsum(wrong) - wrong
        # Within a step wrong pixels are spread evenly: the integral of (E + rho t) / (N + t) for t from 0 to its size.
        rho = wrong / inside
        grown = np.log1p(np.divide(inside, before, out=np.zeros_like(inside), where=before > 0))
        return float((wrong + (wrong_before - rho * before) * grown).sum()) / self.pixels

    def curve(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Coverage and risk wherever a step ends, float64 [M] each: share of pixels kept, and share of these wrong."""
        inside = self.counts.sum(axis=0)
        held = inside > 0
        kept = np.cumsum(inside[held])
        return kept / max(self.pixels, 1), np.cumsum(self.counts[1][held]) / kept

    def above(self, threshold: float) -> ConfidentPixels:
        """What is left when only pixels of more confidence than `threshold` are kept.

        Raises BadConfig unless the threshold is a multiple of 1/30 from 0 to below 1.
        """
        scaled = (1 - threshold) * THRESHOLD_STEPS
        steps = round(scaled) if 0.5 < scaled <= THRESHOLD_STEPS else 0  # 0 for NaN
        if not steps or abs(scaled - steps) > 1e-6:
            raise BadConfig(f"a threshold must be a multiple of 1/30 from 0 to below 1, found {threshold:g}")
        right, wrong = self.by_part[:, :, :steps].sum(axis=2).T
        kept = right + wrong
        if not kept.any():
            return ConfidentPixels(0.0 if self.pixels else float("nan"), float("nan"), float("nan"))
        shown = kept > 0
        average = float((right[shown] / kept[shown]).mean())
        return ConfidentPixels(float(kept.sum() / self.pixels), float(right.sum() / kept.sum()), average)
