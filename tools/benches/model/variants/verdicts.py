"""Verdicts on artifacts by a rule that was written before the trainings: what networks gain by them, and where."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from typing import Any, Final

from bodyseg_model.evaluation import over_seeds

Tree = dict[str, Any]
Series = Mapping[int, float]
"""Seed -> value of its network, a share."""
Scores = Mapping[str, Mapping[str, Series]]
"""Row -> measure -> values."""

DECIDE_POINTS: Final = 1.0
REAL: Final = "real: "
"""Begin of the names of measures on real frames; all others are on rendered images."""
ALTERED: Final = "altered: "
"""Begin of the names of measures on real frames with a harm of ours, which decide nothing."""

RULE: Final = (
    "An artifact stays if networks that are trained with it are better on real frames of a sensor that has it, or on "
    "rendered images that have its harm, by more than the spread of seeds, and nowhere else worse by more than that. "
    "More than the spread: the 95 % interval of the differences between networks of one seed does not reach 0. Real "
    f"frames decide only where the network without it loses at least {DECIDE_POINTS:g} point on them; elsewhere an "
    "artifact is untestable here and taken by its cost. One that gains a point or more, but within the spread, is "
    "undecided: longer trainings must tell."
)
_HARMED: Final[Mapping[str, Sequence[str]]] = {
    "occ": ("occ", "all"),
    "noise": ("noise", "all", "noise of 40 mm"),
    "md": ("md", "all", "half missing"),
    "all": ("occ", "noise", "md", "all", "noise of 40 mm", "half missing"),
    "mixture": ("all", "sensor"),
}
"""Row -> rendered test images that have its harm; those of any other row: `all`, and its own artifacts."""
_USUAL_BASES: Final = ("none", "all")
_BASES: Final[Mapping[str, Sequence[str]]] = {
    **dict.fromkeys(("occ", "noise", "md", "all"), ("none",)),
    "phase_shift": ("none", "all", "md"),
    "fitted": ("none", "all", "sensor"),
}
"""Row -> rows that it is compared with; any other with the usual ones."""
_NO_TEST: Final = ("all", "noise of 40 mm", "half missing", "hard", "flat")
"""Have every harm, or one that no sensor has: being worse there is nobody's loss elsewhere."""


def lower_is_better(measure: str) -> bool:
    """True of shares of errors."""
    return any(word in measure for word in ("beyond", "feet"))


def paired(ours: Series, base: Series, lower: bool = False) -> Tree | None:
    """Points by which a row is better, over the seeds that both have: `over_seeds`, and `interval`, the 95 % interval
    of the mean by Student's t, None for one seed. lower: the lower value is better. None without a common seed.
    """
    seeds = sorted({*ours} & {*base})
    if not seeds:
        return None
    points = [(-100 if lower else 100) * (ours[seed] - base[seed]) for seed in seeds]
    interval = None
    if len(points) > 1:
        from scipy.special import stdtrit

        half = float(stdtrit(len(points) - 1, 0.975)) * statistics.stdev(points) / math.sqrt(len(points))
        interval = [round(statistics.mean(points) + way * half, 2) for way in (-1, 1)]
    return over_seeds(points, 2) | {"interval": interval}


def differences(scores: Scores, base: str) -> dict[str, dict[str, Tree]]:
    """Row -> measure -> points by which it is better than the row `base`, of all shares that both have."""
    found = {}
    for row, measures in scores.items():
        if row != base and base in scores:
            pairs = {
                name: paired(values, scores[base].get(name, {}), lower_is_better(name))
                for name, values in measures.items()
                if not name.endswith("mean_mm")
            }
            found[row] = {name: pair for name, pair in pairs.items() if pair is not None}
    return found


def verdicts(scores: Scores, ms: Mapping[str, float]) -> list[Tree]:
    """A verdict by `RULE` on every row against `none`, and on rows of further artifacts against what they replace.

    ms: row -> processor time of a sample in the loader.
    """
    against = {base: differences(scores, base) for base in {*_USUAL_BASES}.union(*_BASES.values())}
    found = []
    for row in (row for row in scores if row != "none"):
        for base in _BASES.get(row, _USUAL_BASES):
            if row in against[base] and "/" not in row:
                cost = round(ms[row] - ms[base], 3) if row in ms and base in ms else None
                found.append(_verdict(row, base, against[base][row]) | {"ms_a_sample": cost})
    return found


def _verdict(row: str, base: str, gains: Mapping[str, Tree]) -> Tree:
    gains = {name: gain for name, gain in gains.items() if not name.startswith(ALTERED)}
    real = [name for name in gains if name.startswith(REAL)]
    harmed = [name for name in _HARMED.get(row, ("all", row)) if name in gains]
    elsewhere = real + [name for name in gains if name not in (*real, *harmed, *_NO_TEST)]
    decides = [name for name in real if gains[name]["mean"] >= DECIDE_POINTS]
    better_real = [name for name in decides if above(gains[name])]
    better_rendered = [name for name in harmed if above(gains[name])]
    worse = [name for name in elsewhere if _below(gains[name])]
    if any(each["interval"] is None for each in gains.values()):
        outcome = "undecided: one seed"
    elif better_real or better_rendered:
        outcome = "gains and loses" if worse else "stays" if better_real else "stays, by rendered images alone"
    elif decides or any(gains[name]["mean"] >= DECIDE_POINTS for name in harmed):
        outcome = "undecided: seeds differ"
    else:
        outcome = "goes" if worse else "untestable here"
    return {
        "row": row,
        "against": base,
        "verdict": outcome,
        "better_real": better_real,
        "better_rendered": better_rendered,
        "worse": worse,
    }


def above(gain: Tree) -> bool:
    """True if the interval of a difference lies above 0."""
    return gain["interval"] is not None and gain["interval"][0] > 0


def _below(gain: Tree) -> bool:
    return gain["interval"] is not None and gain["interval"][1] < 0
