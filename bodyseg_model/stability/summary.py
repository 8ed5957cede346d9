"""Summary of accuracies: curves over seeds, mCE, mRR, the worst case, and the strength at which 60 % is lost.

mCE is Hendrycks and Dietterich's mean corruption error ("Benchmarking neural network robustness to common corruptions
and perturbations", 2019) with average per-class accuracy in place of their top-1 accuracy. For one sweep, the
error 1 - accuracy summed over strengths is divided by that of the reference; mCE is the mean over sweeps. mRR is the
mean over sweeps of the mean accuracy over strengths divided by the clean accuracy. Neither counts the clean strength.
"""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from itertools import pairwise
from typing import Any, Final

from bodyseg_model.evaluation.report import over_seeds
from bodyseg_model.stability.accuracies import Accuracies
from bodyseg_model.stability.groups import Group
from bodyseg_model.stability.sweeps import CLEAN, Condition, Sweep

Tree = dict[str, Any]

BOUND: Final = 0.6


def summarise(groups: Sequence[Group], sweeps: Mapping[str, Sweep], found: Accuracies, reference: Group | None) -> Tree:
    """Build the part of stability.json that is about images; plain JSON. found: has every condition of the sweeps."""
    conditions = {name: sweep.conditions(name) for name, sweep in sweeps.items()}
    curves = {
        group.label: {
            name: [[found[run.name][condition] for condition in row] for run in group.runs]
            for name, row in conditions.items()
        }
        for group in groups
    }
    means = None if reference is None else {name: _mean(rows) for name, rows in curves[reference.label].items()}
    return {
        "bound": BOUND,
        "reference": None if reference is None else reference.label,
        "sweeps": {name: {**asdict(sweep), "strengths": list(sweep.strengths)} for name, sweep in sweeps.items()},
        "groups": {
            group.label: {
                **group.to_json(),
                "clean": _clean(group, conditions, found),
                **_scores(sweeps, curves[group.label], means),
            }
            for group in groups
        },
    }


def motion_over_seeds(groups: Sequence[Group], networks: Mapping[str, Mapping[str, Tree]]) -> Tree:
    """Scores of `temporal` over the seeds of each group: group -> variant -> score; None if a network lacks it.

    networks: run's name -> variant -> score -> number.
    """
    found: Tree = {}
    for group in groups:
        rows = [networks[run.name] for run in group.runs]
        found[group.label] = {
            variant: {
                score: None if None in values else over_seeds(values)
                for score, values in ((score, [row[variant][score] for row in rows]) for score in scores)
            }
            for variant, scores in rows[0].items()
        }
    return found


def corruption_error(curve: Sequence[float], reference: Sequence[float]) -> float | None:
    """Summed errors of one sweep over the reference's, both without the clean one; None if the reference has none."""
    errors = sum(1 - accuracy for accuracy in reference[1:])
    return sum(1 - accuracy for accuracy in curve[1:]) / errors if errors else None


def relative_robustness(curve: Sequence[float]) -> float | None:
    """Mean accuracy of one sweep without the clean one, over the clean accuracy; None if that is 0."""
    return sum(curve[1:]) / ((len(curve) - 1) * curve[0]) if curve[0] else None


def falls_below(strengths: Sequence[float], curve: Sequence[float]) -> float | None:
    """Strength at which accuracy first falls below `BOUND`, interpolated linearly; None if it never does.

    It is the first strength if accuracy is below the bound there already.
    """
    if curve[0] < BOUND:
        return strengths[0]
    for (low, before), (high, after) in pairwise(zip(strengths, curve, strict=True)):
        if after < BOUND:
            return round(low + (before - BOUND) / (before - after) * (high - low), 4)
    return None


def _mean(rows: Sequence[Sequence[float]]) -> list[float]:
    """Mean over seeds at each strength."""
    return [statistics.mean(values) for values in zip(*rows, strict=True)]


def _clean(group: Group, conditions: Mapping[str, Sequence[Condition]], found: Accuracies) -> Tree:
    """Accuracy on the clean stored and the clean rendered images, as far as the sweeps have them."""
    needed = {row[0] for row in conditions.values()}
    return {
        origin: over_seeds([found[run.name][clean] for run in group.runs])
        for origin, clean in CLEAN.items()
        if clean in needed
    }


def _scores(
    sweeps: Mapping[str, Sweep], curves: Mapping[str, list[list[float]]], reference: Mapping[str, list[float]] | None
) -> Tree:
    """Scores of one group from its accuracies, sweep -> seed -> strength."""
    counted = [name for name, sweep in sweeps.items() if sweep.counts]
    robustness = {name: [relative_robustness(row) for row in curves[name]] for name in counted}
    errors = (
        None
        if reference is None
        else {name: [corruption_error(row, reference[name]) for row in curves[name]] for name in counted}
    )
    return {
        "curves": {name: _curve(rows) for name, rows in curves.items()},
        "falls_below_bound_at": {
            name: {
                "mean": falls_below(sweep.strengths, _mean(curves[name])),
                "seeds": [falls_below(sweep.strengths, row) for row in curves[name]],
            }
            for name, sweep in sweeps.items()
        },
        "worst": _worst(sweeps, curves),
        "mrr": _over_sweeps(robustness),
        "mce": None if errors is None else _over_sweeps(errors),
    }


def _curve(rows: Sequence[Sequence[float]]) -> Tree:
    points = [over_seeds(values) for values in zip(*rows, strict=True)]
    seeds = [[round(value, 5) for value in row] for row in rows]
    return {name: [point[name] for point in points] for name in ("mean", "sd")} | {"seeds": seeds}


def _over_sweeps(values: Mapping[str, Sequence[float | None]]) -> Tree | None:
    """Mean over sweeps for every seed, and each sweep's mean over seeds; None if any number is missing."""
    complete = {name: [value for value in row if value is not None] for name, row in values.items()}
    if not values or any(len(complete[name]) < len(row) for name, row in values.items()):
        return None
    by_sweep = {name: round(statistics.mean(row), 5) for name, row in complete.items()}
    return over_seeds([statistics.mean(row) for row in zip(*complete.values(), strict=True)]) | {"sweeps": by_sweep}


def _worst(sweeps: Mapping[str, Sweep], curves: Mapping[str, list[list[float]]]) -> Tree:
    """The sweep and strength, clean ones aside, at which the mean over seeds is lowest."""
    lowest, name, index = min(
        (accuracy, name, index) for name, rows in curves.items() for index, accuracy in enumerate(_mean(rows)) if index
    )
    return {"sweep": name, "strength": sweeps[name].strengths[index], "accuracy": round(lowest, 5)}
