"""Scores over severities against numbers worked out by hand, and the figure of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from torch import nn

from bodyseg_data.core import BadConfig
from bodyseg_model.evaluation import GrossErrors, over_seeds
from bodyseg_model.networks import Trained
from bodyseg_model.stability import Group, Run, Sweep, draw_stability, group, group_of, summarise
from bodyseg_model.stability.scenes import CLEAN, SweepPoint
from bodyseg_model.stability.summary import Found, Score, _styles, corruption_error, falls_below, relative_robustness

SWEEPS = {
    "noise": Sweep("Noise", "sigma, mm", (0, 10, 30)),
    "nearer": Sweep("Nearer", "distance, m", (2.5, 2.0, 1.5), "rendered"),
    "hard": Sweep("Hard", "which", (0, 1), counts=False),
}
SETTINGS = [
    CLEAN["stored"],
    SweepPoint("noise", 10),
    SweepPoint("noise", 30),
    CLEAN["rendered"],
    SweepPoint("nearer", 2.0),
    SweepPoint("nearer", 1.5),
    SweepPoint("hard", 1),
]


def made(name: str, seed: int, variant: str = "all", **card: Any) -> Run:
    facts = {"network": "compact", "settings": {}, "variant": variant, "recipe": {"steps": 1}, "seed": seed, **card}
    data = {"data": {"set": "x", "seed": seed}}
    return Run(name, Path("runs") / name, Trained(nn.Identity(), data | facts))


GROUPS = [
    Group("all", (made("all-0", 0), made("all-1", 1), made("all-2", 2))),
    Group("none", (made("none-0", 0, "none"), made("none-1", 1, "none"))),
]


def scored(accuracy: float) -> Score:
    """Of 10 pixels: as many right as the accuracy says, the others 50 mm from their parts."""
    gross = GrossErrors()
    wrong = round(10 * (1 - accuracy))
    gross.add(np.full(wrong, 0.05, np.float32), 10 - wrong)
    return Score(accuracy, gross)


def accuracies(**rows: tuple[float, ...]) -> Found:
    return {name.replace("_", "-"): dict(zip(SETTINGS, map(scored, row), strict=True)) for name, row in rows.items()}


FOUND = accuracies(
    all_0=(0.8, 0.7, 0.5, 0.9, 0.8, 0.7, 0.6),
    all_1=(0.8, 0.8, 0.7, 0.9, 0.8, 0.7, 0.6),
    all_2=(0.8, 0.6, 0.6, 0.9, 0.8, 0.7, 0.9),
    none_0=(0.7, 0.5, 0.3, 0.8, 0.6, 0.4, 0.1),
    none_1=(0.7, 0.3, 0.1, 0.8, 0.4, 0.2, 0.3),
)


@pytest.fixture(scope="module")
def figures() -> dict[str, Any]:
    return {"images": 40} | summarise(GROUPS, SWEEPS, FOUND, GROUPS[1])


def test_means_and_spread_are_those_of_seeds(figures: dict[str, Any]) -> None:
    every = figures["groups"]["all"]
    assert every["clean"]["stored"] == {"mean": 0.8, "sd": 0.0, "seeds": [0.8, 0.8, 0.8]}
    assert every["clean"]["rendered"]["mean"] == 0.9
    assert every["curves"]["noise"] == {
        "mean": [0.8, 0.7, 0.6],
        "sd": [0.0, 0.1, 0.1],
        "seeds": [[0.8, 0.7, 0.5], [0.8, 0.8, 0.7], [0.8, 0.6, 0.6]],
    }
    assert every["runs"] == ["all-0", "all-1", "all-2"] and every["seeds"] == [0, 1, 2]
    assert (every["few_seeds"], figures["groups"]["none"]["few_seeds"]) == (False, True)
    assert over_seeds([0.5]) == {"mean": 0.5, "sd": None, "seeds": [0.5]}


def test_mce_is_the_errors_over_the_references(figures: dict[str, Any]) -> None:
    # Reference errors, mean over its seeds: noise (.5 + .7 + .7 + .9) / 2 = 1.4, nearer (.4 + .6 + .6 + .8) / 2 = 1.2.
    mce = figures["groups"]["all"]["mce"]
    by_seed = [(0.8 / 1.4 + 0.5 / 1.2) / 2, (0.5 / 1.4 + 0.5 / 1.2) / 2, (0.8 / 1.4 + 0.5 / 1.2) / 2]
    np.testing.assert_allclose(mce["seeds"], by_seed, atol=1e-5)
    assert mce["mean"] == pytest.approx(np.mean(by_seed), abs=1e-5)
    assert set(mce["sweeps"]) == {"noise", "nearer"}, "hard poses are not a sensor's fault"
    assert mce["sweeps"]["nearer"] == pytest.approx(0.5 / 1.2, abs=1e-5)
    assert figures["groups"]["none"]["mce"]["mean"] == 1.0, "the reference's own"
    assert figures["reference"] == "none"


def test_mrr_is_accuracy_over_that_at_the_clean_end(figures: dict[str, Any]) -> None:
    mrr = figures["groups"]["all"]["mrr"]
    by_seed = [(1.2 / 1.6 + 1.5 / 1.8) / 2, (1.5 / 1.6 + 1.5 / 1.8) / 2, (1.2 / 1.6 + 1.5 / 1.8) / 2]
    np.testing.assert_allclose(mrr["seeds"], by_seed, atol=1e-5)
    assert mrr["sweeps"]["noise"] == pytest.approx((1.2 + 1.5 + 1.2) / 3 / 1.6, abs=1e-5)


def test_the_worst_case_and_where_accuracy_falls_below_the_bound(figures: dict[str, Any]) -> None:
    every, none = figures["groups"]["all"], figures["groups"]["none"]
    assert every["worst"] == {"sweep": "noise", "strength": 30, "accuracy": 0.6}
    assert none["worst"] == {"sweep": "hard", "strength": 1, "accuracy": 0.2}
    assert figures["bound"] == 0.6
    assert every["falls_below_bound_at"]["noise"] == {"mean": None, "seeds": [20, None, None]}
    assert none["falls_below_bound_at"]["nearer"]["seeds"] == [2.0, 2.25]
    assert none["falls_below_bound_at"]["nearer"]["mean"] == pytest.approx(2.5 - 0.5 * 0.2 / 0.3, abs=1e-4)


@pytest.mark.parametrize(
    ("curve", "strength"),
    [
        ((0.9, 0.8, 0.7), None),
        ((0.9, 0.6, 0.6), None),
        ((0.5, 0.9, 0.9), 0),
        ((0.8, 0.5, 0.9), 10 * 2 / 3),
        ((0.8, 0.6, 0.3), 10),
        ((0.8, 0.7, 0.1), 10 + 30 / 6),
    ],
)
def test_falling_is_on_straight_lines(curve: tuple[float, ...], strength: float | None) -> None:
    found = falls_below((0, 10, 40), curve)
    assert found == (None if strength is None else pytest.approx(strength, abs=1e-4))


def test_what_has_no_number_is_null() -> None:
    assert corruption_error((0.9, 0.5), (1.0, 1.0)) is None
    assert relative_robustness((0.0, 0.5)) is None
    found = {run: dict.fromkeys(SETTINGS, Score(0.0, GrossErrors())) for run in FOUND}
    groups = summarise(GROUPS, SWEEPS, found, None)["groups"]
    assert groups["all"]["mrr"] is None and groups["all"]["mce"] is None
    assert groups["all"]["gross_errors"] == dict.fromkeys(SWEEPS), "not counted"


def test_gross_errors_are_given_at_every_strength(figures: dict[str, Any]) -> None:
    noise = figures["groups"]["all"]["gross_errors"]["noise"]
    assert noise["beyond_30_mm"] == {
        "mean": [0.2, 0.3, 0.4],
        "sd": [0.0, 0.1, 0.1],
        "seeds": [[0.2, 0.3, 0.5], [0.2, 0.2, 0.3], [0.2, 0.4, 0.4]],
    }
    assert noise["beyond_60_mm"]["mean"] == [0, 0, 0] and noise["mean_mm"]["mean"] == [10, 15, 20]


def test_sweeps_that_do_not_count_alone_give_no_score() -> None:
    only = summarise(GROUPS, {"hard": SWEEPS["hard"]}, FOUND, GROUPS[1])["groups"]["all"]
    assert only["mrr"] is None and only["mce"] is None
    assert list(only["clean"]) == ["stored"]


def test_groups_differ_by_more_than_the_seed() -> None:
    runs = [
        made("all-0", 0), made("none-0", 0, "none"), made("all-1", 1), made("long-0", 0, recipe={"steps": 2}),
    ]  # fmt: skip
    found = group(runs)
    assert [(each.label, [run.name for run in each.runs]) for each in found] == [
        ("all", ["all-0", "all-1"]),
        ("none", ["none-0"]),
        ("long", ["long-0"]),
    ]
    twice = (made("a/none-0", 0, "none"), made("b/none-0", 0, "none", network="fcn_alexnet"))
    assert [each.label for each in group(twice)] == ["a/none", "b/none"]
    same_stem = (made("all-0", 0), made("all-1", 1, network="fcn_alexnet"))
    assert [each.label for each in group(same_stem)] == ["all (compact)", "all (fcn_alexnet)"]
    first = {"file": "box", "weights_sha256": "aa"}
    fine = (made("all-0", 0), made("fine-0", 0, pretrained=first), made("fine-1", 1, pretrained={**first, "file": "b"}))
    assert [len(each.runs) for each in group(fine)] == [1, 2]
    for facts in ({"last_step": 1}, {"earlier_steps": [{"steps": 3, "until": 2}]}, {"validation": {"every": 5}}):
        assert [len(each.runs) for each in group([made("all-0", 0), made("all-1", 1, **facts)])] == [1, 1]
    copied = [made(name, 0, weights_sha256="aa") for name in ("all-0", "copy")]
    with pytest.raises(BadConfig, match="^a network counts once: .*all-0 and .*copy have the same weights$"):
        group([*copied, made("all-1", 1, weights_sha256="bb")])
    neither = (made("all-0", 0), made("all-1", 1, recipe={"steps": 2}))
    assert [each.label for each in group(neither)] == ["all-0", "all-1"]


def test_seeds_of_a_training_on_several_sets_are_a_group() -> None:
    """Each set of a mixture has the seed, too."""

    def mixed(seed: int, *sets: str) -> Run:
        data = {"mixture": [{"weight": 1.0, "set": each, "seed": seed} for each in sets], "seed": seed}
        return made(f"{''.join(sets)}-{seed}", seed, data=data)

    found = group([mixed(0, "x", "y"), mixed(0, "x", "z"), mixed(1, "x", "y")])
    assert [(each.label, len(each.runs)) for each in found] == [("xy", 2), ("xz", 1)]


def test_the_reference_is_one_group() -> None:
    assert group_of(GROUPS, ()) is None
    assert group_of(GROUPS, [Path("runs/none-1")]) is GROUPS[1]
    with pytest.raises(BadConfig, match="must differ by their seed alone, found all-0, none-0"):
        group_of(GROUPS, [Path("runs/none-1"), Path("runs/all-0")])


def test_the_figure_shows_every_group(figures: dict[str, Any], tmp_path: Path) -> None:
    draw_stability(figures, tmp_path / "stability.png")
    with Image.open(tmp_path / "stability.png") as picture:
        colours = np.asarray(picture.convert("RGB"))
    for colour in ((0xB8, 0x36, 0x0F), (0, 0, 0), (0x8A, 0x8A, 0x8A)):
        assert (colours == colour).all(axis=-1).sum() > 100
    bound = (colours == (0x8A, 0x8A, 0x8A)).all(axis=-1).any(axis=0)
    assert bound[-100:].any(), "two panels fill the figure's width"


def test_groups_of_one_variant_look_different(figures: dict[str, Any], tmp_path: Path) -> None:
    other = {**figures, "groups": {"all": figures["groups"]["all"], "more": figures["groups"]["all"]}}
    draw_stability(other, tmp_path / "stability.png")
    with Image.open(tmp_path / "stability.png") as picture:
        colours = np.asarray(picture.convert("RGB")).reshape(-1, 3)
    assert (colours == (0x8A, 0x5A, 0xA3)).all(axis=1).sum() > 100


def test_a_dozen_networks_beside_the_variants_look_different() -> None:
    variants = ["none", "occ", "noise", "md", *["all"] * 13]
    found = _styles({f"network {number}": {"variant": variant} for number, variant in enumerate(variants)})
    assert len({(style.colour, style.marker) for style in found.values()}) == len(variants)


def test_no_name_is_cut_off_below_the_figure(figures: dict[str, Any], tmp_path: Path) -> None:
    names = [f"a network of {number} with a long name" for number in range(12)]
    draw_stability(figures | {"groups": dict.fromkeys(names, figures["groups"]["all"])}, tmp_path / "stability.png")
    with Image.open(tmp_path / "stability.png") as picture:
        legend = np.asarray(picture.convert("L"))[-100:]
    assert (legend < 100).any()
    assert (legend[:, :5] == 255).all() and (legend[:, -5:] == 255).all()
