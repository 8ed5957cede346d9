"""`bodyseg stability` on plain figures and networks of a few weights."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from fakes import Figures
from label_networks import Places
from pictures import decoded, marks, part

from bodyseg_data import RangeImages
from bodyseg_data.bodies import SOURCES
from bodyseg_data.core import BadConfig
from bodyseg_data.labels import load_label_map
from bodyseg_data.rigs import Camera
from bodyseg_model.commands import cli
from bodyseg_model.commands import stability as command
from bodyseg_model.evaluation import ConfusionMatrix, TrueSurface
from bodyseg_model.networks import build, predict, save_network
from bodyseg_model.stability import Scenes, evaluate_conditions, load_runs
from bodyseg_model.stability.scenes import CLEAN, LabelledImage, SweepPoint
from bodyseg_model.stability.summary import score

SETTINGS = {"patch": 16, "widths": (8,), "blocks": (0,)}
CHOSEN = ("farther", "hard")


@pytest.fixture(scope="module", autouse=True)
def plain_bodies_and_one_thread() -> Iterator[None]:
    """The networks are tiny, and their threads would wait for each other."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(SOURCES, "open", Figures)
        yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs")
    for variant in ("all", "none"):
        for seed in range(2):
            (folder / f"{variant}-{seed}").mkdir()
            save(folder / f"{variant}-{seed}", variant, seed)
    return folder


def save(folder: Path, variant: str, seed: int) -> None:
    facts = {"variant": variant, "seed": seed, "recipe": {}, "data": {"seed": seed}, "command": "bodyseg train"}
    network = build("compact", SETTINGS, seed + 10 * (variant == "none"))
    save_network(folder / "network.safetensors", network, "compact", facts)


@pytest.fixture(scope="module")
def made(figures_set: Path, runs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the command wrote."""
    out = tmp_path_factory.mktemp("made") / "stability"
    assert command.run(asked(figures_set, runs, out)) == 0
    return out


def asked(data: Path, runs: Path, out: Path, **more: Any) -> command.Options:
    usual = {
        "run": (runs / "all-0", runs / "all-1"), "reference": (runs / "none-0",), "hard": str(data),
        "sweeps": CHOSEN, "images": 2, "device": "cpu",
    }  # fmt: skip
    return command.Options(data=str(data), out=out, **(usual | more))


def test_what_it_writes(made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    figures = json.loads((made / "stability.json").read_text())
    assert figures["format"] == "bodyseg stability 1"
    assert figures["command"].startswith("bodyseg stability --run all-0 all-1 --data")
    assert {"commit", "hardware", "threads", "seconds", "device"} <= set(figures)
    assert list(figures["sweeps"]) == list(CHOSEN) and figures["images"] == 2
    assert list(figures["groups"]) == ["all", "none"] and figures["reference"] == "none"
    every = figures["groups"]["all"]
    assert every["seeds"] == [0, 1] and every["few_seeds"] is True
    assert len(every["curves"]["farther"]["mean"]) == 4
    assert every["mce"]["mean"] is not None and every["mrr"]["mean"] is not None
    assert figures["networks"]["all-0"]["command"] == "bodyseg train"
    assert sorted(path.name for path in made.iterdir()) == ["stability.json", "stability.png"]
    picture = part(decoded(made / "stability.png"), down=(0.15, 0.85))  # without title and legend
    for left, right in ((0.05, 0.5), (0.54, 0.99)):
        panel = part(picture, across=(left, right))
        shown = [bool(marks(panel, colour, 4, within=30)) for colour in ("#b8360f", "#8a8a8a")]
        assert shown == [True, True], "a line of the group and the bound in every sweep's panel"


def test_accuracy_is_that_of_predictions_one_by_one(made: Path, runs: Path, figures_set: Path) -> None:
    images = RangeImages(figures_set, "none", "test")
    (run,) = load_runs([runs / "all-1"])
    matrix = ConfusionMatrix()
    for place in images.order(0)[:2]:
        item = images[int(place)]
        matrix.add(item["labels"].numpy(), predict(run.trained.network, item["range"][None]).labels[0].numpy())
    figures = json.loads((made / "stability.json").read_text())
    seeds = figures["groups"]["all"]["clean"]["stored"]["seeds"]
    assert seeds[1] == pytest.approx(matrix.average_per_class_accuracy(), abs=1e-5)


def test_answers_at_other_places_are_counted_there() -> None:
    range_m, places = torch.full((2, 4), 2.0).numpy(), torch.tensor([0, 3, 3, 4]).numpy()
    truth = torch.tensor([0, 3, 2, 0], dtype=torch.uint8).numpy()
    # Columns are labels: right at 0, 3 and (row 1, column 0) 4; wrong once where 3 was said for 2.
    labels = torch.tensor([[0, 255, 255, 2], [3, 255, 255, 255]], dtype=torch.uint8).numpy()
    camera = Camera(2, 4, 100.0, (2.0, 1.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    seen = torch.tensor([0, 4, 3, 0]).numpy()  # where the true surface shows what these pixels see
    found = score(Places(1, 1), [LabelledImage(range_m, places, truth, TrueSurface(range_m, labels, camera), seen)])
    assert found.accuracy == pytest.approx((1 + 1 + 0) / 3)
    # The part said there is 3 columns and a row of 20 mm away.
    assert found.gross_errors.to_json() == {"beyond_30_mm": 0.25, "beyond_60_mm": 0.25, "mean_mm": 15.81}


def test_progress_counts_images(runs: Path, figures_set: Path) -> None:
    seen: list[tuple[Any, ...]] = []
    loaded = load_runs([runs / "all-0", runs / "none-0"])
    scenes_here = Scenes(RangeImages(figures_set, "none", "test"), 3)
    conditions = [CLEAN["stored"], SweepPoint("noise", 10)]
    evaluate_conditions(loaded, conditions, scenes_here, lambda *figures: seen.append(figures))
    assert seen == [(3, 12, "clean"), (6, 12, "clean"), (9, 12, "noise 10"), (12, 12, "noise 10")]


def test_an_accuracy_of_nothing_measured_is_none() -> None:
    nothing = torch.zeros(0, dtype=torch.int64).numpy()
    ranges, camera = torch.full((2, 4), 2.0).numpy(), Camera(2, 4, 1.0, (2.0, 1.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    surface = TrueSurface(ranges, ranges.astype("uint8"), camera)
    found = score(Places(1, 1), [LabelledImage(ranges, nothing, nothing.astype("uint8"), surface, nothing)])
    assert math.isnan(found.accuracy) and found.gross_errors.to_json() is None


def test_names_tell_runs_apart_and_each_counts_once(runs: Path, tmp_path: Path) -> None:
    other = shutil.copytree(runs / "all-0", tmp_path / "other" / "all-0")
    found = load_runs([runs / "all-0", other, runs / "all-1", runs / "all-0", runs / "none-0" / "network.safetensors"])
    assert [run.name for run in found] == [f"{runs.name}/all-0", "other/all-0", "all-1", "network"]
    assert [run.seed for run in found] == [0, 0, 1, 0]
    paths = [tmp_path / name for name in ("lr0.1", "lr0.2", "mine", "mine.safetensors")]
    for path in paths[:3]:
        shutil.copytree(runs / "all-0", path)
    for suffix in (".safetensors", ".json"):
        shutil.copy(runs / "all-1" / f"network{suffix}", paths[3].with_suffix(suffix))
    assert [run.name for run in load_runs(paths)] == [path.name for path in paths], "a name for two hides one"


def test_a_folder_that_cannot_be_written_is_told_before_the_sweeps(
    figures_set: Path, runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(command, "_images", lambda *given: pytest.fail("measured first"))
    (tmp_path / "stability.json").mkdir()
    with pytest.raises(BadConfig, match=r"--out needs a file in a folder that is there, found .*stability\.json"):
        command.run(asked(figures_set, runs, tmp_path))


def test_networks_of_other_classes_are_refused(figures_set: Path, runs: Path, tmp_path: Path) -> None:
    labels = load_label_map("limbs14").to_json()
    network = build("compact", {**SETTINGS, "classes": 14}, 1)
    save_network(tmp_path / "limbs.safetensors", network, "compact", {"variant": "all", "seed": 1, "labels": labels})
    with pytest.raises(BadConfig, match=r"limbs\.safetensors: stability is measured on the 33 parts, .* 'limbs14'"):
        command.run(asked(figures_set, runs, tmp_path / "out", run=(tmp_path / "limbs.safetensors",)))
    assert not (tmp_path / "out").exists()


def test_without_a_reference_there_is_no_mce(
    runs: Path, figures_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = asked(figures_set, runs, tmp_path / "out", reference=(), sweeps=("hard",), images=1)
    assert command.run(options) == 0
    figures = json.loads((tmp_path / "out" / "stability.json").read_text())
    assert figures["reference"] is None and figures["groups"]["all"]["mce"] is None
    printed, said = capsys.readouterr()
    lines = printed.splitlines()
    assert len(lines) == len(figures["sweeps"])
    for line, (name, curve) in zip(lines, figures["groups"]["all"]["curves"].items(), strict=True):
        far = figures["groups"]["all"]["gross_errors"][name]["beyond_30_mm"]["mean"][-1]
        sweep = figures["sweeps"][name]
        assert line.startswith(f"{name} ({sweep['axis']}), all: {100 * curve['mean'][0]:.1f} % at ")
        last = f"{100 * curve['mean'][-1]:.1f} % at {sweep['strengths'][-1]:g}"
        assert line.endswith(f", {last}; there {100 * far:.1f} % beyond 30 mm")
    assert "no --reference, so no mCE" in said and "fewer than 3 seeds, so no spread to speak of: all" in said


def test_conditions_choose_among_hard_poses_too(runs: Path, figures_set: Path, tmp_path: Path) -> None:
    where = ("distance_cm<=215",)
    command.run(asked(figures_set, runs, tmp_path / "out", reference=(), sweeps=("hard",), images=1, where=where))
    figures = json.loads((tmp_path / "out" / "stability.json").read_text())
    for name in ("data", "hard"):
        assert figures[name]["samples_of_split"] == len(RangeImages(figures_set, "none", "test", where=where)) < 8


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"images": 0}, "--images must be a whole number of at least 1, found 0"),
        ({"sweeps": ("rain",)}, "a sweep must be one of"),
        ({"hard": None}, "needs a set of hard poses"),
        ({"hard": "absent"}, "absent"),
    ],
)
def test_what_makes_no_sense_is_refused(
    more: dict[str, Any], message: str, runs: Path, figures_set: Path, tmp_path: Path
) -> None:
    with pytest.raises(BadConfig, match=message):
        command.run(asked(figures_set, runs, tmp_path / "out", **more))
    assert not (tmp_path / "out").exists()


def test_out_must_be_a_folder(
    runs: Path, figures_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "taken").write_text("")
    words = ["--run", str(runs / "all-0"), "--data", str(figures_set), "--out", str(tmp_path / "taken")]
    assert cli.main(["stability", *words]) == 2
    assert "--out needs a file in a folder that is there, found" in capsys.readouterr().err
