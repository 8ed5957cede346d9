"""Evaluation of a network on a stream of test images, in memory that grows with neither images nor pixels; its time."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from bodyseg_data.artifacts import (
    PAPER_SENSOR,
    Artifact,
    MissingData,
    Noise,
    SensorModel,
    load_sensor_model,
    sensor_for,
)
from bodyseg_data.core import BadConfig, ProgressCallback, Stopwatch, check_choice, check_int, silent
from bodyseg_data.labels import BACKGROUND, PART_COUNT, PARTS33, LabelMap
from bodyseg_data.loading import DEFAULT_WORKER_METHOD, RangeImages, WorkerMethod, loader
from bodyseg_data.samples import OccluderName, ReadSplit, metres
from bodyseg_model.evaluation.gross_errors import MEASURABLE, GrossErrors, TrueSurface
from bodyseg_model.evaluation.scores import Confidences, ConfusionMatrix, PerImageAccuracy, count_pairs, pairs_of
from bodyseg_model.networks import Network, check_label_map, check_network, device_of, predict

_WORST: Final = 10
_WHOLE: Final = "all"  # subset of images of sets without subsets
_STAGES: Final = ("network", "scores", "loading")


class PredictedImage(NamedTuple):
    """One test image and its prediction. The arrays are valid until the next image.

    range_m: float32 [H, W], metres; labels: uint8 [H, W], the true ones; predicted: uint8 [H, W]; confidence: float32
    [H, W], 0 to 1. away: float32 [N], of its wrong pixels to the parts predicted for them, metres, see
    `distances_to_parts`; None: not measured.
    """

    key: str
    subset: str
    range_m: NDArray[np.float32]
    labels: NDArray[np.uint8]
    predicted: NDArray[np.uint8]
    confidence: NDArray[np.float32]
    away: NDArray[np.float32] | None = None


class Scores:
    """Counts over a group of images, from which accuracies and other scores are computed.

    confidences: whether they are counted; the attribute is None if not. label_map: the classes of truth and prediction.
    """

    def __init__(self, confidences: bool = True, label_map: LabelMap = PARTS33) -> None:
        classes = len(label_map)
        self.label_map = label_map
        self.images = 0
        self.confusion = ConfusionMatrix(classes)
        self.per_image = PerImageAccuracy(classes)
        self.confidences = Confidences(classes) if confidences else None
        self.gross_errors = GrossErrors()

    def __repr__(self) -> str:
        return f"Scores({self.images} images, {self.confusion})"

    def add(self, image: PredictedImage) -> float:
        """Count one image; returns its average per-class accuracy, NaN if it shows nothing.

        Raises BadConfig for labels of no class or confidences outside 0 to 1.
        """
        classes = len(self.label_map)
        pairs = pairs_of(image.labels, image.predicted, classes)
        counts = count_pairs(pairs, classes)
        self.images += 1
        self.confusion.counts += counts
        if self.confidences is not None:
            self.confidences.add(pairs, image.confidence[image.labels != BACKGROUND])
        if image.away is not None:
            self.gross_errors.add(image.away, int(counts.trace()))
        return self.per_image.add(counts)

    def merge(self, other: Scores) -> None:
        """Add the counts of other images. Raises BadConfig for other classes, or confidences in one alone."""
        differing = self.label_map.difference(other.label_map)
        if differing is not None:
            raise BadConfig(f"scores to merge must be of the same labels, found {differing}")
        if (self.confidences is None) != (other.confidences is None):
            raise BadConfig("scores to merge must both have confidences, or neither: found them in one alone")
        self.images += other.images
        self.confusion.counts += other.confusion.counts
        self.per_image.merge(other.per_image)
        self.gross_errors.merge(other.gross_errors)
        if self.confidences is not None and other.confidences is not None:
            self.confidences.merge(other.confidences)


@dataclass
class Evaluation:
    """Scores of every subset of the images, as `evaluate` returns them; `total` sums them up.

    subsets: the paper's A, B, C and people, those that a source names, or "all" where none is named. confidences: as of
    `Scores`. label_map: the classes that are scored. worst: average per-class accuracy and key of the ten images of
    lowest accuracy, the lowest first. milliseconds: time of the network, of scores, and of waiting for images.
    """

    confidences: bool = field(default=True, repr=False)
    subsets: dict[str, Scores] = field(default_factory=dict)
    milliseconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(_STAGES, 0.0), repr=False)
    worst: list[tuple[float, str]] = field(default_factory=list, repr=False)
    label_map: LabelMap = field(default=PARTS33, repr=False)

    def total(self, subsets: Collection[str] | None = None) -> Scores:
        """Sum the scores of all subsets, or of those named. Raises BadConfig for a subset without images."""
        total = Scores(self.confidences, self.label_map)
        for name in self.subsets if subsets is None else subsets:
            total.merge(self.subsets[check_choice("the subset", name, sorted(self.subsets))])
        return total

    def add(self, image: PredictedImage) -> float:
        """Count one image in its subset; returns its accuracy, as `Scores.add`."""
        accuracy = self.subsets.setdefault(image.subset, Scores(self.confidences, self.label_map)).add(image)
        if not math.isnan(accuracy):
            self.worst = sorted([*self.worst, (accuracy, image.key)])[:_WORST]
        return accuracy

    def merge(self, other: Evaluation) -> None:
        """Add the counts of another evaluation, of other images. Raises BadConfig as `Scores.merge`."""
        for name, scores in other.subsets.items():
            self.subsets.setdefault(name, Scores(self.confidences, self.label_map)).merge(scores)
        for stage, milliseconds in other.milliseconds.items():
            self.milliseconds[stage] += milliseconds
        self.worst = sorted([*self.worst, *other.worst])[:_WORST]


def open_images(
    path: str,
    variant: str = "all",
    split: ReadSplit = "test",
    seed: int = 0,
    *,
    noise_mm: float | None = None,
    missing: float | None = None,
    artifacts: Sequence[Artifact] = (),
    sensor: str | Path | SensorModel = PAPER_SENSOR,
    where: Sequence[str] = (),
    val_share: float = 0.0,
    labels: str | Path | LabelMap | None = None,
    occluder: OccluderName = "stored",
) -> RangeImages:
    """Open a set for `evaluate`: as `RangeImages`, where asked for with one strength of artifacts for every image.

    noise_mm: sigma of the noise of every image, mm; missing: share of missing pixels of every image; both are drawn for
    each image by default. artifacts: others that replace or follow the sensor's. labels: the classes to score, by
    default the set's own. where, val_share, occluder: as for `RangeImages`.
    Raises BadConfig for a strength that is invalid, is given twice, or is of an artifact that the variant does not
    have; otherwise as `RangeImages`.
    """
    given = [*artifacts, *fixed_artifacts(noise_mm, missing)]
    model = sensor_for(variant, load_sensor_model(sensor), given)
    return RangeImages(
        path, variant, split, seed, sensor=model, where=where, val_share=val_share, labels=labels, occluder=occluder
    )


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
    confidences: bool = True,
    label_map: LabelMap | None = None,
    batch_size: int = 16,
    num_workers: int = 0,
    worker_method: WorkerMethod = DEFAULT_WORKER_METHOD,
    progress: ProgressCallback = silent,
    watch: Callable[[PredictedImage, float], None] | None = None,
) -> Evaluation:
    """Evaluate a network, in evaluation mode, on `images` of their epoch.

    count: number of images, the first in the permutation of the images' seed and epoch, so that networks, variants and
    strengths of artifacts are compared on the same bodies; None, or more than there are, takes all.
    confidences: whether they and, with SciPy and images without transforms, gross errors are counted beside the
    confusion matrix. batch_size: images that go through the network together. num_workers, worker_method: see `loader`.
    label_map: the classes that the network predicts, by default those of the images' labels, or the 33 parts for a
    network of 33; where the images have coarser classes, each predicted label counts as the class that it is part of.
    progress: called with images done and images in all. watch: with every image and its average per-class accuracy.

    Raises BadConfig for an invalid count, another number of classes than the network's, classes that cannot be joined
    to the images', or confidences outside 0 to 1; otherwise as `loader`.
    """
    if not isinstance(images, RangeImages):
        raise BadConfig(f"images must be RangeImages, each set of a mixture by itself, found {type(images).__name__}")
    total = len(images) if count is None else min(check_int("the number of images", count, 1), len(images))
    found = Evaluation(confidences, label_map=images.label_map)
    check_network(network)
    own = PARTS33 if network.classes == PART_COUNT != len(images.label_map) else images.label_map
    predicts = own if label_map is None else label_map
    check_label_map(network, predicts)
    joined = None if predicts.difference(images.label_map) is None else predicts.joined_to(images.label_map)
    device = device_of(network)
    measures = confidences and MEASURABLE and not images.transforms  # transforms may move pixels
    stage = Stopwatch(_STAGES)
    found.milliseconds = stage.milliseconds
    # One process evaluates, also under torchrun. For every split the order is that of the images' epoch.
    batches = iter(
        loader(images, batch_size, num_workers, shuffle=True, rank=0, world_size=1, worker_method=worker_method)
    )
    for done in range(0, total, batch_size):
        with stage("loading"):
            batch = next(batches)
        keys = batch["key"][: total - done]
        with stage("network"):
            prediction = predict(network, batch["range"][: len(keys)].to(device))
            predicted, confidence = prediction.labels.cpu().numpy(), prediction.confidence.cpu().numpy()
            if joined is not None:
                predicted = joined[predicted]
        ranges, labels = batch["range"][:, 0].numpy(), batch["labels"].numpy()
        with stage("scores"):
            for at, (key, index) in enumerate(zip(keys, batch["index"], strict=False)):
                subset = str(images.describe(index).get("subset", _WHOLE))
                away = _away(images, index, labels[at], predicted[at]) if measures else None
                image = PredictedImage(key, subset, ranges[at], labels[at], predicted[at], confidence[at], away)
                accuracy = found.add(image)
                if watch is not None:
                    watch(image, accuracy)
        progress(done + len(keys), total)
    return found


def _away(
    images: RangeImages, index: int, truth: NDArray[np.uint8], predicted: NDArray[np.uint8]
) -> NDArray[np.float32]:
    """Distances of an image's wrong pixels to the parts predicted for them, on the stored sample, float32 [N]."""
    sample = images.clean(index)
    labels = np.array(sample.labels)
    if not images.label_map.is_whole:
        images.label_map.write(labels, None, images.unlabelled)
    surface = TrueSurface(metres(sample.range, images.step_m), labels, images.manifest.rig_of(sample).camera)
    wrong = np.flatnonzero((truth != BACKGROUND) & (truth != predicted) & (sample.range > 0))
    return surface.distances(wrong, predicted.ravel()[wrong])


_WARM_UP: Final = 3


def time_frames(network: Network, frames: Sequence[torch.Tensor]) -> dict[str, Any]:
    """Time `predict` on single frames, float32 [1, 1, H, W] each, from a frame in memory to labels in memory.

    Loading, scoring and drawing are excluded; a few frames are predicted first, untimed. Returns milliseconds, with
    their deviation over frames (divisor n - 1, 0 for a single one), the numbers of frames and of threads that torch may
    use, and the device's name, as plain JSON. Raises BadConfig if there is no frame.
    """
    if not frames:
        raise BadConfig("timing a network needs at least one frame")
    device = device_of(network)

    def seconds(frame: torch.Tensor) -> float:
        start = time.perf_counter()
        predict(network, frame.to(device)).labels.cpu()  # on another device, this also waits for the labels
        return time.perf_counter() - start

    for number in range(_WARM_UP):
        seconds(frames[number % len(frames)])
    taken = np.array([1000 * seconds(frame) for frame in frames])
    deviation = float(taken.std(ddof=1)) if len(taken) > 1 else 0.0
    times = {"mean": float(taken.mean()), "deviation": deviation, "median": float(np.median(taken))}
    return {
        **{name: round(value, 2) for name, value in times.items()},
        "frames": len(taken),
        "threads": torch.get_num_threads(),
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else "processor",
    }
