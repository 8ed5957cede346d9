from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benches.model.ablation import bench as ablation
from benches.model.ablation import conditions as ablation_exams
from benches.model.ablation import costs as ablation_costs
from benches.model.ablation.bench import bench_ablation
from benches.model.ablation.conditions import CONDITIONS, clothes_conditions, coarse_conditions, hard_condition, stepped
from benches.model.ablation.costs import byte_costs, costs_of, loader_costs, processor_ms, rendering_costs
from benches.model.ablation.figure import draw_ablation
from benches.model.ablation.rows import ROW_OF_BASE, ROWS, AblationRow, deviation_of, enough, table, verdict, worth
from benches.model.ablation.runs import find_runs
from benches.model.variants import scores as variants_scores

from bodyseg_data import RangeImages
from bodyseg_data.artifacts.losses import lost_grazing
from bodyseg_data.bodies.sources.open_bodies import MadeBodies
from bodyseg_data.commands.options import parse
from bodyseg_data.core.errors import BadConfig, MissingLibrary
from bodyseg_data.shards.sample_codec import encode_sample
from bodyseg_model.commands import train
from bodyseg_model.evaluation.scores import ConfusionMatrix
from bodyseg_model.networks.checkpoints import load_network, read_json, save_network
from bodyseg_model.networks.registry import build, predict

STEPS = 1
IMAGES = 2
SETTINGS = {"patch": 16, "widths": [8], "blocks": [0]}
ROW = {each.name: each for each in ROWS}
TRAINED = ("losses", "no_noise", "no_clothes", "no_context", "views_6", "views_1")
"""Things without which, or with which, a network is trained here; the other ones are missing."""


def trained(data: Path, out: Path, arguments: tuple[str, ...]) -> None:
    words = list(arguments)
    if "--settings" in words:
        place = words.index("--settings") + 1
        words[place] = json.dumps({**SETTINGS, **json.loads(words[place])})
    else:
        words += ["--settings", json.dumps(SETTINGS)]
    words += ["--data", str(data), "--out", str(out), "--steps", str(STEPS), "--batch-size", "2"]
    assert train.run(parse(train.Options, [*words, "--num-workers", "0", "--device", "cpu"], "train", "", "")) == 0


def as_if_trained(data: Path, like: Path, out: Path, each: AblationRow, weights: int) -> None:
    """A run of other weights, whose card says what `each` does: as good as trained, and sooner there."""
    card = read_json(like / "network.json")
    images = RangeImages(data, each.variant, "train", int(out.name[-1]), artifacts=each.artifacts, only=each.only)
    card |= {"variant": each.variant, "data": images.identity()}
    network = build("compact", {**SETTINGS, **each.settings}, seed=weights)
    out.mkdir(parents=True)
    facts = {name: value for name, value in card.items() if name not in ("format", "network", "settings")}
    save_network(out / "network.safetensors", network, "compact", facts)


@pytest.fixture(scope="module", autouse=True)
def small() -> Iterator[None]:
    """Few samples and rounds, and no bodies to render."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in (("ROUNDS", 1), ("SAMPLES", 2), ("FRAMES", 1), ("_NETWORK_S", 0.0)):
            patch.setattr(ablation_costs, name, value)
        patch.setattr(ablation, "rendering_costs", lambda rig: None)
        yield


@pytest.fixture(scope="module")
def runs(figures_set: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two folders: the base's trainings, and the others."""
    base, others = (tmp_path_factory.mktemp(name) / "runs" for name in ("base", "others"))
    trained(figures_set, base / "all-0", ())
    trained(figures_set, others / "losses-0", ROW["losses"].arguments or ())
    for number, (name, out) in enumerate([("all", base / "all-1"), *((n, others / f"{n}-0") for n in TRAINED[1:])]):
        as_if_trained(figures_set, base / "all-0", out, ROW.get(name, ROW_OF_BASE), number)
    (others / "no_missing-0").mkdir()  # begun, not finished
    (others / "views_1-old").mkdir()
    return base, others


@pytest.fixture(scope="module")
def measured(figures_set: Path, runs: tuple[Path, Path]) -> dict[str, Any]:
    return bench_ablation(
        str(figures_set), runs, IMAGES, hard=str(figures_set), clothes=(str(figures_set), str(figures_set))
    )


def accuracy(run: Path, images: RangeImages) -> float:
    """Slowly: one image after the other, in the order of the images' epoch."""
    matrix = ConfusionMatrix()
    network = load_network(run).network
    for index in images.order(0)[:IMAGES].tolist():
        sample = images[index]
        matrix.add(sample["labels"].numpy(), predict(network, sample["range"][None]).labels[0].numpy())
    return round(matrix.average_per_class_accuracy(), 5)


def test_every_network_sits_every_exam(figures_set: Path, runs: tuple[Path, Path], measured: dict[str, Any]) -> None:
    plain, bare = (RangeImages(figures_set, variant, "test", 0) for variant in ("all", "none"))
    expected = [accuracy(runs[0] / f"all-{seed}", bare) for seed in (0, 1)]
    assert measured["base"]["none"]["seeds"] == expected
    rows = {row["name"]: row for row in measured["rows"]}
    assert set(rows) == {*TRAINED, "step_1mm", "step_2mm", "step_4mm", "step_8mm"}
    found = accuracy(runs[1] / "no_noise-0", plain)
    assert rows["no_noise"]["accuracy"]["all"] == {"mean": found, "sd": None, "seeds": [found]}
    assert rows["no_noise"]["worth"]["all"]["points"] == pytest.approx(
        100 * (measured["base"]["all"]["mean"] - found), abs=0.006
    )
    gained = 100 * (rows["losses"]["accuracy"]["patches_30"]["mean"] - measured["base"]["patches_30"]["mean"])
    assert rows["losses"]["worth"]["patches_30"]["points"] == pytest.approx(gained, abs=0.006)
    assert len(rows["step_8mm"]["accuracy"]["none"]["seeds"]) == 2 and rows["step_8mm"]["worth"]["all"]["sd"] is None
    conditions = [condition["name"] for condition in measured["conditions"]]
    assert conditions == [
        *("all", "none", "noise_80", "missing_50", "patches_30", "stripes_30", "grazing_30"),
        *("near_far", "other_side", "A", "hard"),  # there are no subjects B and C, and nobody is called P...
    ]
    assert set(rows["views_1"]["accuracy"]) == set(conditions)
    assert json.loads(json.dumps(measured)) == measured


def test_amounts_are_those_of_the_set(measured: dict[str, Any]) -> None:
    rows = {row["name"]: row for row in measured["rows"]}
    scale = measured["scale"]
    assert (scale["train_samples"], scale["train_bodies"], scale["train_views"], scale["seeds"]) == (16, 4, 4, 2)
    assert [rows["views_1"][name] for name in ("samples", "bodies", "views")] == [4, 4, 1]
    costs = {cost["what"]: cost for cost in rows["views_1"]["cost"]}
    assert costs["training samples"] == {"what": "training samples", "with": 16, "without": 4}
    assert rows["no_noise"]["bodies"] == 4 and rows["views_1"]["against"] == "all"
    assert set(measured["enough"]) == {"bodies", "views"} and measured["enough"]["bodies"] is None
    assert {row["name"]: row["cost"][0]["what"] if row["cost"] else None for row in measured["rows"]} == {
        **dict.fromkeys(("losses", "no_noise"), "ms a sample in the loader"),
        **dict.fromkeys(("step_1mm", "step_2mm", "step_4mm", "step_8mm"), "bytes a sample"),
        **dict.fromkeys(("views_6", "views_1"), "training samples"),
        "no_context": "ms from image to labels",
        "no_clothes": None,
    }


def test_a_second_run_asks_nothing_again(
    figures_set: Path, runs: tuple[Path, Path], measured: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*given: Any, **named: Any) -> None:
        raise AssertionError("nothing is left to do")

    monkeypatch.setattr(variants_scores, "evaluate", refuse)
    seen: list[tuple[int, int]] = []
    data = str(figures_set)
    again = bench_ablation(
        data, runs, IMAGES, data, (data, data), lambda done, total, note="": seen.append((done, total))
    )
    assert (again["base"], again["conditions"], again["missing"]) == (
        measured["base"],
        measured["conditions"],
        measured["missing"],
    )
    assert seen[-1] == (11 * 8 + 8 * 2 + 4,) * 2 and [done for done, _ in seen] == list(range(1, len(seen) + 1))
    with pytest.raises(AssertionError, match="nothing is left"):  # these images have not been shown
        bench_ablation(str(figures_set), runs, IMAGES + 1)
    kept = json.loads((runs[0] / "all-0" / variants_scores.FILE).read_text())["results"].values()
    code = {ablation_exams.__name__, variants_scores.__name__}  # that which makes an exam's images, and that which asks
    assert len(kept) == 11 + 8 and all(set(each["modules"]) == code for each in kept)


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
            artifacts = train._artifacts(options)
            assert (options.variant, options.only, artifacts) == (each.variant, each.only, each.artifacts), each
            assert json.loads(options.settings) == each.settings


def test_patterns_choose_what_rows_say() -> None:
    places = [(215, 0), (255, 10), (295, 20)]
    views = [(d, a + turn) for turn in range(0, 180, 30) for d, a in places]
    keys = [f"open-C-C-squat-{body:03d}-d{d}-a{a:03d}" for body in range(100) for d, a in views]
    found = {}
    for each in ROWS:
        if each.group in ("amount", "views") and each.only:
            chosen = [key for key in keys if any(Path(key).match(pattern) for pattern in each.only)]
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


def test_a_recipe_that_differs_is_refused(figures_set: Path, runs: tuple[Path, Path], tmp_path: Path) -> None:
    folder = shutil.copytree(runs[1], tmp_path / "runs")
    card = folder / "no_noise-0" / "network.json"
    content = json.loads(card.read_text())
    content["recipe"] |= {"mirror": False}
    card.write_text(json.dumps(content))
    with pytest.raises(BadConfig, match=r"no_noise-0 .*its recipe is .*'mirror': False"):
        bench_ablation(str(figures_set), (runs[0], folder), IMAGES)


def test_without_a_base_nothing_is_compared(runs: tuple[Path, Path], figures_set: Path) -> None:
    with pytest.raises(BadConfig, match=r"needs finished trainings all-SEED to compare with, found none in .*runs"):
        find_runs(runs[1:])
    with pytest.raises(BadConfig, match="the number of test images must be a whole number of at least 1, found 0"):
        bench_ablation(str(figures_set), runs, 0)
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
    assert {image.sigma_mm for image in map(quiet[0].image, range(8))} == {80}
    assert {image.missing_rate for image in map(quiet[1].image, range(8))} == {0.5}
    for kind in ("patches", "stripes", "grazing"):
        fewer = conditions[f"{kind}_30"].open(str(figures_set))
        assert fewer.identity() != plain.identity()
        ours, usual, clean = fewer.image(3), plain.image(3), plain.clean(3)
        gone = (ours.range == 0) & (usual.range > 0)
        assert np.array_equal(ours.range, np.where(gone, 0, usual.range))
        assert np.array_equal(ours.labels, np.where(gone, 255, usual.labels))
        if kind == "grazing":
            lost = lost_grazing(clean.range, 0.3, plain.manifest.rig.camera)
            assert lost.sum() == round(0.3 * (clean.range > 0).sum())
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
    assert stepped(image, 1).tolist() == [[0, 1, 1, 1, 1, 1, 6553]]
    assert stepped(np.array([[0, 15, 25, 26]], np.uint16), 0.4).tolist() == [[0, 4, 6, 6]]
    (condition, _) = coarse_conditions(8)
    assert (condition.variant, condition.step_mm, condition.name) == ("all", 8, "all")
    coarse, fine = condition.open(str(figures_set)).image(0).range, CONDITIONS[0].open(str(figures_set)).image(0).range
    assert np.array_equal(coarse > 0, fine > 0) and set(np.unique(coarse % 80)) == {0}
    assert np.abs(coarse.astype(int) - fine).max() == 40


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


def test_costs_are_of_the_thing(figures_set: Path) -> None:
    calls: list[str] = []
    found = processor_ms({name: lambda name=name: calls.append(name) for name in "ab"}, 10, rounds=2)
    assert "".join(calls) == "abbaab" and set(found) == {"a", "b"} and found["a"]["ms"] >= 0
    times = loader_costs(str(figures_set))
    assert set(times) == {
        *("all", "none", "no_occlusion", "no_noise"),
        *("no_missing", "noise_50", "missing_spread", "losses"),
    }
    sizes = byte_costs(str(figures_set))
    images = RangeImages(figures_set, "all", "train")
    stored = [len(encode_sample(images.clean(place))["bsi"]) for place in (0, 15)]
    assert sizes["all"] == round(np.mean(stored))
    assert sizes["no_occlusion"] < sizes["all"] and sizes["step_8mm"] < sizes["step_1mm"] < sizes["all"]
    costs = {
        "loader": {name: {"ms": number} for number, name in enumerate(times)},
        "bytes": sizes,
        "rendering": {"dressed": {"ms": 3.0}, "bare": {"ms": 2.0}},
        "network": {},
    }
    added = costs_of(ROW["losses"], costs, 16, 16, 1e5)[0]
    assert (added["with"], added["without"]) == (costs["loader"]["losses"]["ms"], costs["loader"]["all"]["ms"])
    assert costs_of(ROW["no_clothes"], costs, 4, 16, 1e5) == [
        {"what": "training samples", "with": 16, "without": 4},
        {"what": "MB of them", "with": 1.6, "without": 0.4},
        {"what": "ms to render a sample", "with": 3.0, "without": 2.0},
    ]
    assert costs_of(ROW["noise_50"], costs, 16, 16, 1e5)[0]["what"] == "ms a sample in the loader"


def test_rendering_needs_anny(monkeypatch: pytest.MonkeyPatch, figures_set: Path) -> None:
    def refuse(self: MadeBodies, body: Any) -> None:
        assert self.figure(body).outfit is not None or type(self) is MadeBodies
        raise MissingLibrary("no Anny")

    monkeypatch.setattr(MadeBodies, "build", refuse)
    assert rendering_costs(RangeImages(figures_set).manifest.rig) is None


def some_figures(measured: dict[str, Any]) -> dict[str, Any]:
    """An answer in which every each has a row."""
    (row,) = (row for row in measured["rows"] if row["name"] == "views_6")
    rows = []
    for number, each in enumerate(ROWS):
        points = (-3, 0.1, 25, 2.2)[number % 4]
        value = {name: {**each, "points": points} for name, each in row["worth"].items()}
        facts = {"name": each.name, "what": each.what, "group": each.group, "added": each.added}
        rows.append(
            {**row, **facts, "samples": 16 - number % 15, "bodies": 4, "views": 4, "worth": value,
             "helps": list(each.helps), **verdict(value, each.helps)}
        )  # fmt: skip
    return {**measured, "rows": rows}


def test_the_table_has_a_line_a_thing(measured: dict[str, Any]) -> None:
    text = table(some_figures(measured))
    lines = text.splitlines()
    assert len(lines) == 3 + len(ROWS) and all(line.count("|") == 8 for line in lines)
    losses = next(line for line in lines if "`losses`" in line)
    assert losses.startswith("| + patches, stripes, grazing surfaces lost (`losses`) | 1 | ")
    none = {**measured["rows"][0], "accuracy": {"all": {"mean": 0.81234, "sd": 0.0012, "seeds": [1, 2]}}}
    none |= {"cost": [{"what": "ms", "with": 2.5, "without": 1000}], "against": "views_6", "what": "x", "added": False}
    none |= {"name": "n", "helps": ["all", "hard"], "verdict": "pays", "harms_on": ["none"]}
    none |= {"worth": {"all": {"points": 1.23, "sd": 0.41}, "hard": {"points": -0.5, "sd": None}}}
    assert table({**measured, "rows": [none]}).splitlines()[-1] == (
        "| x (`n`) | 2 | 81.2 ± 0.1 | +1.2 ± 0.4 | hard poses: −0.5 | **pays** (beside `views_6`); "
        "harms: no artifact | ms: 2.5 → 1 000 |"
    )


def test_the_figure_is_drawn(measured: dict[str, Any], tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    from PIL import Image

    for name, figures in (("few.png", measured), ("every.png", some_figures(measured))):
        draw_ablation(figures, tmp_path / name)
        with Image.open(tmp_path / name) as picture:
            assert len(picture.convert("RGB").getcolors(1 << 24) or []) > 200
    with pytest.raises(BadConfig, match="cannot write"):
        draw_ablation(measured, tmp_path / "nowhere" / "x.png")
