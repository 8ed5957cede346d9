"""Rows of `bench ablation`: effects that may be more than a scene needs, and the rule that judges a row.

A row is one training, or several by seed, that differs from the base in one effect: left out, or added.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Literal

from benches.model.ablation.conditions import STEPS_MM
from bodyseg_data.artifacts import Losses, MissingData, Noise, SensorModel, VariantName, load_sensor_model

Tree = dict[str, Any]
Source = Literal["", "dressed", "bare"]
Group = Literal["artifacts", "sub-kinds", "bodies", "views", "image", "network", "amount"]

BASE: Final = "all"
LEAST_POINTS: Final = 0.3
DEVIATIONS: Final = 2.0
NEAR_POINTS: Final = 1.0
"""How far behind the full set a smaller one may be to be called enough."""
LOSSES_SOUGHT_ON: Final = (BASE, "none")  # on fifteen kinds of images some difference would look like a loss by chance

RULE: Final = (
    f"An effect pays if accuracy with it is more than {LEAST_POINTS:g} points and more than {DEVIATIONS:g} standard "
    "deviations of the difference above that without it, on at least one kind of test images that it is meant to help. "
    f"Undecided: more than {LEAST_POINTS:g} points above, but within those deviations, so more seeds are wanted. "
    "It harms where accuracy is as much lower with it, on images with all artifacts or with none. "
    "Of one training of the base the deviation is not known, so differences between trainings are undecided at most."
)


@dataclass(frozen=True)
class AblationRow:
    """One effect that can be left out.

    name: of its trainings' folders, NAME-SEED. what: left out, in words; added, where `added`. helps: labels of the
    conditions that it is meant to help. variant, only, sensor: of the images trained on. settings: those of the
    network that differ from the base's. against: the row that has all but this effect. arguments: for `bodyseg train`;
    None if nothing is trained: the base's networks are tested with `step_mm`. source: of the training set.
    """

    name: str
    what: str
    group: Group
    helps: tuple[str, ...] = ("all",)
    arguments: tuple[str, ...] | None = ()
    variant: VariantName = "all"
    only: tuple[str, ...] = ()
    sensor: SensorModel = field(default_factory=load_sensor_model)
    settings: Mapping[str, Any] = field(default_factory=dict)
    against: str = BASE
    added: bool = False
    step_mm: float | None = None
    source: Source = ""


def _only(name: str, what: str, group: Group, *patterns: str, **more: Any) -> AblationRow:
    return AblationRow(name, what, group, arguments=("--only", *patterns), only=patterns, **more)


def _settings(name: str, what: str, group: Group, text: str, **settings: Any) -> AblationRow:
    return AblationRow(name, what, group, arguments=("--settings", text), settings=settings)


ROW_OF_BASE: Final = AblationRow(BASE, "nothing", "artifacts")

_SPREAD: Final = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)
_LOSSES: Final = 0.4
_PAPER: Final = load_sensor_model()

ROWS: Final = (
    AblationRow("no_occlusion", "shadows", "artifacts", arguments=("--variant", "noise+md"), variant="noise+md"),
    AblationRow(
        "no_noise", "noise", "artifacts", ("all", "noise_80"), arguments=("--variant", "occ+md"), variant="occ+md"
    ),
    AblationRow(
        "no_missing",
        "missing pixels",
        "artifacts",
        ("all", "missing_50"),
        arguments=("--variant", "occ+noise"),
        variant="occ+noise",
    ),
    AblationRow(
        "noise_50",
        "noise of more than 50 mm",
        "sub-kinds",
        ("all", "noise_80"),
        ("--noise-mm", "50"),
        sensor=_PAPER.with_artifacts(Noise(0, 50)),
    ),
    AblationRow(
        "missing_spread",
        "six shares of missing pixels, not three",
        "sub-kinds",
        ("all", "missing_50"),
        ("--missing", *(f"{share:g}" for share in _SPREAD)),
        sensor=_PAPER.with_artifacts(MissingData(_SPREAD)),
        added=True,
    ),
    AblationRow(
        "losses",
        "patches, stripes lost",
        "sub-kinds",
        ("patches_30", "stripes_30"),
        ("--losses", f"{_LOSSES:g}"),
        sensor=_PAPER.with_artifacts(Losses(_LOSSES)),
        added=True,
    ),
    AblationRow("dressed_233", "all but 233 bodies", "amount", source="dressed"),
    AblationRow("no_clothes", "clothes", "bodies", ("dressed",), against="dressed_233", source="bare"),
    _only("no_people", "583 people of all shapes", "bodies", "open-[ABC]-*", helps=("all", "people")),
    _only("only_people", "postures and motions", "bodies", "open-P*", helps=("all", "A", "B", "C", "hard")),
    _only("one_distance", "2.15 m and 2.95 m", "views", "*-d255-*", helps=("near_far",), against="views_6"),
    _only("half_turn", "azimuths beyond 90 degrees", "views", "*-a0?0", helps=("other_side",), against="views_9"),
    _settings("half_resolution", "three of four pixels", "image", '{"shrink": 2, "patch": 8}', shrink=2, patch=8),
    _settings("quarter_resolution", "15 of 16 pixels", "image", '{"shrink": 4, "patch": 4}', shrink=4, patch=4),
    *(
        AblationRow(f"step_{step}mm", f"steps finer than {step} mm", "image", ("all", "none"), None, step_mm=step)
        for step in STEPS_MM
    ),
    _settings("no_context", "the mean over the body", "network", '{"context": false}', context=False),
    _only("bodies_half", "every second body", "amount", "*[02468]-d*"),
    _only("bodies_fifth", "4 of 5 bodies", "amount", "*[05]-d*"),
    _only("bodies_tenth", "9 of 10 bodies", "amount", "*0-d*"),
    _only("bodies_50th", "49 of 50 bodies", "amount", "*[05]0-d*"),
    _only("views_9", "every second view", "amount", "*-a?[02468]0"),
    _only("views_6", "2 of 3 views", "amount", *(f"*-a{azimuth:03d}" for azimuth in (0, 30, 70, 100, 140, 170))),
    _only("views_3", "5 of 6 views", "amount", "*-a000", "*-a070", "*-a140"),
    _only("views_1", "17 of 18 views", "amount", "*-a000"),
)


def deviation_of(base: Mapping[str, Sequence[float]]) -> dict[str, float] | None:
    """AblationCondition -> standard deviation over seeds, in points; None for one seed. base: condition -> accuracies.

    It is the larger of the condition's own and the root mean square of all: the deviation of three seeds alone may be
    small by chance.
    """
    if min(map(len, base.values())) < 2:
        return None
    own = {name: 100 * statistics.stdev(values) for name, values in base.items()}
    usual = math.sqrt(statistics.mean(value**2 for value in own.values()))
    return {name: max(value, usual) for name, value in own.items()}


def worth(
    have: Mapping[str, Sequence[float]], lack: Mapping[str, Sequence[float]], spread: Mapping[str, float] | None
) -> Tree:
    """Gain of an effect under each condition that both have, in points of accuracy.

    have, lack: condition -> accuracy of each seed's network with the effect, and without. sd: of the difference of the
    two means, if every network scatters by `spread`; threshold: above which it counts.
    """
    found: Tree = {}
    for name in have:
        if name in lack:
            points = 100 * (statistics.mean(have[name]) - statistics.mean(lack[name]))
            sd = None if spread is None else spread[name] * math.sqrt(1 / len(have[name]) + 1 / len(lack[name]))
            threshold = max(LEAST_POINTS, DEVIATIONS * (sd or 0.0))
            found[name] = {
                "points": round(points, 2),
                "sd": None if sd is None else round(sd, 2),
                "threshold": round(threshold, 2),
            }
    return found


def verdict(found: Mapping[str, Tree], helps: Sequence[str], decided: bool = True) -> Tree:
    """`RULE` applied to what `worth` found. decided: False if the scatter of trainings is not known, but matters."""
    meant = [name for name in helps if name in found]
    pays = [name for name in meant if decided and found[name]["points"] > found[name]["threshold"]]
    sought = [name for name in LOSSES_SOUGHT_ON if decided and name in found]
    harms = [name for name in sought if found[name]["points"] < -found[name]["threshold"]]
    perhaps = any(found[name]["points"] > LEAST_POINTS for name in meant)
    word = "pays" if pays else "undecided" if perhaps else "does not pay"
    return {"verdict": word, "pays_on": pays, "harms_on": harms}


def enough(rows: Iterable[Tree], prefix: str) -> str | None:
    """The smallest of the sets called after `prefix` with at most `NEAR_POINTS` less on `all`; None if none has."""
    near = [row for row in rows if row["name"].startswith(prefix) and row["worth"][BASE]["points"] <= NEAR_POINTS]
    return min(near, key=lambda row: row["samples"])["name"] if near else None


def table(figures: Tree) -> str:
    """The rows of `bench_ablation`'s results as a table of Markdown."""
    titles = {condition["name"]: condition["title"] for condition in figures["conditions"]}
    lines = [
        "| left out (+ added) | seeds | accuracy on `all`, % | worth there, points | worth where it is meant to help "
        "| verdict | cost with → without |",
        "| --- | --- | --- | --- | --- | --- | --- |",
        f"| nothing | {len(figures['base'][BASE]['seeds'])} | {_accuracy(figures['base'][BASE])} | | | | |",
    ]
    for row in figures["rows"]:
        value = row["worth"]
        helps = [f"{titles[name]}: {_points(value[name])}" for name in row["helps"] if name in value and name != BASE]
        cells = (
            f"{'+ ' if row['added'] else ''}{row['what']} (`{row['name']}`)",
            str(len(row["accuracy"][BASE]["seeds"])),
            _accuracy(row["accuracy"][BASE]),
            _points(value[BASE]),
            "; ".join(helps),
            _verdict_text(row, titles),
            "; ".join(map(_cost, row["cost"])),
        )
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _accuracy(value: Tree) -> str:
    spread = "" if value["sd"] is None else f" ± {100 * value['sd']:.1f}"
    return f"{100 * value['mean']:.1f}{spread}"


def _points(value: Tree) -> str:
    spread = "" if value["sd"] is None else f" ± {value['sd']:.1f}"
    return f"{value['points']:+z.1f}{spread}".replace("-", "−")


def _verdict_text(row: Tree, titles: Mapping[str, str]) -> str:
    text = f"{'**pays**' if row['verdict'] == 'pays' else row['verdict']}"
    if row["against"] != BASE:
        text += f" (beside `{row['against']}`)"
    return text + (f"; harms: {', '.join(titles[name] for name in row['harms_on'])}" if row["harms_on"] else "")


def _cost(cost: Tree) -> str:
    have, lack = (f"{value:,.10g}".replace(",", " ") for value in (cost["with"], cost["without"]))
    return f"{cost['what']}: {have} → {lack}"
