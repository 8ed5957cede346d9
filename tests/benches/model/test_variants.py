from __future__ import annotations

import json
import math
import pickle
import shutil
import statistics
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from benches import result_cache
from benches.measuring import Figures
from benches.model.ablation import costs
from benches.model.variants import bench as variants_bench
from benches.model.variants import runs as variants_runs
from benches.model.variants import scores
from benches.model.variants.bench import bench_variants
from benches.model.variants.claims import claims
from benches.model.variants.figure import _STYLES, draw_variants
from benches.model.variants.scores import SWEEPS, Condition, Sweep
from benches.model.variants.verdicts import REAL, paired, verdicts
from pictures import decoded, marks, part
from same_code import names_alone
from slow_accuracy import slow_accuracy

from bodyseg_data import RangeImages
from bodyseg_data.artifacts import VARIANTS, MissingData, Noise, SensorModel, artifacts_to_json, load_sensor_model
from bodyseg_data.core import BadConfig
from bodyseg_model.commands import train as train_command
from bodyseg_model.evaluation import evaluate
from bodyseg_model.networks import load_network
from bodyseg_model.training import RunOptions
from bodyseg_model.training.distributed import ProcessGroup

SETTINGS = '{"patch": 16, "widths": [8], "blocks": [0]}'
STEPS = 2
IMAGES = 1
HERE = ProcessGroup(0, 1, torch.device("cpu"))


def trained_by_command(data: Path, out: Path, variant: str) -> None:
    options = train_command.Options(
        (str(data),),
        out,
        (variant,),
        steps=STEPS,
        batch_size=2,
        settings=SETTINGS,
        num_workers=0,
        device="cpu",  # type: ignore[arg-type]
    )
    assert train_command.run(options) == 0


def short(sweep: Sweep, *strengths: float) -> Sweep:
    places = [sweep.strengths.index(strength) for strength in strengths]
    return Sweep(sweep.title, strengths, tuple(sweep.conditions[place] for place in places))


@pytest.fixture(scope="module", autouse=True)
def small() -> Iterator[None]:
    """Two strengths a sweep, no worker processes, and code that stays as it is."""
    with pytest.MonkeyPatch.context() as patch:
        for name, kept in (("noise", (0, 40)), ("missing", (0, 0.5)), ("grain", (1, 16))):
            patch.setitem(SWEEPS, name, short(SWEEPS[name], *kept))
        patch.setattr(costs, "ROUNDS", 1)
        patch.setattr(result_cache, "code_digest", names_alone)
        patch.setattr(variants_runs, "RUN_OPTIONS", RunOptions(log_every=1, checkpoint_every=1, num_workers=0))
        yield


@pytest.fixture(scope="module")
def one_run(figures_set: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one training of the five, made by the command."""
    folder = tmp_path_factory.mktemp("runs")
    trained_by_command(figures_set, folder / "noise-0", "noise")
    return folder


@pytest.fixture(scope="module")
def measured(figures_set: Path, one_run: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Figures]:
    folder = shutil.copytree(one_run, tmp_path_factory.mktemp("measured") / "runs")
    return folder, bench_variants(str(figures_set), (folder,), seeds=1, images=IMAGES)


def test_every_network_meets_every_test_set(figures_set: Path, measured: tuple[Path, Figures]) -> None:
    folder, figures = measured
    assert list(figures["table"]) == list(VARIANTS)
    for train_on, test_on in (("all", "noise"), ("noise", "md"), ("none", "none")):
        found = figures["table"][train_on][test_on]
        expected = slow_accuracy(
            load_network(folder / f"{train_on}-0").network, RangeImages(figures_set, test_on, "test", 0), IMAGES
        )
        assert found == {"mean": expected, "sd": None, "seeds": [expected]}
    strong = {
        "noise": load_sensor_model().with_artifacts(Noise(40, 40)),
        "missing": load_sensor_model().with_artifacts(MissingData((0.5,))),
    }
    for name, artifacts in strong.items():
        sweep = figures["sweeps"][name]
        assert sweep["artifacts_of_the_test_images"] == ["occlusion", "noise", "missing_data"]
        images = RangeImages(figures_set, "all", "test", 0, sensor=artifacts)
        expected = slow_accuracy(load_network(folder / "md-0").network, images, IMAGES)
        assert sweep["curves"]["md"]["mean"][1] == expected
        assert len(sweep["strengths"]) == len(sweep["curves"]["md"]["seeds"][0]) == 2
    scale = figures["scale"]
    assert (scale["steps"], scale["images_a_step"], scale["seeds"]) == (STEPS, 2, 1)
    assert (scale["test_images"], scale["test_images_of"], scale["train_images"]) == (IMAGES, 8, 16)
    assert [row["name"] for row in figures["networks"]] == [f"{name}-0" for name in VARIANTS]
    assert json.loads(json.dumps(figures)) == figures


class Elsewhere:
    """In place of processes: what they are given is pickled for them, and they alone can score."""

    def __init__(self, processes: int, context: Any) -> None:
        assert processes == 2 and context.get_start_method() == "spawn"

    def __enter__(self) -> Elsewhere:
        return self

    def __exit__(self, *_: object) -> None:
        return

    def submit(self, *job: Any) -> Future[Any]:
        work, *given = pickle.loads(pickle.dumps(job))
        done = Future[Any]()
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(scores, "evaluate", evaluate)
            done.set_result(work(*given))
        return done


def test_networks_scored_together_get_the_same_scores(
    figures_set: Path, measured: tuple[Path, Figures], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "runs"
    for variant in ("none", "all"):
        shutil.copytree(measured[0] / f"{variant}-0", folder / f"{variant}-0")
        (folder / f"{variant}-0" / scores.FILE).unlink()
    monkeypatch.setattr(scores, "evaluate", None)  # this process scores nothing itself
    monkeypatch.setattr(variants_bench, "ProcessPoolExecutor", Elsewhere)
    found = bench_variants(str(figures_set), (folder,), 1, images=IMAGES, only_finished=True, together=2)
    assert found["table"] == {variant: measured[1]["table"][variant] for variant in ("none", "all")}
    assert found["missing"] == ["occ-0", "noise-0", "md-0"]


def test_the_sweeps_change_one_artifact_of_x_all(figures_set: Path) -> None:
    plain = RangeImages(figures_set, "all", "test", 0)
    noisy, holed = (
        condition.open(str(figures_set)) for condition in (Condition("all", 40), Condition("all", None, 0.5))
    )
    assert {image.drawn["sigma_mm"] for image in map(noisy.image, range(8))} == {40}
    assert {image.drawn["missing_rate"] for image in map(holed.image, range(8))} == {0.5}
    for index in range(8):
        before, louder, emptier = (images.image(index) for images in (plain, noisy, holed))
        assert np.array_equal(before.labels, louder.labels)
        assert before.drawn["missing_rate"] == louder.drawn["missing_rate"]
        assert before.drawn["sigma_mm"] == emptier.drawn["sigma_mm"]
        both = (before.range > 0) & (emptier.range > 0)
        assert both.any() and np.array_equal(before.range[both], emptier.range[both])
    assert Condition("all", 40).name == "all, sigma 40 mm" and Condition("md", missing=0.5).name == "md, 50% missing"


def test_noise_of_a_grain_is_equal_over_squares(figures_set: Path) -> None:
    plain = RangeImages(figures_set, "none", "test", 0)
    clean = plain.image(0).range
    fine, coarse = (Condition("none", grain_px=size).open(str(figures_set)) for size in (1, 16))
    image, labels = np.empty_like(clean), np.empty(clean.shape, np.uint8)
    for images, equal in ((fine, False), (coarse, True)):
        images.write(0, 0, image, labels)
        assert np.array_equal(image > 0, clean > 0)
        added = image.astype(int) - clean
        assert 20 < 1000 * images.step_m * added[clean > 0].std() < 60
        row, column = (16 * (each // 16) for each in np.argwhere(clean > 0)[(clean > 0).sum() // 2])
        square = np.s_[row : row + 16, column : column + 16]
        assert (len(np.unique(added[square][clean[square] > 0])) == 1) is equal
    assert coarse.identity() != fine.identity() and coarse.identity()["set"] == plain.identity()["set"]
    flat = Condition("none", flat=True).open(str(figures_set))
    flat.write(0, 0, image, labels)
    assert np.array_equal(image > 0, clean > 0) and len(np.unique(image[clean > 0])) == 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"runs": (Path("a"),), "only_finished": True},
            "--only-finished needs finished trainings VARIANT-SEED, found none in a",
        ),
        ({"steps": STEPS + 1}, "noise-0 is a training of 2 steps, --steps asks for 3"),
    ],
)
def test_what_cannot_be_compared_is_refused(
    change: dict[str, Any], message: str, figures_set: Path, one_run: Path
) -> None:
    with pytest.raises(BadConfig, match=message):
        bench_variants(**{"data": str(figures_set), "runs": (one_run,), "seeds": 1, **change})


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("variant", "md", "differ in variant and seed alone: variant of .*noise-0 is 'md', expected 'noise'"),
        ("data", {"set": "x"}, "data of .*noise-0 is {'set': 'x'}, expected"),
        ("recipe", {"steps": 3}, "noise-0 must name recipe and settings of a training: KeyError"),
    ],
)
def test_trainings_of_another_kind_are_refused(
    name: str, value: Any, message: str, figures_set: Path, one_run: Path, tmp_path: Path
) -> None:
    folder = shutil.copytree(one_run, tmp_path / "runs")
    card = folder / "noise-0" / "network.json"
    card.write_text(json.dumps({**json.loads(card.read_text()), name: value}))
    with pytest.raises(BadConfig, match=message):
        bench_variants(str(figures_set), (folder,), seeds=1)


# Accuracy on clean test images, and points lost for each mm of sigma and for each percent missing: as the paper says.
AS_THE_PAPER = {
    "none": (0.60, 0.02, 0.8),
    "occ": (0.66, 0.02, 0.7),
    "noise": (0.62, 0.01, 0.8),
    "md": (0.75, 0.02, 0.03),
    "all": (0.82, 0.01, 0.03),
}


SEEDS = dict.fromkeys(VARIANTS, (0, 1, 2))


def scores_table(
    table: dict[str, tuple[float, float, float]], edge: float = 0.5
) -> Callable[[Any], Callable[[str, Condition], list[Any]]]:
    def scores_of(variant: str, condition: Condition) -> list[Any]:
        start, by_noise, by_holes = table[variant]
        lost = by_noise * (condition.noise_mm or 0) + by_holes * 100 * (condition.missing or 0)
        return [
            {
                "average_per_class_accuracy": start - lost / 100 + 0.01 * seed,
                "subsets": {
                    name: {"average_per_class_accuracy": start + more}
                    for name, more in (("A", -0.03), ("B", 0.01), ("people", 0.04))
                },
                "confidence": {
                    "above_70_percent": {"share_of_pixels": 0.85, "average_per_class_accuracy": start + 0.06}
                },
                "border_distance_px": [
                    {"distance": name, "pixels": 100, "wrong": edge if name in ("1", "1-2", "2-4") else 0.1}
                    for name in ("1", "1-2", "2-4", "4-8", "8-16", ">16")
                ],
            }
            for seed in (-1, 0, 1)
        ]

    return lambda _: scores_of


def test_claims_hold_where_they_do() -> None:
    found = claims(scores_table(AS_THE_PAPER), SEEDS)
    assert [row["claim"] for row in found if row["holds"] is not True] == []
    assert {row["section"].partition(",")[0] for row in found} == {"4.1", "4.2", "4.3", "4.2 to 4.4"}
    by_text = {row["claim"]: row["ours"] for row in found}
    lost = by_text["noise and all lose at most 2 points at a sigma of 40 mm"]["points lost"]
    assert lost == {name: {"mean": 0.4, "sd": 0.0, "seeds": [0.4] * 3} for name in ("noise", "all")}
    (edges,) = (row["ours"] for row in found if "edges" in row["claim"])
    assert edges["wrong_pixels_at_edges"]["mean"] == round(150 / 180, 5)
    assert edges["all_pixels_at_edges"]["mean"] == 0.5
    collapse = next(row["ours"] for row in found if "collapses" in row["claim"])
    assert (collapse["0 % missing"]["mean"], collapse["50 % missing"]["mean"]) == (0.6, 0.2)


@pytest.mark.parametrize(
    ("variant", "values", "texts"),
    [
        ("all", (0.70, 0.01, 0.03), ["at least 81.3 %", "training on all artifacts is best"]),
        ("all", (0.82, 0.06, 0.03), ["noise and all lose at most 2 points at a sigma of 40 mm"]),
        ("all", (0.82, 0.01, 0.05), ["md and all lose at most 2 points"]),
        ("occ", (0.66, 0.06, 0.7), ["so do networks that never saw noise"]),
        ("noise", (0.70, 0.01, 0.8), ["each gain more on none"]),
        ("occ", (0.80, 0.02, 0.03), ["gains most on none"]),
        ("none", (0.60, 0.02, 0.5), ["accuracy collapses"]),
    ],
)
def test_claims_do_not_hold_where_they_do_not(
    variant: str, values: tuple[float, float, float], texts: list[str]
) -> None:
    found = claims(scores_table({**AS_THE_PAPER, variant: values}), SEEDS)
    broken = [row["claim"] for row in found if row["holds"] is False]
    assert len(broken) == len(texts)
    assert all(text in claim for text, claim in zip(texts, broken, strict=True))


def test_claims_of_single_images_and_subsets_can_fail() -> None:
    def scores_of(variant: str, condition: Condition) -> list[Any]:
        (record, *_) = scores_table(AS_THE_PAPER, edge=0.05)(0)(variant, condition)
        record["subsets"] = {"B": {"average_per_class_accuracy": 0.9}, "C": {"average_per_class_accuracy": None}}
        above = record["confidence"]["above_70_percent"]
        above["share_of_pixels"], above["average_per_class_accuracy"] = 0.5, 0.1
        return [record]

    found = claims(lambda _: scores_of, SEEDS)
    assert [row["holds"] for row in found[:6]] == [False, False, False, False, None, None]
    assert len(found) == len(claims(scores_table(AS_THE_PAPER), SEEDS))


def test_claims_about_networks_that_are_missing_are_left_out() -> None:
    asked: list[Any] = []

    def scores_of(seeds: Any) -> Any:
        asked.append(seeds)
        return scores_table(AS_THE_PAPER)(seeds)

    found = claims(scores_of, {"all": (0, 2), "none": (1, 2)})
    assert {row["section"] for row in found} == {"4.1", "4.1, Fig. 5", "4.1, Fig. 6"}
    assert asked == [{0, 2}] * 4


def on_real(**points: tuple[float, ...]) -> dict[str, dict[str, dict[int, float]]]:
    """Row -> accuracy of seeds 0, 1 ... on real frames, and ten points more wrong feet than that is low."""
    return {
        row: {
            f"{REAL}x, accuracy": dict(enumerate(values)),
            f"{REAL}x, feet": {seed: 0.9 - value for seed, value in enumerate(values)},
        }
        for row, values in points.items()
    }


def test_claims_about_real_frames() -> None:
    scores = on_real(none=(0.5, 0.52), noise=(0.51, 0.5), occ=(0.6, 0.6), md=(0.62, 0.6), all=(0.7, 0.721))
    worst, better = claims(scores_table(AS_THE_PAPER), {}, scores)
    assert worst["holds"] is True and better["holds"] is True
    assert worst["ours"]["from worst to best"][f"{REAL}x, feet"][-1] == "all"
    scores["noise"] = on_real(noise=(0.65, 0.65))["noise"]
    scores["all"] = on_real(all=(0.5, 0.7))["all"]
    assert [row["holds"] for row in claims(scores_table(AS_THE_PAPER), {}, scores)] == [False, False]


def test_differences_are_of_one_seed_and_count_errors_the_other_way() -> None:
    found = paired({0: 0.5, 1: 0.7, 3: 0.1}, {0: 0.4, 1: 0.55, 2: 0.9})
    half = 12.706 * statistics.stdev((10, 15)) / math.sqrt(2)  # Student's t of one degree of freedom
    assert found is not None and (found["mean"], found["seeds"]) == (12.5, [10, 15])
    assert found["interval"] == pytest.approx([12.5 - half, 12.5 + half], abs=0.02)
    assert paired({0: 0.5}, {1: 0.5}) is None
    alone = paired({0: 0.5}, {0: 0.6}, lower=True)
    assert alone is not None and alone["mean"] == 10 and alone["interval"] is None


@pytest.mark.parametrize(
    ("real", "rendered", "clean", "outcome"),
    [
        ((0.60, 0.601, 0.602), (0.5, 0.5, 0.5), (0.8, 0.8, 0.8), "stays"),
        ((0.50, 0.501, 0.502), (0.6, 0.61, 0.62), (0.8, 0.8, 0.8), "stays, by rendered images alone"),
        ((0.60, 0.601, 0.602), (0.6, 0.61, 0.62), (0.7, 0.7, 0.7), "gains and loses"),
        ((0.40, 0.401, 0.402), (0.5, 0.5, 0.5), (0.8, 0.8, 0.8), "goes"),
        ((0.50, 0.505, 0.49), (0.5, 0.5, 0.51), (0.8, 0.8, 0.81), "untestable here"),
        ((0.50, 0.60, 0.501), (0.5, 0.5, 0.51), (0.8, 0.8, 0.81), "undecided: seeds differ"),
        ((0.60,), (0.6,), (0.8,), "undecided: one seed"),
    ],
)
def test_verdicts_follow_the_rule(
    real: tuple[float, ...], rendered: tuple[float, ...], clean: tuple[float, ...], outcome: str
) -> None:
    scores = on_real(none=(0.5,) * len(real), md=real)
    for row, own, without in (("none", (0.5,) * len(real), (0.8,) * len(real)), ("md", rendered, clean)):
        scores[row] |= {"md": dict(enumerate(own)), "none": dict(enumerate(without))}
    (found,) = verdicts(scores, {"none": 1.0, "md": 1.5})
    assert (found["row"], found["against"], found["verdict"], found["ms_a_sample"]) == ("md", "none", outcome, 0.5)


def test_further_artifacts_are_judged_by_their_own_images_and_against_all() -> None:
    scores = on_real(none=(0.5, 0.5), all=(0.5, 0.5), sensor=(0.5, 0.5))
    for row, value in (("none", 0.5), ("all", 0.6), ("sensor", 0.7)):
        scores[row]["sensor"] = {0: value, 1: value}
    found = {(each["row"], each["against"]): each for each in verdicts(scores, {})}
    assert {*found} == {("all", "none"), ("sensor", "none"), ("sensor", "all")}
    assert found["sensor", "all"]["better_rendered"] == ["sensor"]
    assert found["all", "none"]["verdict"] == "untestable here"  # better where it is not at home is no harm
    assert found["all", "none"]["ms_a_sample"] is None


def test_finished_trainings_are_compared_with_others_of_their_recipe(
    figures_set: Path, measured: tuple[Path, Figures], one_run: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "runs"
    for name in ("none-0", "all-0"):
        shutil.copytree(measured[0] / name, folder / name)
    shutil.copytree(measured[0] / "md-0", folder / "sensor-0")
    card = json.loads((folder / "sensor-0" / "network.json").read_text())
    card["data"]["artifacts"] = artifacts_to_json([Noise(40, 40)])
    (folder / "sensor-0" / "network.json").write_text(json.dumps(card))
    shutil.copytree(folder / "sensor-0", folder / "mixture-0")
    parts = [card["data"], {**card["data"], "artifacts": artifacts_to_json([MissingData((0.5,))])}]
    (folder / "mixture-0" / "network.json").write_text(json.dumps(card | {"data": {"mixture": parts}}))
    shutil.copytree(one_run / "noise-0", tmp_path / "paper" / "noise-0")
    found = bench_variants(
        str(figures_set), (folder, tmp_path / "paper"), images=IMAGES, only_finished=True, hard=str(figures_set)
    )
    assert list(found["table"]) == ["none", "all", "mixture", "sensor"]
    assert {*found["table"]["mixture"]} == {*found["table"]["sensor"]}  # no images show a mixture's artifacts alone
    assert found["missing"] == ["occ-0", "noise-0", "md-0", *(f"{name}-{seed}" for seed in (1, 2) for name in VARIANTS)]
    assert found["table"]["all"]["hard"] == found["table"]["all"]["all"]  # the same images here
    model = load_network(folder / "none-0").network
    noisy = RangeImages(figures_set, "all", "test", 0, sensor=SensorModel("x", (Noise(40, 40),)))
    assert found["table"]["none"]["sensor"]["mean"] == slow_accuracy(model, noisy, IMAGES)
    ms = {row: each["ms"] for row, each in found["loader"].items()}
    assert {*ms} == {*VARIANTS, "sensor", "mixture", "mixture, 1", "mixture, 2"} and ms["sensor"] > 0
    assert ms["mixture"] == pytest.approx((ms["mixture, 1"] + ms["mixture, 2"]) / 2, abs=1e-4)
    assert [row["name"] for row in found["networks"]] == ["none-0", "all-0", "mixture-0", "sensor-0", "noise-0"]
    assert {(each["row"], each["verdict"]) for each in found["verdicts"]} == {
        (row, "undecided: one seed") for row in ("all", "mixture", "sensor")
    }
    card = json.loads((folder / "sensor-0" / "network.json").read_text())
    (folder / "sensor-0" / "network.json").write_text(json.dumps(card | {"recipe": {}}))
    with pytest.raises(BadConfig, match="differ in variant and seed alone: recipe of .*sensor-0 is {}, expected"):
        bench_variants(str(figures_set), (folder, tmp_path / "paper"), only_finished=True)
    (folder / "sensor-0" / "network.json").write_text(json.dumps(card))
    parts[1]["set"] = "another"
    (folder / "mixture-0" / "network.json").write_text(json.dumps(card | {"data": {"mixture": parts}}))
    with pytest.raises(BadConfig, match="differ in variant and seed alone: set of .*mixture-0 is "):
        bench_variants(str(figures_set), (folder, tmp_path / "paper"), only_finished=True)


def test_the_figure_is_drawn(measured: tuple[Path, Figures], tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    draw_variants(measured[1], tmp_path / "variants.png")
    picture = part(decoded(tmp_path / "variants.png"), down=(0, 0.9))  # without the legend
    for panel in ((0.0, 0.26), (0.26, 0.52), (0.52, 0.7)):  # the last curve, which lies on the others
        assert marks(part(picture, across=panel), _STYLES["all"].colour, 30, within=20), panel
    cells = np.unique(part(picture, across=(0.75, 1)).reshape(-1, 3), axis=0, return_counts=True)[1]
    assert (cells > 1500).sum() >= 4, "cells of the table are in shades"
