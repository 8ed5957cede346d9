"""From accuracies to curves over seeds, mCE, mRR, the worst case, and where accuracy falls below 60 %.

mCE is Hendrycks and Dietterich's mean corruption error ("Benchmarking neural network robustness to common corruptions
and perturbations", 2019) with accuracy per class in place of their top-1. For one sweep, the error 1 - accuracy summed
over severities is divided by that of the reference; mCE is the mean over sweeps. mRR is the mean over sweeps of the
accuracy summed over severities, divided by as many times the accuracy at the clean end. The clean end is no severity.
"""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any, Final

from bodyseg_model.evaluation.report import over_seeds
from bodyseg_model.stability.examining import Accuracies
from bodyseg_model.stability.groups import Group
from bodyseg_model.stability.severities import CLEAN, Setting, Sweep

Tree = dict[str, Any]

BOUND: Final = 0.6


def summarise(groups: Sequence[Group], sweeps: Mapping[str, Sweep], found: Accuracies, reference: Group | None) -> Tree:
    """The part of stability.json that is about images; plain JSON. found: holds every setting of the sweeps."""
    settings = {name: sweep.settings(name) for name, sweep in sweeps.items()}
    curves = {
        group.label: {
            name: [[found[run.name][setting] for setting in row] for run in group.runs]
            for name, row in settings.items()
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
                "clean": _clean(group, settings, found),
                **_of_curves(sweeps, curves[group.label], means),
            }
            for group in groups
        },
    }


def motion_over_seeds(groups: Sequence[Group], networks: Mapping[str, Mapping[str, Tree]]) -> Tree:
    """Group -> variant of the frames -> score of `temporal` over seeds; None for one that a network has none of.

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
    """The errors of one sweep's accuracies, the clean end's left out, over the reference's; None if that has none."""
    errors = sum(1 - accuracy for accuracy in reference[1:])
    return sum(1 - accuracy for accuracy in curve[1:]) / errors if errors else None


def relative_robustness(curve: Sequence[float]) -> float | None:
    """The mean of one sweep's accuracies, the clean end's left out, over the clean end's; None if that is 0."""
    return sum(curve[1:]) / ((len(curve) - 1) * curve[0]) if curve[0] else None


def falls_below(strengths: Sequence[float], curve: Sequence[float], bound: float = BOUND) -> float | None:
    """The strength at which accuracy first falls below `bound`, on straight lines between strengths; None: never.

    The first strength if it is below there already.
    """
    if curve[0] < bound:
        return strengths[0]
    for place in range(1, len(curve)):
        before, after = curve[place - 1], curve[place]
        if after < bound:
            share = (before - bound) / (before - after)
            return round(strengths[place - 1] + share * (strengths[place] - strengths[place - 1]), 4)
    return None


def _mean(rows: Sequence[Sequence[float]]) -> list[float]:
    """Over seeds, strength by strength."""
    return [statistics.mean(values) for values in zip(*rows, strict=True)]


def _clean(group: Group, settings: Mapping[str, Sequence[Setting]], found: Accuracies) -> Tree:
    """Accuracy on the clean images of the set, and on the same bodies drawn anew, as far as sweeps need them."""
    needed = {row[0] for row in settings.values()}
    return {
        origin: over_seeds([found[run.name][clean] for run in group.runs])
        for origin, clean in CLEAN.items()
        if clean in needed
    }


def _of_curves(
    sweeps: Mapping[str, Sweep], curves: Mapping[str, list[list[float]]], reference: Mapping[str, list[float]] | None
) -> Tree:
    """What follows from one group's accuracies, sweep -> seed -> strength."""
    counted = [name for name, sweep in sweeps.items() if sweep.counts]
    robust = {name: [relative_robustness(row) for row in curves[name]] for name in counted}
    wrong = (
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
        "mrr": _over_sweeps(robust),
        "mce": None if wrong is None else _over_sweeps(wrong),
    }


def _curve(rows: Sequence[Sequence[float]]) -> Tree:
    points = [over_seeds(values) for values in zip(*rows, strict=True)]
    seeds = [[round(value, 5) for value in row] for row in rows]
    return {name: [point[name] for point in points] for name in ("mean", "sd")} | {"seeds": seeds}


def _over_sweeps(values: Mapping[str, Sequence[float | None]]) -> Tree | None:
    """The mean over sweeps, for every seed, and each sweep's mean over seeds; None if there is no number for one."""
    complete = {name: [value for value in row if value is not None] for name, row in values.items()}
    if not values or any(len(complete[name]) < len(row) for name, row in values.items()):
        return None
    by_sweep = {name: round(statistics.mean(row), 5) for name, row in complete.items()}
    return over_seeds([statistics.mean(row) for row in zip(*complete.values(), strict=True)]) | {"sweeps": by_sweep}


def _worst(sweeps: Mapping[str, Sweep], curves: Mapping[str, list[list[float]]]) -> Tree:
    """The strength at which the mean over seeds is lowest."""
    lowest, name, place = min(
        (accuracy, name, place) for name, rows in curves.items() for place, accuracy in enumerate(_mean(rows)) if place
    )
    return {"sweep": name, "strength": sweeps[name].strengths[place], "accuracy": round(lowest, 5)}
