"""Scores as plain JSON, and the fit between a network and images: whether rig and sensor are those it was trained for.

Shares are fractions of 1 rounded to five decimals; undefined scores are null.

A network learns how many pixels a metre of a body has. The limits follow from the sweeps `nearer`, `farther` and `rig`
of `bodyseg stability` (docs/results/stability.json): networks of short trainings lose 0 to 3 points of accuracy where
images have 0.8 to 1.25 times as many pixels a metre, 1 to 15 at 0.7 and 1.4, 7 to 17 at 0.6 and 1.7, 37 to 57 at half;
`box`, which was trained longer, 0 to 1, 2 to 5, 4 and 27.
"""

import math
import statistics
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any, Final, Self

import numpy as np

from bodyseg_data.artifacts import Augmentation, kinds_of
from bodyseg_data.core import BadConfig
from bodyseg_data.labels import PARTS33
from bodyseg_data.rigs import Rig
from bodyseg_model.evaluation.evaluation import Evaluation, Scores
from bodyseg_model.evaluation.scores import SWAPS, Confidences, ConfidentPixels, Reliability, count_kinds
from bodyseg_model.networks import Trained

SIMILAR: Final = 1.25
"""Greatest ratio of pixels a metre, either way, that costs a few points of accuracy."""

FAR_OFF: Final = 1.5
"""Ratio beyond which a score says little about a network, and is refused unless asked for."""

_SAME: Final = 1.01

Tree = dict[str, Any]

PAPERS_THRESHOLD: Final = 0.7
"""Confidence below which the paper drops pixels (section 4.1)."""

PAPERS_SUBSETS: Final = ("A", "B", "C", "people")

_THRESHOLDS: Final = (0.0, 0.5, 0.6, PAPERS_THRESHOLD, 0.8, 0.9)
_CURVE_POINTS: Final = 100
_DECIMALS: Final = 5


def report(evaluation: Evaluation) -> Tree:
    """All scores of all images together, the summary of every subset, and the images of lowest accuracy."""
    total = evaluation.total()
    labels = {} if evaluation.label_map == PARTS33 else {"labels": evaluation.label_map.to_json()}
    details: Tree = {**labels, "classes": _classes(total), "confusion": total.confusion.counts.tolist()}
    if total.confidences is not None:
        details |= _confidences(total.confidences)
    return {
        **summary(total),
        "subsets": {name: summary(evaluation.subsets[name]) for name in sorted(evaluation.subsets, key=subset_order)},
        "worst_images": [
            {"key": key, "average_per_class_accuracy": _share(accuracy)} for accuracy, key in evaluation.worst
        ],
        **details,
    }


def summary(scores: Scores) -> Tree:
    """Short scores of a group of images."""
    matrix, pixels = scores.confusion, scores.confusion.pixels
    kinds = count_kinds(matrix.counts, scores.label_map)
    found: Tree = {
        "images": scores.images,
        "pixels": pixels,
        "average_per_class_accuracy": _share(matrix.average_per_class_accuracy()),
        "over_images": {
            "mean": _share(float(scores.per_image.mean()[-1])),
            "sd": _share(float(scores.per_image.deviation()[-1])),
        },
        "pixel_accuracy": _share(matrix.pixel_accuracy()),
        "mean_iou": _share(matrix.mean_iou()),
        "swaps": {
            kind.replace("/", "_"): _share(kinds[kind] / (pixels or math.nan)) for kind in SWAPS if kind in kinds
        },
    }
    if scores.confidences is not None:
        found["gross_errors"] = scores.gross_errors.to_json()
        found["confidence"] = {
            "mean": _share(scores.confidences.mean()),
            "ece": _share(scores.confidences.ece()),
            "aurc": _share(scores.confidences.aurc()),
            "above_70_percent": _shares(scores.confidences.above(PAPERS_THRESHOLD)),
        }
    return found


def _classes(scores: Scores) -> list[Tree]:
    """Scores of each class: accuracy over all pixels, mean and standard deviation over the images that show it."""
    accuracy, iou = scores.confusion.per_class_accuracy(), scores.confusion.intersection_over_union()
    mean, deviation = scores.per_image.mean(), scores.per_image.deviation()
    return [
        {
            "label": label,
            "name": name,
            "pixels": int(scores.confusion.counts[label].sum()),
            "accuracy": _share(float(accuracy[label])),
            "iou": _share(float(iou[label])),
            "images": int(scores.per_image.images[label]),
            "mean_over_images": _share(float(mean[label])),
            "sd_over_images": _share(float(deviation[label])),
        }
        for label, name in enumerate(scores.label_map.names)
    ]


def _confidences(confidences: Confidences) -> Tree:
    coverage, risk = confidences.curve()
    coverages = np.linspace(1 / _CURVE_POINTS, 1, _CURVE_POINTS)
    risks = np.interp(coverages, coverage, risk) if coverage.size else np.full(_CURVE_POINTS, np.nan)
    return {
        "thresholds": [
            {"confidence_above": threshold, **_shares(confidences.above(threshold))} for threshold in _THRESHOLDS
        ],
        "risk_coverage": {
            "coverage": [round(float(value), _DECIMALS) for value in coverages],
            "risk": [_share(float(value)) for value in risks],
        },
        "reliability": [_shares(row) for row in confidences.reliability()],
    }


def _shares(record: ConfidentPixels | Reliability) -> Tree:
    return {name: _share(value) for name, value in asdict(record).items()}


def subset_order(subset: str) -> tuple[bool, str]:
    """Sort key: the paper's subsets first, in its order, which is alphabetical; then others."""
    return subset not in PAPERS_SUBSETS, subset


def _share(value: float) -> float | None:
    return None if math.isnan(value) else round(value, _DECIMALS)


def over_seeds(values: Sequence[float], decimals: int = 5) -> Tree:
    """Mean, standard deviation (divisor n - 1; None for one seed) and every seed's value."""
    return {
        "mean": round(statistics.mean(values), decimals),
        "sd": round(statistics.stdev(values), decimals) if len(values) > 1 else None,
        "seeds": [round(value, decimals) for value in values],
    }


@dataclass(frozen=True)
class RigFit:
    """A network's rig beside that of images. pixels_a_metre: of the images, as a multiple of those trained on, each at
    its rig's stand-off: focal length in pixels over distance.
    """

    trained: Rig
    images: Rig

    @classmethod
    def worst(cls, trained: Rig, rigs: Iterable[Rig]) -> Self:
        """The fit of the rig of a set that is farthest off."""
        return max((cls(trained, rig) for rig in rigs), key=lambda fit: fit.factor)

    @property
    def pixels_a_metre(self) -> float:
        """Ratio of the images' to the network's; 1 fits."""
        images, trained = (rig.camera.focal_px / rig.stand_off_m for rig in (self.images, self.trained))
        return images / trained

    @property
    def factor(self) -> float:
        """The same ratio as a number of at least 1, whichever is the larger."""
        return max(self.pixels_a_metre, 1 / self.pixels_a_metre)

    def check(self, path: str, other_rig: bool) -> str | None:
        """One line of warning where the images' rig is another, None where it is not.

        path: of the images, for messages. other_rig: whether images that are far off are wanted. Raises BadConfig for
        these if they are not.
        """
        rigs = f"{path} is of rig {self.images.name}, the network was trained for rig {self.trained.name}"
        sizes = f"bodies have {self.pixels_a_metre:.2g} times as many pixels a metre"
        if self.factor > FAR_OFF and not other_rig:
            raise BadConfig(f"{rigs}: {sizes}, too far off to score the network; --other-rig does so all the same")
        if self.factor > SIMILAR:
            return f"{rigs}: {sizes}, which costs much accuracy"
        if self.factor > _SAME:
            return f"{rigs}: {sizes}, which costs a few points of accuracy"
        names = (each.name for each in fields(Rig) if each.name != "name")
        differing = ", ".join(name for name in names if getattr(self.images, name) != getattr(self.trained, name))
        return f"{rigs}: as many pixels a metre, another {differing}" if differing else None


def sensor_warning(trained: Trained, augmentation: Augmentation, path: str) -> str | None:
    """One line where images have other artifacts than those trained on, None where they have not.

    augmentation: of the images; kinds of artifacts that its variant leaves out are not compared. path: for messages.
    """
    kinds = kinds_of(augmentation.variant)
    try:
        before = {each.name: each for each in trained.sensor if each.kind in kinds}
    except BadConfig as error:
        return f"the artifacts of {path} cannot be compared with those trained on: {error}"
    now = {each.name: each for each in augmentation.applied}
    differences = {
        "other strengths of": [name for name in now if name in before and now[name] != before[name]],
        "also": [name for name in now if name not in before],
        "without": [name for name in before if name not in now],
    }
    lines = [f"{what} {', '.join(names)}" for what, names in differences.items() if names]
    if not lines:
        return None
    return f"{path} has other artifacts than in training (sensor {trained.sensor.name}): {'; '.join(lines)}"
