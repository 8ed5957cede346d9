from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from benches.__main__ import main
from benches.model.variants import bench as variants
from benches.model.variants import runs as variants_runs
from benches.model.variants import scores as variants_scores
from benches.model.variants.bench import bench_variants
from benches.model.variants.claims import claims
from benches.model.variants.figure import draw_variants
from benches.model.variants.runs import Run, common_plan, runs_in, train
from benches.model.variants.scores import SWEEPS, SWEEPS_ALONE, TABLE, Evaluator, Condition, Sweep
from PIL import Image

from bodyseg_data import RangeImages
from bodyseg_data.artifacts.missing_data import MissingData
from bodyseg_data.artifacts.noise import Noise
from bodyseg_data.artifacts.variants import VARIANTS, Artifacts
from bodyseg_data.core.errors import BadConfig
from bodyseg_model.commands import train as train_command
from bodyseg_model.evaluation.evaluation import evaluate
from bodyseg_model.evaluation.report import over_seeds
from bodyseg_model.evaluation.scores import ConfusionMatrix
from bodyseg_model.networks.checkpoints import load_network
from bodyseg_model.networks.registry import predict
from bodyseg_model.training.distributed import ProcessGroup
from bodyseg_model.training.loop import Metrics, RunOptions

SETTINGS = '{"patch": 16, "widths": [8], "blocks": [0]}'
STEPS = 2
IMAGES = 2
HERE = ProcessGroup(0, 1, torch.device("cpu"))


def trained_by_command(data: Path, out: Path, variant: str) -> None:
    options = train_command.Options(
        str(data),
        out,
        variant,
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
    """Two strengths a sweep, and no worker processes."""
    with pytest.MonkeyPatch.context() as patch:
        for sweeps in (SWEEPS, SWEEPS_ALONE):
            for name, sweep in sweeps.items():
                patch.setitem(sweeps, name, short(sweep, 0, *(s for s in sweep.strengths if s in (40, 0.5))))
        patch.setattr(variants_runs, "_RUN_OPTIONS", RunOptions(log_every=1, checkpoint_every=1, num_workers=0))
        yield


@pytest.fixture(scope="module")
def one_run(figures_set: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one training of the five, made by the command."""
    folder = tmp_path_factory.mktemp("runs")
    trained_by_command(figures_set, folder / "noise-0", "noise")
    return folder


@pytest.fixture(scope="module")
def measured(figures_set: Path, one_run: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    folder = shutil.copytree(one_run, tmp_path_factory.mktemp("measured") / "runs")
    return folder, bench_variants(str(figures_set), (folder,), seeds=1, images=IMAGES)


def accuracy(run: Path, images: RangeImages) -> float:
    """Slowly: one image after the other, in the order of the images' epoch."""
    matrix = ConfusionMatrix()
    for index in images.order(0)[:IMAGES].tolist():
        sample = images[index]
        matrix.add(
            sample["labels"].numpy(), predict(load_network(run).network, sample["range"][None]).labels[0].numpy()
        )
    return round(matrix.average_per_class_accuracy(), 5)


def test_every_network_meets_every_test_set(figures_set: Path, measured: tuple[Path, dict[str, Any]]) -> None:
    folder, figures = measured
    assert list(figures["table"]) == list(VARIANTS)
    for train_on, test_on in (("all", "noise"), ("noise", "md"), ("none", "none")):
        found = figures["table"][train_on][test_on]
        expected = accuracy(folder / f"{train_on}-0", RangeImages(figures_set, test_on, "test", 0))
        assert found == {"mean": expected, "sd": None, "seeds": [expected]}
    strong = {"noise": Artifacts(noise=Noise(40, 40)), "missing": Artifacts(missing_data=MissingData((0.5,)))}
    for name, artifacts in strong.items():
        sweep = figures["sweeps"][name]
        assert sweep["artifacts_of_the_test_images"] == ["occlusion", "noise", "missing_data"]
        expected = accuracy(folder / "md-0", RangeImages(figures_set, "all", "test", 0, artifacts=artifacts))
        assert sweep["curves"]["md"]["mean"][1] == expected
        assert len(sweep["strengths"]) == len(sweep["curves"]["md"]["seeds"][0]) == 2
    scale = figures["scale"]
    assert (scale["steps"], scale["images_a_step"], scale["seeds"]) == (STEPS, 2, 1)
    assert (scale["test_images"], scale["test_images_of"], scale["train_images"]) == (IMAGES, 8, 16)
    assert [row["name"] for row in figures["networks"]] == [f"{name}-0" for name in VARIANTS]
    assert set(figures["subsets"]["all"]) <= {"A", "people"}
    assert json.loads(json.dumps(figures)) == figures


def test_what_is_missing_is_trained_as_the_command_would(
    figures_set: Path, measured: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    folder, _ = measured
    trained_by_command(figures_set, tmp_path / "md-0", "md")
    ours, theirs = (where / "md-0" for where in (folder, tmp_path))
    assert (ours / "network.safetensors").read_bytes() == (theirs / "network.safetensors").read_bytes()
    assert json.loads((ours / "run.json").read_text()) == json.loads((theirs / "run.json").read_text())


def test_a_second_run_trains_and_asks_nothing_again(
    figures_set: Path, measured: tuple[Path, dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*given: Any, **named: Any) -> None:
        raise AssertionError("nothing is left to do")

    monkeypatch.setattr(variants_scores, "evaluate", refuse)
    monkeypatch.setattr(variants, "train", refuse)
    folder, before = measured
    seen: list[tuple[int, int]] = []
    again = bench_variants(
        str(figures_set),
        (folder,),
        seeds=1,
        images=IMAGES,
        progress=lambda done, total, note="": seen.append((done, total)),
    )
    assert {**again, "seconds": 0} == {**before, "seconds": 0}
    assert seen[-1] == (5 * 9 * IMAGES,) * 2 and len(seen) == 5 * 9
    with pytest.raises(AssertionError, match="nothing is left"):  # these images have not been shown
        bench_variants(str(figures_set), (folder,), seeds=1, images=IMAGES + 1)


def test_scores_are_of_one_network(
    figures_set: Path, measured: tuple[Path, dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = shutil.copytree(measured[0] / "all-0", tmp_path / "all-0")
    asked: list[Any] = []
    monkeypatch.setattr(
        variants_scores, "evaluate", lambda *given, **named: asked.append(named) or evaluate(*given, **named)
    )

    def scores(condition: Condition, extras: bool = False) -> Any:
        evaluator = Evaluator(str(figures_set), IMAGES)
        return evaluator.scores(folder, load_network(folder).network, condition, extras)

    before = scores(TABLE["noise"])
    assert not asked and scores(TABLE["noise"]) == before
    more = scores(TABLE["noise"], extras=True)
    assert len(asked) == 1 and more["average_per_class_accuracy"] == before["average_per_class_accuracy"]
    for name in ("network.safetensors", "network.json"):
        shutil.copy(measured[0] / "none-0" / name, folder)
    after = scores(TABLE["noise"])
    assert len(asked) == 2 and after != before
    assert after == Evaluator(str(figures_set), IMAGES).scores(
        measured[0] / "none-0", load_network(folder).network, TABLE["noise"], False
    )


def test_a_training_that_was_cut_goes_on(
    figures_set: Path, measured: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    folder, _ = measured
    plan = common_plan(runs_in(folder, 1), str(figures_set), None)

    def cut(figures: Metrics) -> None:
        if figures.step == STEPS:
            raise KeyboardInterrupt

    run = Run("occ", 0, tmp_path / "occ-0")
    with pytest.raises(KeyboardInterrupt):
        train(run, plan, str(figures_set), HERE, cut)
    assert not run.finished and (run.path / "checkpoint.json").exists()
    assert common_plan([run], str(figures_set), None) == plan  # the folder of a training that was begun tells as much
    steps: list[int] = []
    train(run, plan, str(figures_set), HERE, lambda figures: steps.append(figures.step))
    assert run.finished and steps == [STEPS]
    assert run.path.joinpath("network.safetensors").read_bytes() == (folder / "occ-0/network.safetensors").read_bytes()


def test_the_sweeps_change_one_artifact_of_x_all(figures_set: Path) -> None:
    plain = RangeImages(figures_set, "all", "test", 0)
    noisy, holed = (condition.open(str(figures_set)) for condition in (Condition("all", 40), Condition("all", None, 0.5)))
    assert {image.sigma_mm for image in map(noisy.image, range(8))} == {40}
    assert {image.missing_rate for image in map(holed.image, range(8))} == {0.5}
    for index in range(8):
        before, louder, emptier = (images.image(index) for images in (plain, noisy, holed))
        assert np.array_equal(before.labels, louder.labels) and before.missing_rate == louder.missing_rate
        assert before.sigma_mm == emptier.sigma_mm
        both = (before.range > 0) & (emptier.range > 0)
        assert both.any() and np.array_equal(before.range[both], emptier.range[both])
    assert Condition("all", 40).name == "all, sigma 40 mm" and Condition("md", missing=0.5).name == "md, 50% missing"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"runs": (Path("a"), Path("b"))}, "keeps its trainings in one folder, found 2 with --runs"),
        ({"seeds": 0}, "the number of seeds must be a whole number of at least 1, found 0"),
        ({"images": 0}, "the number of test images must be a whole number of at least 1, found 0"),
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


def test_a_new_folder_takes_the_preset(figures_set: Path, tmp_path: Path) -> None:
    plan = common_plan(runs_in(tmp_path, 2), str(figures_set), 7)
    assert plan.recipe.steps == 7 and plan.recipe.batch_size == train_command.recipe_for("compact").batch_size
    assert [run.name for run in runs_in(tmp_path, 2)][:6] == ["none-0", "occ-0", "noise-0", "md-0", "all-0", "none-1"]


def test_means_and_deviations_over_seeds() -> None:
    assert over_seeds([0.5, 0.6, 0.8]) == {"mean": 0.63333, "sd": 0.15275, "seeds": [0.5, 0.6, 0.8]}
    assert over_seeds([0.5]) == {"mean": 0.5, "sd": None, "seeds": [0.5]}


# Accuracy on clean test images, and points lost for each mm of sigma and for each percent missing: as the paper says.
AS_THE_PAPER = {
    "none": (0.60, 0.02, 0.8),
    "occ": (0.66, 0.02, 0.7),
    "noise": (0.62, 0.01, 0.8),
    "md": (0.75, 0.02, 0.03),
    "all": (0.82, 0.01, 0.03),
}


def scores_table(table: dict[str, tuple[float, float, float]], edge: float = 0.5) -> Callable[[str, Condition], list[Any]]:
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

    return scores_of


def test_claims_hold_where_they_do() -> None:
    found = claims(scores_table(AS_THE_PAPER), alone=True)
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
        ("all", (0.82, 0.06, 0.03), ["noise and all lose at most 2 points at a sigma of 40 mm", "without other"]),
        ("all", (0.82, 0.01, 0.05), ["md and all lose at most 2 points", "without other"]),
        ("occ", (0.66, 0.06, 0.7), ["so do networks that never saw noise"]),
        ("noise", (0.70, 0.01, 0.8), ["each gain more on none"]),
        ("occ", (0.80, 0.02, 0.03), ["gains most on none"]),
        ("none", (0.60, 0.02, 0.5), ["accuracy collapses"]),
    ],
)
def test_claims_do_not_hold_where_they_do_not(
    variant: str, values: tuple[float, float, float], texts: list[str]
) -> None:
    found = claims(scores_table({**AS_THE_PAPER, variant: values}), alone=True)
    broken = [row["claim"] for row in found if row["holds"] is False]
    assert len(broken) == len(texts)
    assert all(text in claim for text, claim in zip(texts, broken, strict=True))


def test_claims_of_single_images_and_subsets_can_fail() -> None:
    def scores_of(variant: str, condition: Condition) -> list[Any]:
        (record, *_) = scores_table(AS_THE_PAPER, edge=0.05)(variant, condition)
        record["subsets"] = {"B": {"average_per_class_accuracy": 0.9}, "C": {"average_per_class_accuracy": None}}
        above = record["confidence"]["above_70_percent"]
        above["share_of_pixels"], above["average_per_class_accuracy"] = 0.5, 0.1
        return [record]

    found = claims(scores_of, alone=False)
    assert [row["holds"] for row in found[:6]] == [False, False, False, False, None, None]
    assert len(found) == len(claims(scores_table(AS_THE_PAPER), alone=True)) - 2


@pytest.mark.parametrize("alone", [False, True])
def test_the_figure_is_drawn(alone: bool, measured: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    scores_of = scores_table(AS_THE_PAPER)
    sweeps = SWEEPS | (SWEEPS_ALONE if alone else {})
    three = {
        "scale": {**measured[1]["scale"], "seeds": 3},
        "table": {
            train_on: {name: over_seeds(variants.accuracies(scores_of, train_on, TABLE[name])) for name in VARIANTS}  # type: ignore[arg-type]
            for train_on in VARIANTS
        },
        "sweeps": {name: variants._curves(scores_of, sweep) for name, sweep in sweeps.items()},  # type: ignore[arg-type]
    }
    sizes = []
    for name, figures in (("one.png", measured[1]), ("three.png", three)):
        draw_variants(figures, tmp_path / name)
        with Image.open(tmp_path / name) as picture:
            sizes.append(picture.size)
            assert len(picture.convert("RGB").getcolors(1 << 24) or []) > 300
    assert (sizes[1][1] > 1.4 * sizes[0][1]) == alone
    with pytest.raises(BadConfig, match="cannot write"):
        draw_variants(three, tmp_path / "nowhere" / "x.png")


def test_the_command_writes_what_was_measured(
    figures_set: Path, measured: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    folder, figures = measured
    out = tmp_path / "variants.json"
    words = ["--data", str(figures_set), "--runs", str(folder), "--seeds", "1", "--images", str(IMAGES)]
    assert main(["bench", "variants", *words, "--json", str(out)]) == 0
    written = json.loads(out.read_text())
    assert written["command"].startswith("tools/bench variants --data shards --runs runs --seeds 1 --images 2 --json")
    assert written["table"] == figures["table"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["variants", "--runs", "x"], "bench variants needs --data"),
        (["variants", "--data", "x"], "bench variants needs --runs"),
        (["variants", "--views", "3"], "--views is for bench occlusion, borders, reduction"),
        (["codec", "--alone"], "--alone is for bench variants, found it with bench codec"),
        (["codec", "--runs", "x"], "--runs is for bench variants, network, sensors, architectures"),
        (["codec", "--num-workers", "1"], "--num-workers is for bench loader, found it with bench codec"),
    ],
)
def test_options_go_with_their_bench(words: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", *words]) == 2
    assert message in capsys.readouterr().err
