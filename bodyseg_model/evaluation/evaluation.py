"""A network and a set of test images -> scores, streamed: memory grows with neither images nor pixels.

`evaluate` is what `bodyseg evaluate` calls, and what sweeps over artifacts, seeds and networks call with fewer scores.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts.artifact import Artifact
from bodyseg_data.artifacts.missing_data import MissingData
from bodyseg_data.artifacts.noise import Noise
from bodyseg_data.artifacts.variants import artifacts_for
from bodyseg_data.core.errors import BadConfig, check_int
from bodyseg_data.core.parts import BACKGROUND
from bodyseg_data.core.sample import Sample
from bodyseg_data.core.splits import Split
from bodyseg_data.loading.loader import loader
from bodyseg_data.loading.range_images import Batch, RangeImages
from bodyseg_model.evaluation.border_distance import BorderErrors, distance_bins
from bodyseg_model.evaluation.calibration import Confidences
from bodyseg_model.evaluation.scores import ConfusionMatrix, Spread, count_pairs, pairs_of
from bodyseg_model.networks.network import Network
from bodyseg_model.networks.registry import device_of, predict

Extra = Literal["confidences", "borders"]
EXTRAS: Final[tuple[Extra, ...]] = ("confidences", "borders")
"""Scores beyond the confusion matrix and what follows from it."""

_WORST: Final = 10


class Seen(NamedTuple):
    """One image as a network saw it. Arrays last until the next image.

    range_m: float32 [H, W], metres; labels: uint8 [H, W], the truth; predicted: uint8 [H, W]; confidence: float32
    [H, W], 0 to 1.
    """

    key: str
    subset: str
    range_m: NDArray[np.float32]
    labels: NDArray[np.uint8]
    predicted: NDArray[np.uint8]
    confidence: NDArray[np.float32]


class Scores:
    """What is counted of one group of images; `confidences` and `borders` are None where they were not asked for."""

    def __init__(self, extras: Collection[Extra] = EXTRAS) -> None:
        self.extras = frozenset(extras)
        self.images = 0
        self.confusion = ConfusionMatrix()
        self.spread = Spread()
        self.confidences = Confidences() if "confidences" in extras else None
        self.borders = BorderErrors() if "borders" in extras else None

    def add(self, seen: Seen, borders: NDArray[np.uint8]) -> float:
        """Count one image; returns its average per-class accuracy, NaN if it shows nothing.

        borders: the labels whose borders distances are measured to, uint8 [H, W]. Raises BadConfig for labels or
        confidences that are none.
        """
        pairs = pairs_of(seen.labels, seen.predicted)
        counts = count_pairs(pairs)
        self.images += 1
        self.confusion.counts += counts
        where = np.flatnonzero(seen.labels != BACKGROUND)
        if self.confidences is not None:
            self.confidences.add(pairs, seen.confidence.ravel().take(where))
        if self.borders is not None:
            self.borders.add(pairs, distance_bins(borders).ravel().take(where))
        return self.spread.add(counts)

    def merge(self, other: Scores) -> None:
        """Count all of another one's images. Raises BadConfig unless both count the same scores."""
        if self.extras != other.extras:
            raise BadConfig(
                "scores to merge must count the same things, found "
                f"{sorted(self.extras) or 'none'} and {sorted(other.extras) or 'none'} beside the confusion matrix"
            )
        self.images += other.images
        self.confusion.counts += other.confusion.counts
        self.spread.merge(other.spread)
        if self.confidences is not None and other.confidences is not None:
            self.confidences.merge(other.confidences)
        if self.borders is not None and other.borders is not None:
            self.borders.counts += other.borders.counts


@dataclass
class Seconds:
    """How long an evaluation spent in the network, on scores, and waiting for images to be loaded."""

    network: float = 0.0
    scores: float = 0.0
    loading: float = 0.0


@dataclass
class Evaluation:
    """Scores of every subset (the paper's A, B, C and people, or what a source calls its own), and what it took.

    worst: average per-class accuracy and key of the ten images that went worst, the worst first.
    """

    extras: frozenset[Extra] = frozenset(EXTRAS)
    subsets: dict[str, Scores] = field(default_factory=dict)
    seconds: Seconds = field(default_factory=Seconds)
    worst: list[tuple[float, str]] = field(default_factory=list)

    def total(self, subsets: Collection[str] | None = None) -> Scores:
        """The scores of all images, or of those of some subsets. Raises BadConfig for one that no image is of."""
        total = Scores(self.extras)
        for name in self.subsets if subsets is None else subsets:
            if name not in self.subsets:
                raise BadConfig(f"the subset must be one of {', '.join(sorted(self.subsets))}, found {name!r}")
            total.merge(self.subsets[name])
        return total

    def add(self, seen: Seen, borders: NDArray[np.uint8]) -> float:
        """Count one image in its subset; see `Scores.add`."""
        accuracy = self.subsets.setdefault(seen.subset, Scores(self.extras)).add(seen, borders)
        if not math.isnan(accuracy):
            self.worst = sorted([*self.worst, (accuracy, seen.key)])[:_WORST]
        return accuracy

    def merge(self, other: Evaluation) -> None:
        """Count the images of another set as well. Raises BadConfig unless both count the same scores."""
        for name, scores in other.subsets.items():
            self.subsets.setdefault(name, Scores(self.extras)).merge(scores)
        self.seconds.network += other.seconds.network
        self.seconds.scores += other.seconds.scores
        self.seconds.loading += other.seconds.loading
        self.worst = sorted([*self.worst, *other.worst])[:_WORST]


def open_images(
    path: str,
    variant: str = "all",
    split: Split = "test",
    seed: int = 0,
    noise_mm: float | None = None,
    missing: float | None = None,
    artifacts: Sequence[Artifact] = (),
) -> RangeImages:
    """A set to evaluate on, with noise of one sigma in mm, or one share of missing pixels, for all images if given.

    artifacts: others of given strengths. Raises BadConfig for a strength that cannot be, is given twice, or is of an
    artifact that the variant does not have; otherwise as `RangeImages`.
    """
    given = [*artifacts, *fixed_artifacts(noise_mm, missing)]
    return RangeImages(path, variant, split, seed, artifacts=artifacts_for(variant, given))


def fixed_artifacts(noise_mm: float | None, missing: float | None) -> list[Artifact]:
    """Noise of one sigma and missing data of one share for every image, each unless None. Raises BadConfig."""
    fixed: list[Artifact] = []
    if noise_mm is not None:
        fixed.append(Noise(noise_mm, noise_mm))
    if missing is not None:
        fixed.append(MissingData((missing,)))
    return fixed


def evaluate(
    network: Network,
    images: RangeImages,
    count: int | None = None,
    *,
    extras: Collection[Extra] = EXTRAS,
    batch_size: int = 16,
    num_workers: int = 0,
    progress: Callable[[int, int], None] | None = None,
    watch: Callable[[Seen, float], None] | None = None,
) -> Evaluation:
    """Judge a network, in evaluation mode, by `images` as their epoch shows them.

    count: how many images, the first ones of the permutation that belongs to the images' seed and epoch; None, or more
    than there are, takes all. So networks, variants and strengths of artifacts are judged by the same bodies.
    extras: which scores to count beyond the confusion matrix; () is cheapest. Distances to borders are measured in the
    clean label image: a pixel has the same one in every variant, and missing pixels make no borders.
    progress: called with images done and images in all. watch: called with every image and its accuracy.

    Raises BadConfig for a wrong count, an unknown score, or a network whose answers are no labels; otherwise as the
    loader.
    """
    wanted = len(images) if count is None else min(check_int("the number of images", count, 1), len(images))
    for name in extras:
        if name not in EXTRAS:
            raise BadConfig(f"scores to count must be among {', '.join(EXTRAS)}, found {name!r}")
    found = Evaluation(frozenset(extras))
    clean = _CleanSamples(images)
    device = device_of(network)
    lap = _Stopwatch().lap
    done = 0
    for batch in _batches(images, wanted, batch_size, num_workers):
        found.seconds.loading += lap()
        keys = batch["key"][: wanted - done]
        answer = predict(network, batch["range"][: len(keys)].to(device))
        predicted, confidence = answer.labels.cpu().numpy(), answer.confidence.cpu().numpy()
        found.seconds.network += lap()
        ranges, labels = batch["range"][:, 0].numpy(), batch["labels"].numpy()
        for at, key in enumerate(keys):
            seen = Seen(key, clean.subset(key), ranges[at], labels[at], predicted[at], confidence[at])
            accuracy = found.add(seen, clean.labels(key, seen.labels) if "borders" in extras else seen.labels)
            if watch is not None:
                watch(seen, accuracy)
        done += len(keys)
        found.seconds.scores += lap()
        if progress is not None:
            progress(done, wanted)
    return found


def _batches(images: RangeImages, wanted: int, batch_size: int, num_workers: int) -> Iterator[Batch]:
    """Batches that hold the first `wanted` images of the permutation, and maybe more."""
    # One process evaluates, whatever torchrun says; and the order is that of the images' epoch, for every split.
    batches = loader(images, batch_size, num_workers, shuffle=True, rank=0, world_size=1)
    for number, batch in enumerate(batches, 1):
        yield batch
        if number * batch_size >= wanted:
            return


class _CleanSamples:
    """What evaluating needs to know of clean samples, read as seldom as can be."""

    def __init__(self, images: RangeImages) -> None:
        self._images = images
        self._places = {key: place for place, key in enumerate(images.keys)}
        self._subsets: dict[str, str] = {}
        self._same = not images.augmentation.alters_labels
        self._last: Sample | None = None

    def subset(self, key: str) -> str:
        """The subset of a sample, read once for all views of a body: their keys differ in the last two words."""
        body = key.rsplit("-", 2)[0]
        if body not in self._subsets:
            self._subsets[body] = self._read(key).info.subset
        return self._subsets[body]

    def labels(self, key: str, shown: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The clean label image of a sample whose labels in the variant are `shown`."""
        return shown if self._same else self._read(key).labels

    def _read(self, key: str) -> Sample:
        if self._last is None or self._last.key != key:
            self._last = self._images.clean(self._places[key])
        return self._last


class _Stopwatch:
    def __init__(self) -> None:
        self._last = time.perf_counter()

    def lap(self) -> float:
        """Seconds since the last lap."""
        before, self._last = self._last, time.perf_counter()
        return self._last - before
