"""Claims of section 4 of the paper about Figs. 5 to 9, as statements that our figures bear out or do not.

Where the paper gives no number ("highly robust"), the bound is ours and stands in the statement. A statement is tested
by means over seeds; differences are taken between networks of one seed.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, Final

from benches.model.variants.scores import SWEEPS, TABLE, Condition, Sweep
from benches.model.variants.verdicts import REAL, Scores, above, differences, lower_is_better
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


def claims(
    scores_of: Callable[[Collection[int]], ScoresOf],
    seeds: Mapping[VariantName, Collection[int]],
    real: Scores | None = None,
) -> list[Tree]:
    """Every statement with the section it is from, the paper's number if it gives one, ours, and whether it holds.

    scores_of: for some seeds, which all variants that a statement is about have. seeds: those of each variant's
    networks; statements about variants that have none in common are left out. real: scores on real frames, if there
    are any. holds: None where a subset that it needs is missing.
    """
    found = []
    for statements, variants in _STATEMENTS:
        common = set.intersection(*(set(seeds.get(variant, ())) for variant in variants))
        found += statements(scores_of(common)) if common else []
    return found + (_real(real) if real is not None else [])


def _claim(section: str, statement: str, paper: Any, ours: Any, holds: bool | None) -> Tree:
    return {"section": section, "claim": statement, "paper": paper, "ours": ours, "holds": holds}


def _whole_set(scores_of: ScoresOf) -> list[Tree]:
    ours = over_seeds(accuracies(scores_of, "all", TABLE["all"]))
    statement = "trained on X_all, the average per-class accuracy on its test images is at least 81.3 %"
    return [_claim("4.1", statement, 0.813, ours, ours["mean"] >= 0.813)]


def _edges(scores_of: ScoresOf) -> list[Tree]:
    wrong, pixels = [], []
    for found in scores_of("all", TABLE["all"]):
        rows = [
            (row["distance"] in _EDGE_BINS, row["pixels"], row["wrong"] or 0) for row in found["border_distance_px"]
        ]
        wrong.append(
            sum(at * count * share for at, count, share in rows) / max(1, sum(n * each for _, n, each in rows))
        )
        pixels.append(sum(at * count for at, count, _ in rows) / max(1, sum(count for _, count, _ in rows)))
    ours = {"wrong_pixels_at_edges": over_seeds(wrong), "all_pixels_at_edges": over_seeds(pixels)}
    statement = "most of the wrong pixels lie at edges of parts: within 4 pixels (13 mm) of another part"
    return [_claim("4.1, Fig. 5", statement, None, ours, ours["wrong_pixels_at_edges"]["mean"] > 0.5)]


def _confidence(scores_of: ScoresOf) -> list[Tree]:
    found = scores_of("all", TABLE["all"])
    above = [each["confidence"]["above_70_percent"] for each in found]
    before = over_seeds([each[_ACCURACY] for each in found])
    after = over_seeds([each[_ACCURACY] or 0 for each in above])
    dropped = over_seeds([1 - each["share_of_pixels"] for each in above])
    paper, ours = ({first: one, "its pixels above 70 %": other} for first, one, other in (
        ("one image", 0.911, 0.978), ("test set", before, after)
    ))  # fmt: skip
    higher = "without the pixels of less than 70 % confidence, accuracy is higher"
    share = "that discards no more than 18 % of the test set's pixels"
    return [
        _claim("4.1, Fig. 5", higher, paper, ours, after["mean"] > before["mean"]),
        _claim("4.1, Fig. 5", share, 0.18, dropped, dropped["mean"] <= 0.18),
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
    people = "of all subsets, the one of many people in one posture (CAESAR; here: people) is segmented best"
    postures = "subject A, of many postures, is segmented worse than the whole test set"
    a = {"A": means.get("A"), "test set": round(whole, 5)}
    papers_a = {"A": 0.781, "test set": 0.813}
    return [
        _claim("4.1, Fig. 6", people, None, ours, best == "people" if "people" in means else None),
        _claim("4.1, Fig. 6", postures, papers_a, a, means["A"] < whole if "A" in means else None),
    ]


def _noise(scores_of: ScoresOf) -> list[Tree]:
    sweep = SWEEPS["noise"]
    others = (
        f"so do networks that never saw noise, at most {{}} points at {_SIGMA_MM} mm: robustness is 'implicitly "
        "embedded in the architecture'"
    )
    gains = _gains(scores_of, sweep)
    more = (
        "over this sweep, training with missing data and training with occlusions each gain more on none than "
        "training with noise does"
    )
    holds = min(gains["md"]["mean"], gains["occ"]["mean"]) > gains["noise"]["mean"]
    own = f"noise and all lose at most {{}} points at a sigma of {_SIGMA_MM} mm"
    return [
        _loses_little("4.2, Fig. 7", own, _lost(scores_of, ("noise", "all"), sweep, _SIGMA_MM)),
        _loses_little("4.2", others, _lost(scores_of, ("none", "occ", "md"), sweep, _SIGMA_MM)),
        _claim("4.2", more, None, {"points gained on none": gains}, holds),
    ]


def _missing_data(scores_of: ScoresOf) -> list[Tree]:
    sweep = SWEEPS["missing"]
    half = f"{_MISSING:.0%} missing".replace("%", " %")
    none = {
        name: over_seeds(accuracies(scores_of, "none", sweep.at(share)))
        for name, share in (("0 % missing", 0), (half, _MISSING))
    }
    collapses = "trained on none, accuracy collapses: at 50 % missing data it is less than half of that at 0 %"
    gains = _gains(scores_of, sweep)
    most = "over this sweep, training with missing data gains most on none, training with occlusions less, but gains"
    lost = _lost(scores_of, ("md", "all"), sweep, _MISSING)
    holds = gains["md"]["mean"] > gains["occ"]["mean"] > 0
    return [
        _claim("4.3, Fig. 8", collapses, None, none, none[half]["mean"] < none["0 % missing"]["mean"] / 2),
        _loses_little("4.3, Fig. 8", "md and all lose at most {} points at 50 % missing data", lost),
        _claim("4.3", most, None, {"points gained on none": gains}, holds),
    ]


def _everything(scores_of: ScoresOf) -> list[Tree]:
    behind: Tree = {}
    for name, condition in TABLE.items():
        means = {train: statistics.mean(accuracies(scores_of, train, condition)) for train in VARIANTS}
        best = max(means, key=lambda train: means[train])
        behind[name] = {"best": best, "points_behind": round(100 * (means[best] - means["all"]), 2)}
    holds = all(row["points_behind"] <= NEAR_BEST_POINTS for row in behind.values())
    statement = f"training on all artifacts is best, or within {NEAR_BEST_POINTS:g} point of it, on every test variant"
    return [_claim("4.2 to 4.4", statement, None, behind, holds)]


def _lost(scores_of: ScoresOf, variants: Sequence[VariantName], sweep: Sweep, strength: float) -> Tree:
    """Points of accuracy between strength 0 and `strength`."""
    ends = sweep.at(0), sweep.at(strength)
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


_STATEMENTS: Final[Sequence[tuple[Callable[[ScoresOf], list[Tree]], Sequence[VariantName]]]] = (
    (_whole_set, ("all",)),
    (_edges, ("all",)),
    (_confidence, ("all",)),
    (_subsets, ("all",)),
    (_noise, tuple(VARIANTS)),
    (_missing_data, tuple(VARIANTS)),
    (_everything, tuple(VARIANTS)),
)
"""Statements on rendered images, and the variants whose networks they are about."""


def _real(scores: Scores) -> list[Tree]:
    found = []
    means = {
        variant: {
            name: statistics.mean(seeds.values())
            for name, seeds in scores[variant].items()
            if REAL in name and not name.endswith("mean_mm")
        }
        for variant in VARIANTS
        if variant in scores
    }
    if len(means) == len(VARIANTS):
        ranked = {
            name: sorted(means, key=lambda row: means[row][name], reverse=lower_is_better(name))
            for name in means["none"]
        }
        statement = "on real frames, training without shadows and missing data (none, noise) is worst, by every measure"
        holds = all({*order[:2]} == {"none", "noise"} for order in ranked.values())
        found.append(_claim("4.4, Fig. 9", statement, None, {"from worst to best": ranked}, holds))
    gains = {name: each for name, each in differences(scores, "none").get("all", {}).items() if REAL in name}
    if gains:
        statement = "on real frames, training with all artifacts is better than with none, beyond the spread of seeds"
        holds = all(above(each) for each in gains.values())
        found.append(_claim("4.4, 5", f"{statement}, by every measure", None, {"points better": gains}, holds))
    return found
