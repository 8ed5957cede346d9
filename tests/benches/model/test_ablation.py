from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benches import result_cache
from benches.model.ablation import bench as ablation
from benches.model.ablation import costs as ablation_costs
from benches.model.ablation.bench import bench_ablation
from benches.model.ablation.conditions import (
    CONDITIONS,
    clothes_conditions,
    coarse_conditions,
    hard_condition,
    stepped,
    steps_of,
)
from benches.model.ablation.figure import draw_ablation
from benches.model.ablation.rows import ROW_OF_BASE, ROWS, AblationRow, deviation_of, enough, verdict, worth
from benches.model.ablation.runs import find_runs
from pictures import decoded, marks, part
from same_code import names_alone
from slow_accuracy import slow_accuracy

from bodyseg_data import RangeImages
from bodyseg_data.artifacts import SHAPES
from bodyseg_data.commands.options import parse
from bodyseg_data.core import BadConfig, Draws
from bodyseg_model.commands import train
from bodyseg_model.networks import build, load_network, save_network
from bodyseg_model.training.recipes import PRESETS

IMAGES = 1
SETTINGS = {"patch": 16, "widths": [8], "blocks": [0]}
ROW = {each.name: each for each in ROWS}
TRAINED = ("losses", "no_noise", "no_context", "views_1")
"""Rows that have a network here; the others are missing."""


def make_run(data: Path, out: Path, row: AblationRow, weights: int) -> None:
    """A run whose card says what `row` does, with new weights."""
    images = RangeImages(data, row.variant, "train", int(out.name[-1]), sensor=row.sensor, only=row.only)
    recipe = asdict(PRESETS["compact"]) | {"steps": 1, "batch_size": 2}
    network = build("compact", {**SETTINGS, **row.settings}, seed=weights)
    out.mkdir(parents=True)
    facts = {"variant": row.variant, "data": images.identity(), "recipe": recipe}
    save_network(out / "network.safetensors", network, "compact", facts)


@pytest.fixture(scope="module", autouse=True)
def small() -> Iterator[None]:
    """Few samples and rounds, and no bodies to render."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in (("ROUNDS", 1), ("SAMPLES", 2), ("FRAMES", 1), ("_NETWORK_S", 0.0)):
            patch.setattr(ablation_costs, name, value)
        patch.setattr(ablation, "rendering_costs", lambda rig: None)
        patch.setattr(result_cache, "code_digest", names_alone)
        yield


@pytest.fixture(scope="module")
def runs(figures_set: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two folders: the base's trainings, and the others."""
    base, others = (tmp_path_factory.mktemp(name) / "runs" for name in ("base", "others"))
    for seed in (0, 1):
        make_run(figures_set, base / f"all-{seed}", ROW_OF_BASE, seed)
    for number, name in enumerate(TRAINED, start=2):
        make_run(figures_set, others / f"{name}-0", ROW[name], number)
    (others / "no_missing-0").mkdir()  # begun, not finished
    (others / "views_1-old").mkdir()
    return base, others


@pytest.fixture(scope="module")
def measured(figures_set: Path, runs: tuple[Path, Path]) -> dict[str, Any]:
    return bench_ablation(
        str(figures_set), runs, IMAGES, hard=str(figures_set), clothes=(str(figures_set), str(figures_set))
    )


def test_every_network_is_evaluated_under_every_condition(
    figures_set: Path, runs: tuple[Path, Path], measured: dict[str, Any]
) -> None:
    plain, bare = (RangeImages(figures_set, variant, "test", 0) for variant in ("all", "none"))
    expected = [slow_accuracy(load_network(runs[0] / f"all-{seed}").network, bare, IMAGES) for seed in (0, 1)]
    assert measured["base"]["none"]["seeds"] == expected
    rows = {row["name"]: row for row in measured["rows"]}
    assert set(rows) == {*TRAINED, "step_1mm", "step_2mm", "step_4mm", "step_8mm"}
    found = slow_accuracy(load_network(runs[1] / "no_noise-0").network, plain, IMAGES)
    assert rows["no_noise"]["accuracy"]["all"] == {"mean": found, "sd": None, "seeds": [found]}
    assert rows["no_noise"]["worth"]["all"]["points"] == pytest.approx(
        100 * (measured["base"]["all"]["mean"] - found), abs=0.006
    )
    gained = 100 * (rows["losses"]["accuracy"]["patches_30"]["mean"] - measured["base"]["patches_30"]["mean"])
    assert rows["losses"]["worth"]["patches_30"]["points"] == pytest.approx(gained, abs=0.006)
    assert len(rows["step_8mm"]["accuracy"]["none"]["seeds"]) == 2 and rows["step_8mm"]["worth"]["all"]["sd"] is None
    conditions = [condition["name"] for condition in measured["conditions"]]
    assert conditions == [
        *("all", "none", "noise_80", "missing_50", "patches_30", "stripes_30"),
        *("near_far", "other_side", "A", "hard"),  # there are no subjects B and C, and nobody is called P...
    ]
    assert set(rows["views_1"]["accuracy"]) == set(conditions)
    assert json.loads(json.dumps(measured)) == measured


def test_missing_trainings_are_named_as_the_command_takes_them(
    measured: dict[str, Any], runs: tuple[Path, Path]
) -> None:
    missing = {row["name"]: row["command"] for row in measured["missing"]}
    assert set(missing) == {f"{each.name}-0" for each in ROWS if each.arguments is not None} - {
        f"{name}-0" for name in TRAINED
    }
    assert missing["one_distance-0"] == (
        "bodyseg train --data shards --out runs/one_distance-0 --steps 1 --batch-size 2 --only '*-d255-*'"
    )
    for each in ROWS:
        if each.arguments is not None:
            options = parse(train.Options, ["--data", "x", "--out", "y", *each.arguments], "train", "", "")
            sensor = train._sensor(options, each.variant, options.sensor[0])
            assert (options.variant, options.only, sensor) == ((each.variant,), each.only, each.sensor), each
            assert json.loads(options.settings) == each.settings


def test_patterns_choose_what_rows_say() -> None:
    places = [(215, 0), (255, 10), (295, 20)]
    views = [(d, a + turn) for turn in range(0, 180, 30) for d, a in places]
    keys = [Path(f"open-C-C-squat-{body:03d}-d{d}-a{a:03d}") for body in range(100) for d, a in views]
    found = {}
    for each in ROWS:
        if each.group in ("amount", "views") and each.only:
            chosen = [key.name for key in keys if any(key.match(pattern) for pattern in each.only)]
            bodies = {key.split("-")[4] for key in chosen}
            found[each.name] = (
                len(bodies), len({key[-4:] for key in chosen}), len({key.split("-")[5] for key in chosen})
            )  # fmt: skip
    assert found == {
        "one_distance": (100, 6, 1),
        "half_turn": (100, 10, 3),
        "bodies_half": (50, 18, 3),
        "bodies_fifth": (20, 18, 3),
        "bodies_tenth": (10, 18, 3),
        "bodies_50th": (2, 18, 3),
        "views_9": (100, 9, 3),
        "views_6": (100, 6, 3),
        "views_3": (100, 3, 3),
        "views_1": (100, 1, 1),
    }


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        (
            "no_noise-0",
            {"variant": "all"},
            r"no_noise-0 must differ .* one effect \(no_noise\): its variant",
        ),
        ("no_context-0", {"settings": SETTINGS}, r"\(no_context\): its settings is .*True.*expected .*False"),
        ("views_1-0", {"data": {"set": "x"}}, r"\(views_1\): its data is {'set': 'x'}, expected"),
        ("all-1", {"data": None}, r"all-1 must differ from the base in one effect \(all\): its data is {}"),
        ("all-0", {"network": "fcn_alexnet"}, r"all-0 must be a training of compact, found 'fcn_alexnet'"),
        (
            "all-0",
            {"recipe": {"learning_rate": -1}},
            "all-0 must name recipe and settings|learning_rate must be",
        ),
        ("all-0", {"settings": 3}, "all-0 must name recipe and settings of a training: TypeError"),
        ("all-0", {"recipe": {"speed": 1}}, "all-0 must name recipe and settings of a training: TypeError"),
    ],
)
def test_trainings_that_differ_in_more_are_refused(
    name: str, change: dict[str, Any], message: str, figures_set: Path, runs: tuple[Path, Path], tmp_path: Path
) -> None:
    for folder in runs:
        shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    card = tmp_path / name / "network.json"
    card.write_text(json.dumps({**json.loads(card.read_text()), **change}))
    with pytest.raises(BadConfig, match=message):
        bench_ablation(str(figures_set), (tmp_path,), IMAGES)


def test_without_a_base_nothing_is_compared(runs: tuple[Path, Path], figures_set: Path) -> None:
    with pytest.raises(BadConfig, match=r"needs finished trainings all-SEED to compare with, found none in .*runs"):
        find_runs(runs[1:])
    with pytest.raises(BadConfig, match="--clothes takes two sets, of dressed bodies and of bare ones, found 1"):
        bench_ablation(str(figures_set), runs, clothes=("x",))
    assert [run.path.name for run in find_runs((runs[1], *runs))] == [
        "all-0", "all-1", *(f"{each.name}-0" for each in ROWS if each.name in TRAINED)
    ]  # fmt: skip


def test_exams_change_what_they_say(figures_set: Path) -> None:
    conditions = {condition.label: condition for condition in CONDITIONS}
    plain = conditions["all"].open(str(figures_set))
    assert plain.identity() == RangeImages(figures_set, "all", "test", 0).identity()
    quiet = [conditions[name].open(str(figures_set)) for name in ("noise_80", "missing_50")]
    assert {image.drawn["sigma_mm"] for image in map(quiet[0].image, range(8))} == {80}
    assert {image.drawn["missing_rate"] for image in map(quiet[1].image, range(8))} == {0.5}
    for kind in SHAPES:
        fewer = conditions[f"{kind}_30"].open(str(figures_set))
        assert fewer.identity() != plain.identity()
        ours, usual, clean = fewer.image(3), plain.image(3), plain.clean(3)
        gone = (ours.range == 0) & (usual.range > 0)
        assert np.array_equal(ours.range, np.where(gone, 0, usual.range))
        assert np.array_equal(ours.labels, np.where(gone, 255, usual.labels))
        lost = SHAPES[kind](clean.range, 0.3, Draws(fewer.seed, 0, clean.key).generator(f"lost {kind}"))
        assert abs(lost.sum() - 0.3 * (clean.range > 0).sum()) < 1
        assert np.array_equal(gone, lost & (usual.range > 0)) and gone.any()
        image, labels = np.full_like(ours.range, 7), np.full_like(ours.labels, 7)
        fewer.write(3, 0, image, labels)
        assert np.array_equal(image, ours.range) and np.array_equal(labels, ours.labels)
    elsewhere = hard_condition(str(figures_set)).open("nowhere")
    assert elsewhere.keys == plain.keys
    keys = [
        f"{source}-{body}-d215-a000"
        for source in ("open", "bare")
        for body in ("A-posture-1", "B-B-x-1", "C-C-x-1", "P1-person-1")
    ]
    for condition in clothes_conditions("d", "b"):
        assert [key for key in keys if any(Path(key).match(only) for only in condition.only)] == [
            key for key in keys if key.split("-")[1] in "BC"
        ]


def test_coarse_steps_round_to_the_nearest(figures_set: Path) -> None:
    image = np.array([[0, 1, 4, 5, 6, 14, 65535]], np.uint16)
    assert stepped(image, steps_of(1, 1e-4)).tolist() == [[0, 1, 1, 1, 1, 1, 6553]]
    assert stepped(np.array([[0, 15, 25, 26]], np.uint16), steps_of(0.4, 1e-4)).tolist() == [[0, 4, 6, 6]]
    assert [steps_of(2, step_m) for step_m in (1e-4, 5e-4, 2e-3, 1e-2)] == [20, 4, 1, 1], (
        "never less than what is stored"
    )
    (condition, _) = coarse_conditions(8)
    assert (condition.variant, condition.step_mm, condition.name) == ("all", 8, "all")
    images = condition.open(str(figures_set))
    coarse, fine = images.image(0).range, CONDITIONS[0].open(str(figures_set)).image(0).range
    eight = steps_of(8, images.step_m)
    assert np.array_equal(coarse > 0, fine > 0) and set(np.unique(coarse % eight)) == {0}
    assert np.abs(coarse.astype(int) - fine).max() == eight // 2


def test_deviations_are_not_small_by_luck() -> None:
    found = deviation_of({"a": [0.50, 0.52], "b": [0.5, 0.5]})
    assert found is not None
    assert found["a"] == pytest.approx(100 * 0.02 / 2**0.5)
    assert found["b"] == pytest.approx(100 * 0.02 / 2**0.5 / 2**0.5)
    assert deviation_of({"a": [0.5], "b": [0.6]}) is None


def test_what_pays_and_what_does_not() -> None:
    have, lack = {"all": [0.8, 0.8, 0.8], "x": [0.7] * 3, "y": [0.5]}, {"all": [0.79], "x": [0.705], "z": [0.1]}
    found = worth(have, lack, {"all": 0.3, "x": 0.1, "y": 1})
    sd = 0.3 * (4 / 3) ** 0.5
    assert found["all"] == {"points": 1.0, "sd": round(sd, 2), "threshold": round(2 * sd, 2)}
    assert found["x"] == {"points": -0.5, "sd": 0.12, "threshold": 0.3}
    assert list(found) == ["all", "x"]
    assert verdict(found, ("all", "x")) == {"verdict": "pays", "pays_on": ["all"], "harms_on": []}
    assert verdict(found, ("x", "hard"))["verdict"] == "does not pay"
    turned = worth(lack, have, None)
    assert verdict(turned, ("x",)) == {"verdict": "pays", "pays_on": ["x"], "harms_on": ["all"]}
    assert worth(have, lack, None)["all"] == {"points": 1.0, "sd": None, "threshold": 0.3}
    one_seed = {"verdict": "undecided", "pays_on": [], "harms_on": []}
    assert verdict(turned, ("x",), decided=False) == one_seed
    assert verdict(turned, ("all",), decided=False)["verdict"] == "does not pay"
    louder = worth(have, lack, {"all": 0.5, "x": 0.5, "y": 1})  # threshold 1.15
    assert verdict(louder, ("all", "x")) == {"verdict": "undecided", "pays_on": [], "harms_on": []}
    assert verdict(louder, ("x",))["verdict"] == "does not pay"


def test_the_smallest_set_that_suffices() -> None:
    rows = [
        {"name": name, "samples": samples, "worth": {"all": {"points": points}}}
        for name, samples, points in (("bodies_half", 50, 0.2), ("bodies_tenth", 10, 1.0), ("bodies_50th", 2, 1.1))
    ]
    assert enough(rows, "bodies_") == "bodies_tenth"
    assert enough(rows, "views_") is None and enough(rows[2:], "bodies_") is None


def test_the_figure_and_the_table_are_made(measured: dict[str, Any], tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    draw_ablation(measured, tmp_path / "ablation.png")
    picture = part(decoded(tmp_path / "ablation.png"), down=(0, 0.93))  # without the legend
    gains, bodies, views = (
        part(picture, across, down)
        for across, down in (((0, 0.62), (0, 1)), ((0.72, 1), (0, 0.5)), ((0.72, 1), (0.5, 1)))
    )
    blue, orange = (marks(gains, colour, 6, within=60) for colour in ("#1f4fa8", "#c25a00"))
    assert len(blue) >= 5 and orange
    for panel in (bodies, views):
        assert marks(panel, "#1f4fa8", 30, within=30) and not marks(panel, "#c25a00", 6, within=30)
    lines = measured["table"].splitlines()
    assert len(lines) == 3 + len(measured["rows"]) and all(line.count("|") == 8 for line in lines)
    costs = {cost["what"]: cost for row in measured["rows"] if row["name"] == "views_1" for cost in row["cost"]}
    assert costs["training samples"] == {"what": "training samples", "with": 16, "without": 4}
