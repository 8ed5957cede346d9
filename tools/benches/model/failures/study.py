"""Results of `bench failures`, collected image by image: counts by cause and by pose, and the worst images."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Collection, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benches.model.failures.causes import CAUSES, NAMES, NEW_POSE_DEG, Prediction, holds
from benches.model.failures.poses import POSE_KINDS, UNKNOWN, KnownPoses, Nearest, body_of, kind_of_pose, made_bodies
from bodyseg_data.labels import BACKGROUND, LANDMARKS
from bodyseg_data.loading import RangeImages
from bodyseg_data.samples import SampleInfo
from bodyseg_model.evaluation import ConfusionMatrix, count_pairs, pairs_of
from bodyseg_model.evaluation.evaluation import PredictedImage

Tree = dict[str, Any]

WORST: Final = 20
VIEWS_A_BODY: Final = 2
CROSSED: Final = next(iter(POSE_KINDS))
ARMS: Final = {"upper_arm": "Acromion", "elbow": "Olecranon", "forearm": "Radial Styloid", "hand": "Dactylion"}
"""Name of an arm's part -> its landmark, without the side."""

_STEPS_DEG: Final = (0, 10, 20, 30, 40, 50, 60)
_MARGIN_PX: Final = 4
_CAUSES_TOLD: Final = 3


class Picture(NamedTuple):
    """The part of one image around its body: range uint16, the others uint8, all [h, w]. causes: index in `CAUSES`,
    BACKGROUND where nothing was measured or nothing is wrong.
    """

    range: NDArray[np.uint16]
    truth: NDArray[np.uint8]
    predicted: NDArray[np.uint8]
    causes: NDArray[np.uint8]


class _Failure(NamedTuple):
    """One image. Compared by accuracy, then by key."""

    accuracy: float
    key: str
    facts: Tree
    picture: Picture

    @property
    def body(self) -> tuple[str, str]:
        """Frames of one motion are one body here: they look alike."""
        return self.facts["subject"], self.facts["pose"]


class FailureCounts:
    """Counts the images of one set."""

    def __init__(self, images: RangeImages, known: KnownPoses) -> None:
        self._images = images
        self._camera = images.manifest.rig.camera
        self._index = {key: index for index, key in enumerate(images.keys)}
        self._known, self._made = known, made_bodies(images.clean(0).info.source)
        self._nearest: dict[str, Nearest] = {}
        # int64 [11, 33, 33]: pixels where a rule holds, and wrong ones of which it is the cause.
        self._held, self._claimed = (np.stack([ConfusionMatrix().counts] * len(CAUSES)) for _ in range(2))
        self._poses: dict[str, ConfusionMatrix] = defaultdict(ConfusionMatrix)
        self._steps: dict[tuple[str, int], ConfusionMatrix] = defaultdict(ConfusionMatrix)
        self._views: dict[str, int] = defaultdict(int)
        self._segments: dict[str, int] = defaultdict(int)
        self._total = ConfusionMatrix()
        self._raw: list[tuple[float, str]] = []
        self.images = 0
        self.worst: list[_Failure] = []

    def watch(self, seen: PredictedImage, accuracy: float) -> None:
        """Count one image; one that shows nothing counts as an image alone."""
        self.images += 1
        if math.isnan(accuracy):
            return
        index = self._index[seen.key]
        clean, shown = self._images.clean(index), self._images.image(index)
        nearest = self._pose_distance(seen.key)
        pairs = pairs_of(seen.labels, seen.predicted)
        wrong = pairs // len(LANDMARKS) != pairs % len(LANDMARKS)
        found = holds(Prediction(clean, shown, seen.predicted, nearest.degrees), self._camera)
        cause = found.argmax(axis=0).astype(np.uint8)
        counts = count_pairs(pairs)
        for number, held in enumerate(found):
            self._held[number] += count_pairs(pairs[held])
            self._claimed[number] += count_pairs(pairs[wrong & (cause == number)])
        for matrix in (self._total, self._poses[clean.info.pose], self._steps[clean.info.pose, _step(nearest.degrees)]):
            matrix.counts += counts
        self._views[clean.info.pose] += 1
        if nearest.degrees > NEW_POSE_DEG:
            self._segments[nearest.segment.partition(".")[0]] += int(wrong.sum())
        cause[~wrong] = BACKGROUND
        facts = _facts(clean.info) | {
            "sigma_mm": rounded(shown.drawn.get("sigma_mm"), 1),
            "missing_rate": shown.drawn.get("missing_rate"),
            "new_pose_deg": rounded(nearest.degrees, 1),
            "new_segment": nearest.segment or None,
            "nearest_training_pose": nearest.pose or None,
            "wrong": round(float(wrong.mean()), 4),
            "causes": _shares(np.bincount(cause[wrong], minlength=len(CAUSES))),
        }
        self._raw = sorted([*self._raw, (accuracy, seen.key)])[:WORST]
        self._keep(_Failure(accuracy, seen.key, facts, _picture(shown.range, seen, cause)))

    def _pose_distance(self, key: str) -> Nearest:
        body = body_of(key)
        if body not in self._nearest:
            self._nearest[body] = self._known.nearest(self._made[body][1]()) if body in self._made else UNKNOWN
        return self._nearest[body]

    def _keep(self, failure: _Failure) -> None:
        """Among the worst, if it is: of one body at most `VIEWS_A_BODY`."""
        kept: list[_Failure] = []
        for each in sorted([*self.worst, failure], key=lambda one: one[:2]):
            if sum(other.body == each.body for other in kept) < VIEWS_A_BODY:
                kept.append(each)
        self.worst = kept[:WORST]

    def results(self, training_poses: Sequence[str]) -> Tree:
        """All that was counted, as plain JSON. training_poses: names of the poses of the training bodies."""
        total = self._total
        kinds: dict[str, list[str]] = defaultdict(list)
        for pose in self._poses:
            kinds[kind_of_pose(pose)].append(pose)
        trained = [kind_of_pose(pose) for pose in training_poses]
        return {
            "images": self.images,
            "pixels": total.pixels,
            "pixel_accuracy": rounded(total.pixel_accuracy(), 4),
            "accuracy": rounded(accuracy(total.counts)),
            "causes": [self._cause(number) for number in range(len(CAUSES))],
            "worst": [
                {
                    "key": one.key,
                    "accuracy": round(one.accuracy, 4),
                    "main_cause": next(iter(one.facts["causes"]), None),
                }
                | one.facts
                for one in self.worst
            ],
            "worst_of_all": [key for _, key in self._raw],
            "pose_kinds": {
                kind: {"training_bodies": trained.count(kind) if trained else None} | self._of(kinds[kind])
                for kind in sorted(kinds, key=lambda name: self._of(kinds[name])["accuracy"])
            },
            "new_pose": self._by_newness(self._poses),
            "new_pose_within": {pose: steps for pose in self._poses if len(steps := self._by_newness([pose])) > 1},
            "new_segments": {
                segment: _ratio(wrong, _wrong(total.counts))
                for segment, wrong in sorted(self._segments.items(), key=lambda one: -one[1])
            },
            "crossed_arms": {
                "postures": {pose: self._of([pose]) for pose in sorted(kinds.get(CROSSED, []))},
                "rest": self._of([pose for pose in self._poses if kind_of_pose(pose) != CROSSED]),
            },
        }

    def _cause(self, number: int) -> Tree:
        """See docs/results/failures.md for what each number means."""
        cause, total, held = CAUSES[number], self._total.counts, self._held[number]
        claimed = self._claimed[number]
        wrong, wrong_held = _wrong(total), _wrong(held)
        answer: Tree = {
            "cause": cause.name,
            "share_of_wrong": _ratio(int(claimed.sum()), wrong),
            "holds_of_wrong": _ratio(wrong_held, wrong),
            "holds_of_all": _ratio(int(held.sum()), int(total.sum())),
        }
        mended = total - claimed
        mended[np.diag_indices(len(mended))] += claimed.sum(axis=1)
        answer["accuracy_if_right"] = rounded(accuracy(mended))
        if cause.about == "a mistake":  # it holds where something is wrong, so it cannot be compared with elsewhere
            return answer | {"lift": None, "excess": None, "accuracy_elsewhere": None}
        elsewhere = total - held
        there, other = (_ratio(_wrong(part), int(part.sum())) for part in (held, elsewhere))
        excess = None if there is None or other is None else (there - other) * int(held.sum())
        overall = wrong / max(int(total.sum()), 1)
        return answer | {
            "lift": None if there is None or not overall else round(there / overall, 3),
            "excess": None if excess is None or not wrong else round(excess / wrong, 4),
            "accuracy_elsewhere": rounded(accuracy(elsewhere)),
        }

    def _by_newness(self, poses: Collection[str]) -> Tree:
        """Accuracy on images of some poses by how far they are from training poses, as far as that is known."""
        found: Tree = {}
        for step in _STEPS_DEG:
            matrix = ConfusionMatrix()
            matrix.counts += sum(
                each.counts for (pose, at), each in self._steps.items() if at == step and pose in poses
            )
            if matrix.pixels:
                found[f"{step}-{step + 10}" if step < _STEPS_DEG[-1] else f"above-{step}"] = {
                    "pixels": _ratio(matrix.pixels, self._total.pixels),
                    "wrong": round(1 - matrix.pixel_accuracy(), 4),
                    "accuracy": rounded(accuracy(matrix.counts)),
                }
        return found

    def _of(self, poses: Sequence[str]) -> Tree:
        """Accuracy on all images of some poses, and of the parts of their arms."""
        matrix = ConfusionMatrix()
        for pose in poses:
            matrix.counts += self._poses[pose].counts
        return {
            "images": sum(self._views[pose] for pose in poses),
            "wrong": rounded(1 - matrix.pixel_accuracy(), 4),
            "accuracy": rounded(accuracy(matrix.counts)),
            "arms": {
                name: rounded(accuracy(matrix.counts, [n for n, part in enumerate(LANDMARKS) if part[4:] == landmark]))
                for name, landmark in ARMS.items()
            },
        }


def _picture(steps: NDArray[np.uint16], seen: PredictedImage, cause: NDArray[np.uint8]) -> Picture:
    body = seen.labels != BACKGROUND
    causes = np.full(body.shape, BACKGROUND, np.uint8)
    causes[body] = cause
    top, left = (max(int(np.flatnonzero(body.any(axis=axis))[0]) - _MARGIN_PX, 0) for axis in (1, 0))
    low, right = (int(np.flatnonzero(body.any(axis=axis))[-1]) + 1 + _MARGIN_PX for axis in (1, 0))
    box = slice(top, low), slice(left, right)
    return Picture(steps[box].copy(), seen.labels[box].copy(), seen.predicted[box].copy(), causes[box].copy())


def _facts(info: SampleInfo) -> Tree:
    facts = {name: getattr(info, name) for name in ("subset", "subject", "pose", "distance_cm", "azimuth_deg")}
    return facts | {"pose_kind": kind_of_pose(info.pose)}


def _shares(counts: NDArray[np.int64]) -> dict[str, float]:
    """Shares of the causes that claim most, the largest first."""
    order = np.argsort(-counts, kind="stable")[:_CAUSES_TOLD]
    return {NAMES[number]: round(int(counts[number]) / int(counts.sum()), 3) for number in order if counts[number]}


def _step(degrees: float) -> int:
    """The lower end of the step that a distance between poses is in; -1 if it is not known."""
    return -1 if math.isnan(degrees) else min(int(degrees) // 10 * 10, _STEPS_DEG[-1])


def accuracy(counts: NDArray[np.int64], parts: Sequence[int] = ()) -> float:
    """Average per-class accuracy of counts [33, 33] over all parts, or over some; NaN if none of them is shown."""
    matrix = ConfusionMatrix()
    matrix.counts = counts
    values = matrix.per_class_accuracy()
    values = values[list(parts)] if parts else values
    shown = values[~np.isnan(values)]
    return float(shown.mean()) if shown.size else math.nan


def _wrong(counts: NDArray[np.int64]) -> int:
    return int(counts.sum() - counts.trace())


def _ratio(part: int, whole: int) -> float | None:
    return round(part / whole, 6) if whole else None


def rounded(value: float | None, digits: int = 4) -> float | None:
    """Return a value rounded; None stands for NaN."""
    return None if value is None or math.isnan(value) else round(value, digits)
