"""Scores as plain JSON. Shares are fractions of 1 rounded to five decimals; undefined scores are null."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any, Final

import numpy as np

from bodyseg_data.core.labels.label_map import PARTS33
from bodyseg_model.evaluation.evaluation import Evaluation, Scores
from bodyseg_model.evaluation.scores import (
    BIN_NAMES,
    KINDS,
    SWAPS,
    BorderErrors,
    Confidences,
    ConfidentPixels,
    Reliability,
    count_kinds,
    told_kinds,
)

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
    details: Tree = {**labels, "parts": _parts(total), "confusion": total.confusion.counts.tolist()}
    if total.confidences is not None:
        details |= _confidences(total.confidences)
    if total.borders is not None:
        details["border_distance_px"] = _borders(total.borders, told_kinds(total.label_map))
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
        "swaps": {_key(kind): _share_of(kinds[kind], pixels) for kind in SWAPS},
    }
    if scores.confidences is not None:
        found["confidence"] = {
            "mean": _share(scores.confidences.mean()),
            "ece": _share(scores.confidences.ece()),
            "aurc": _share(scores.confidences.aurc()),
            "above_70_percent": _shares(scores.confidences.above(PAPERS_THRESHOLD)),
        }
    return found


def _parts(scores: Scores) -> list[Tree]:
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


def _borders(borders: BorderErrors, told: frozenset[str]) -> list[Tree]:
    """Rows of the bins: pixels, and the share of them that is wrong, in all and by each kind that is told."""
    rows = []
    for name, counts in zip(BIN_NAMES, borders.counts.tolist(), strict=True):
        pixels = sum(counts)
        shares = [count / pixels if pixels else math.nan for count in counts]
        kinds = {
            _key(kind): _share(share) if kind in told else None
            for kind, share in zip(KINDS[1:], shares[1:], strict=True)
        }
        rows.append({"distance": name, "pixels": pixels, "wrong": _share(1 - shares[0]), **kinds})
    return rows


def _shares(record: ConfidentPixels | Reliability) -> Tree:
    return {name: _share(value) for name, value in asdict(record).items()}


def subset_order(subset: str) -> tuple[bool, str]:
    """Sort key: the paper's subsets first, in its order, which is alphabetical; then others."""
    return subset not in PAPERS_SUBSETS, subset


def _key(kind: str) -> str:
    return kind.replace("/", "_")


def _share_of(count: int | None, pixels: int) -> float | None:
    return None if count is None or not pixels else round(count / pixels, _DECIMALS)


def _share(value: float) -> float | None:
    return None if math.isnan(value) else round(value, _DECIMALS)


def over_seeds(values: Sequence[float], decimals: int = 5) -> Tree:
    """Mean, standard deviation (divisor n - 1; None for one seed) and every seed's value."""
    return {
        "mean": round(statistics.mean(values), decimals),
        "sd": round(statistics.stdev(values), decimals) if len(values) > 1 else None,
        "seeds": [round(value, decimals) for value in values],
    }
