"""Scores of a segmentation from counts: accuracy, kinds of mistakes, confidences. Background is ignored everywhere."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig
from bodyseg_data.labels import BACKGROUND, PART_CLASSES, PART_COUNT, PARTS, PARTS33, LabelMap


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
            found = labels.min() if labels.min() < 0 else labels.max()
            raise BadConfig(f"labels must be 0 to {classes - 1}, found {found} in the {name}")
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
        """Count pixels of label images of one shape, uint8, without true background. Raises BadConfig as `pairs_of`."""
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
        return np.sqrt(_ratios(squares, self.images - 1))


def _ratios(part: NDArray[Any], whole: NDArray[np.int64]) -> NDArray[np.float64]:
    """Quotients, float64, NaN where `whole` is not above 0."""
    shares = np.full(whole.shape, np.nan)
    np.divide(part, whole, out=shares, where=whole > 0)
    return shares


def _mean(values: NDArray[np.float64]) -> float:
    """Mean of the values that are not NaN; NaN if there are none."""
    shown = values[~np.isnan(values)]
    return float(shown.mean()) if shown.size else float("nan")


STEPS: Final = 1500
FINER: Final = 1500
CELLS: Final = FINER + STEPS - 1
"""Bins of confidence: `STEPS` of equal width, the most confident, which most pixels are in, divided into `FINER`."""
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
        # For each number of a pair (truth, predicted): 1 if it is wrong; the flat index of its first bin in `by_class`.
        self._wrong = (truth != predicted).astype(np.int64)
        self._first_bin = (2 * truth + self._wrong) * THRESHOLD_STEPS
        self.counts: NDArray[np.int64] = np.zeros((2, CELLS), np.int64)
        self.sums: NDArray[np.float64] = np.zeros(CELLS)
        self.by_class: NDArray[np.int64] = np.zeros((classes, 2, THRESHOLD_STEPS), np.int64)

    def add(self, pairs: NDArray[np.int64], confidence: NDArray[np.float32]) -> None:
        """Count pairs, int64 [N] (`scores.pairs_of`), by confidence, float32 [N]. Raises BadConfig outside 0 to 1."""
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
        pixels = right + wrong
        means = _ratios(np.add.reduceat(self.sums, starts), pixels).tolist(), _ratios(right, pixels).tolist()
        above = [1 - (number + 1) / ECE_BINS for number in range(ECE_BINS)]
        ends = above, [low + 1 / ECE_BINS for low in above]
        return [Reliability(*row) for row in zip(*ends, pixels.tolist(), *means, strict=True)][::-1]

    def ece(self) -> float:
        """Expected calibration error: mean over pixels of |confidence - accuracy| of their bin, 15 uniform bins.

        Guo et al., "On calibration of modern neural networks", ICML 2017, equation 3. NaN if nothing was counted.
        """
        gaps = sum(row.pixels * abs(row.confidence - row.accuracy) for row in self.reliability() if row.pixels)
        return gaps / (self.pixels or float("nan"))

    def aurc(self) -> float:
        """Area under the risk-coverage curve: mean over k of the share of wrong pixels among the k most confident.

        Geifman, Uziel and El-Yaniv, "Bias-reduced uncertainty estimation for deep neural classifiers", ICLR 2019.
        NaN if nothing was counted.
        """
        inside = self.counts.sum(axis=0)
        filled = inside > 0
        inside, wrong = inside[filled].astype(np.float64), self.counts[1][filled].astype(np.float64)
        before, wrong_before = np.cumsum(inside) - inside, np.cumsum(wrong) - wrong
        # Wrong pixels are uniform within a bin: the integral of (E + rho t) / (N + t) for t from 0 to the bin's size.
        rho = wrong / inside
        grown = np.log1p(np.divide(inside, before, out=np.zeros_like(inside), where=before > 0))
        return float((wrong + (wrong_before - rho * before) * grown).sum()) / (self.pixels or float("nan"))

    def curve(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Coverage and risk at the end of every bin, float64 [M] each: share of pixels kept, and of these wrong."""
        inside = self.counts.sum(axis=0)
        filled = inside > 0
        kept = np.cumsum(inside[filled])
        return kept / self.pixels, np.cumsum(self.counts[1][filled]) / kept

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
        share, accuracy = kept.sum() / (self.pixels or np.nan), right.sum() / (kept.sum() or np.nan)
        return ConfidentPixels(float(share), float(accuracy), _mean(_ratios(right, kept)))


REGIONS: Final[dict[str, tuple[str, ...]]] = {
    "head": ("Sellion", "Nuchale", "Supramenton"),
    "trunk": (
        "Suprasternale",
        "Thelion/Bustpoint",
        "Substernale",
        "ASIS",
        "Cervicale",
        "10th Rib Midspine",
        "PSIS",
        "Axilla, Post.",
    ),
    "knees": ("Femoral Lateral Epicn", "Knee Crease"),
}
"""Region -> landmarks of its front and back parts, without "Lt." and "Rt."."""

KINDS: Final = ("right", "left/right", "front/back", "both", "other")
"""Kinds of predictions; a kind's number is its index here. "other" is any other mistake."""

SWAPS: Final = KINDS[1:4]


@lru_cache(maxsize=16)
def kinds_of(label_map: LabelMap) -> NDArray[np.uint8]:
    """Kind's number of every pair of classes, uint8 [C, C], row truth, column prediction; not to be written to."""
    labels = range(len(label_map))
    kinds = [[KINDS.index(_kind(label_map, truth, predicted)) for predicted in labels] for truth in labels]
    found = np.array(kinds, np.uint8)
    found.setflags(write=False)
    return found


def _kind(label_map: LabelMap, truth: int, predicted: int) -> str:
    if truth == predicted:
        return "right"
    if label_map.has_mirror_image and label_map.mirrored[truth] == predicted:
        return "left/right"
    if label_map.of != PART_CLASSES:
        return "other"
    true_parts, predicted_parts = ([PARTS[part] for part in label_map.members[label]] for label in (truth, predicted))
    names = {part.landmark.removeprefix("Rt. ").removeprefix("Lt. ") for part in (*true_parts, *predicted_parts)}
    faces = [{part.face for part in parts} for parts in (true_parts, predicted_parts)]
    if any(names <= {*region} for region in REGIONS.values()) and faces in _OPPOSITE:
        sides = [{part.side for part in parts} for parts in (true_parts, predicted_parts)]
        return "both" if sides in ([{"left"}, {"right"}], [{"right"}, {"left"}]) else "front/back"
    return "other"


_OPPOSITE: Final = ([{"front"}, {"back"}], [{"back"}, {"front"}])


def count_kinds(confusion: NDArray[np.int64], label_map: LabelMap = PARTS33) -> dict[str, int]:
    """Pixels of each kind that the classes can tell in a confusion matrix, int64 [C, C]."""
    counts = np.bincount(kinds_of(label_map).ravel(), confusion.ravel(), len(KINDS))
    told = told_kinds(label_map)
    return {kind: int(count) for kind, count in zip(KINDS, counts, strict=True) if kind in told}


def told_kinds(label_map: LabelMap) -> frozenset[str]:
    """Kinds that a prediction of these classes can have: joined front and back parts are no mistake any more."""
    return frozenset(KINDS[number] for number in np.unique(kinds_of(label_map)).tolist())
