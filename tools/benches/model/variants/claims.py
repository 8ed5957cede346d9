"""Claims of section 4 of the paper about Figs. 5 to 8, as statements that our figures bear out or do not.

Where the paper gives no number ("highly robust"), the bound is ours and stands in the statement. A statement is tested
by means over seeds; differences are taken between networks of one seed.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from typing import Any, Final

from benches.model.variants.scores import SWEEPS, SWEEPS_ALONE, TABLE, Condition, Sweep
from bodyseg_data.artifacts import VARIANTS, VariantName
from bodyseg_model.evaluation import over_seeds

Tree = dict[str, Any]
ScoresOf = Callable[[VariantName, Condition], list[Tree]]
"""(training variant, test images) -> the scores of its networks, one a seed."""

ROBUST_POINTS: Final = 2.0
NEAR_BEST_POINTS: Final = 1.0
_SIGMA_MM: Final = 40
_MISSING: Final = 0.5
_EDGE_BINS: Final = ("1", "1-2", "2-4")
_ACCURACY: Final = "average_per_class_accuracy"


def accuracies(scores_of: ScoresOf, variant: VariantName, condition: Condition) -> list[float]:
    """Average per-class accuracy of the networks trained on `variant`, one a seed."""
    return [found[_ACCURACY] for found in scores_of(variant, condition)]


def claims(scores_of: ScoresOf, alone: bool) -> list[Tree]:
    """Every statement with the section it is from, the paper's number if it gives one, ours, and whether it holds.

    holds: None where a subset that it needs is missing. alone: whether the sweeps without other artifacts were
    measured.
    """
    return [
        *_whole_set(scores_of),
        *_edges(scores_of),
        *_confidence(scores_of),
        *_subsets(scores_of),
        *_noise(scores_of, alone),
        *_missing_data(scores_of, alone),
        *_everything(scores_of),
    ]


def _claim(section: str, statement: str, paper: Any, ours: Any, holds: bool | None) -> Tree:
    return {"section": section, "claim": statement, "paper": paper, "ours": ours, "holds": holds}


def _whole_set(scores_of: ScoresOf) -> list[Tree]:
    ours = over_seeds(accuracies(scores_of, "all", TABLE["all"]))
    statement = "trained on X_all, the average per-class accuracy on its test images is at least 81.3 %"
    return [_claim("4.1", statement, 0.813, ours, ours["mean"] >= 0.813)]


def _edges(scores_of: ScoresOf) -> list[Tree]:
    wrong, pixels = [], []
    for found in scores_of("all", TABLE["all"]):
        bins = {row["distance"]: row for row in found["border_distance_px"]}
        count = {name: row["pixels"] * (row["wrong"] or 0) for name, row in bins.items()}
        wrong.append(sum(count[name] for name in _EDGE_BINS) / max(1, sum(count.values())))
        pixels.append(
            sum(bins[name]["pixels"] for name in _EDGE_BINS) / max(1, sum(row["pixels"] for row in bins.values()))
        )
    ours = {"wrong_pixels_at_edges": over_seeds(wrong), "all_pixels_at_edges": over_seeds(pixels)}
    statement = "most of the wrong pixels lie at edges of parts: within 4 pixels (13 mm) of another part"
    return [_claim("4.1, Fig. 5", statement, None, ours, ours["wrong_pixels_at_edges"]["mean"] > 0.5)]


def _confidence(scores_of: ScoresOf) -> list[Tree]:
    found = scores_of("all", TABLE["all"])
    above = [each["confidence"]["above_70_percent"] for each in found]
    before, after = (
        over_seeds([each[_ACCURACY] for each in found]),
        over_seeds([each[_ACCURACY] or 0 for each in above]),
    )
    dropped = over_seeds([1 - each["share_of_pixels"] for each in above])
    return [
        _claim(
            "4.1, Fig. 5",
            "without the pixels of less than 70 % confidence, accuracy is higher",
            {"one image": 0.911, "its pixels above 70 %": 0.978},
            {"test set": before, "its pixels above 70 %": after},
            after["mean"] > before["mean"],
        ),
        _claim(
            "4.1, Fig. 5",
            "that discards no more than 18 % of the test set's pixels",
            0.18,
            dropped,
            dropped["mean"] <= 0.18,
        ),
    ]


def _subsets(scores_of: ScoresOf) -> list[Tree]:
    found = scores_of("all", TABLE["all"])
    whole = statistics.mean(each[_ACCURACY] for each in found)
    ours = {
        name: over_seeds([each["subsets"][name][_ACCURACY] for each in found])
        for name, scores in found[0]["subsets"].items()
        if scores[_ACCURACY] is not None
    }
    means = {name: value["mean"] for name, value in ours.items()}
    best = max(means, key=lambda name: means[name])
    return [
        _claim(
            "4.1, Fig. 6",
            "of all subsets, the one of many people in one posture (CAESAR; here: people) is segmented best",
            None,
            ours,
            best == "people" if "people" in means else None,
        ),
        _claim(
            "4.1, Fig. 6",
            "subject A, of many postures, is segmented worse than the whole test set",
            {"A": 0.781, "test set": 0.813},
            {"A": means.get("A"), "test set": round(whole, 5)},
            means["A"] < whole if "A" in means else None,
        ),
    ]


def _noise(scores_of: ScoresOf, alone: bool) -> list[Tree]:
    sweep = SWEEPS["noise"]
    lost = _lost(scores_of, ("noise", "all"), sweep, _SIGMA_MM)
    others = _lost(scores_of, ("none", "occ", "md"), sweep, _SIGMA_MM)
    gains = _gains(scores_of, sweep)
    found = [
        _loses_little("4.2, Fig. 7", f"noise and all lose at most {{}} points at a sigma of {_SIGMA_MM} mm", lost),
        _loses_little(
            "4.2",
            f"so do networks that never saw noise, at most {{}} points at {_SIGMA_MM} mm: robustness is 'implicitly "
            "embedded in the architecture'",
            others,
        ),
        _claim(
            "4.2",
            "over this sweep, training with missing data and training with occlusions each gain more on none than "
            "training with noise does",
            None,
            {"points gained on none": gains},
            min(gains["md"]["mean"], gains["occ"]["mean"]) > gains["noise"]["mean"],
        ),
    ]
    if alone:
        lost = _lost(scores_of, ("noise", "all"), SWEEPS_ALONE["noise_alone"], _SIGMA_MM)
        statement = f"without other artifacts, noise and all lose at most {{}} points at a sigma of {_SIGMA_MM} mm"
        found.append(_loses_little("4.2", statement, lost))
    return found


def _missing_data(scores_of: ScoresOf, alone: bool) -> list[Tree]:
    sweep = SWEEPS["missing"]
    start, half = _at(sweep, 0), _at(sweep, _MISSING)
    none = {
        "0 % missing": over_seeds(accuracies(scores_of, "none", start)),
        "50 % missing": over_seeds(accuracies(scores_of, "none", half)),
    }
    gains = _gains(scores_of, sweep)
    found = [
        _claim(
            "4.3, Fig. 8",
            "trained on none, accuracy collapses: at 50 % missing data it is less than half of that at 0 %",
            None,
            none,
            none["50 % missing"]["mean"] < none["0 % missing"]["mean"] / 2,
        ),
        _loses_little(
            "4.3, Fig. 8",
            "md and all lose at most {} points at 50 % missing data",
            _lost(scores_of, ("md", "all"), sweep, _MISSING),
        ),
        _claim(
            "4.3",
            "over this sweep, training with missing data gains most on none, training with occlusions less, but gains",
            None,
            {"points gained on none": gains},
            gains["md"]["mean"] > gains["occ"]["mean"] > 0,
        ),
    ]
    if alone:
        lost = _lost(scores_of, ("md", "all"), SWEEPS_ALONE["missing_alone"], _MISSING)
        statement = "without other artifacts, md and all lose at most {} points at 50 % missing data"
        found.append(_loses_little("4.3", statement, lost))
    return found


def _everything(scores_of: ScoresOf) -> list[Tree]:
    behind: Tree = {}
    for name, condition in TABLE.items():
        means = {train: statistics.mean(accuracies(scores_of, train, condition)) for train in VARIANTS}
        best = max(means, key=lambda train: means[train])
        behind[name] = {"best": best, "points_behind": round(100 * (means[best] - means["all"]), 2)}
    holds = all(row["points_behind"] <= NEAR_BEST_POINTS for row in behind.values())
    statement = f"training on all artifacts is best, or within {NEAR_BEST_POINTS:g} point of it, on every test variant"
    return [_claim("4.2 to 4.4", statement, None, behind, holds)]


def _at(sweep: Sweep, strength: float) -> Condition:
    return sweep.conditions[sweep.strengths.index(strength)]


def _lost(scores_of: ScoresOf, variants: Sequence[VariantName], sweep: Sweep, strength: float) -> Tree:
    """Points of accuracy between strength 0 and `strength`."""
    ends = _at(sweep, 0), _at(sweep, strength)
    found: Tree = {}
    for variant in variants:
        pairs = zip(*(accuracies(scores_of, variant, condition) for condition in ends), strict=True)
        found[variant] = over_seeds([100 * (clean - worse) for clean, worse in pairs], decimals=2)
    return found


def _loses_little(section: str, statement: str, lost: Tree) -> Tree:
    holds = all(points["mean"] <= ROBUST_POINTS for points in lost.values())
    return _claim(section, statement.format(f"{ROBUST_POINTS:g}"), None, {"points lost": lost}, holds)


def _gains(scores_of: ScoresOf, sweep: Sweep) -> dict[str, Tree]:
    """Points of accuracy, mean over the strengths of a sweep, that training with one artifact gains on none."""
    means = {
        variant: [
            statistics.mean(seed)
            for seed in zip(*(accuracies(scores_of, variant, condition) for condition in sweep.conditions), strict=True)
        ]
        for variant in VARIANTS
    }
    return {
        variant: over_seeds([100 * (ours - none) for ours, none in zip(means[variant], means["none"], strict=True)], 2)
        for variant in ("occ", "noise", "md")
    }
