"""`bench architectures` on small networks with new weights."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from benches.model.networks import architectures as bench
from benches.model.networks import architectures_runs
from benches.model.networks.architectures import bench_architectures
from benches.model.networks.architectures_forest import ForestScale, fit_forest
from benches.model.networks.architectures_runs import groups_in
from benches.model.networks.network_times import LEAST_ROUNDS

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.loading.range_images import RangeImages
from bodyseg_model.evaluation.scores import ConfusionMatrix
from bodyseg_model.networks.checkpoints import load_network, save_network
from bodyseg_model.networks.network import Network
from bodyseg_model.networks.registry import build, parameters, predict

TINY = {"patch": 16, "widths": [8], "blocks": [0]}
NARROW = {"width": 1 / 16}
RECIPE = {"steps": 10, "batch_size": 8, "accumulate": 1, "learning_rate": 2e-3}
DATA = {"set": "of these", "split": "train", "variant": "all"}
IMAGES = 2


def person() -> np.ndarray[Any, np.dtype[np.float32]]:
    frame = np.zeros((64, 48), np.float32)
    frame[8:56, 12:40] = 2.5
    return frame


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Small frames, one thread, five rounds, a small forest; what ships is a tiny network."""
    monkeypatch.setattr(bench, "processors", lambda: 1)
    monkeypatch.setattr(bench, "typical_frames", lambda count: [person() for _ in range(count)])
    monkeypatch.setattr(bench, "MOST_ROUNDS", LEAST_ROUNDS)
    monkeypatch.setattr(bench, "ForestScale", small_forest)
    shipped = tmp_path / "shipped.safetensors"
    save_network(shipped, build("compact", TINY, 9), "compact", {})
    monkeypatch.setattr(architectures_runs, "SHIPPED", shipped)


def small_forest(images: int) -> ForestScale:
    return ForestScale(images, pixels=99, candidates=8, tried=2, depth=4)


Make = Callable[..., Path]


@pytest.fixture
def run(tmp_path: Path) -> Make:
    def make(name: str, kind: str = "compact", settings: Any = None, folder: str = "runs", **changes: Any) -> Path:
        path = tmp_path / folder / name
        path.mkdir(parents=True)
        seed = int(name.rpartition("-")[2])
        facts = {
            "variant": "all",
            "recipe": RECIPE | changes.pop("recipe", {}),
            "data": DATA | {"seed": seed} | changes.pop("data", {}),
            "command": f"trained {name}",
            "commit": "abc",
        }
        save_network(path / "network.safetensors", build(kind, settings or TINY, seed), kind, facts | changes)
        return path.parent

    return make


def accuracy(network: Network, data: Path) -> float:
    """Slowly: one image after the other, in the order of the images' epoch."""
    images, matrix = RangeImages(data, "all", "test", 0), ConfusionMatrix()
    for index in images.order(0)[:IMAGES].tolist():
        sample = images[index]
        matrix.add(sample["labels"].numpy(), predict(network, sample["range"][None]).labels[0].numpy())
    return round(matrix.average_per_class_accuracy(), 5)


def test_every_network_is_judged_and_timed(figures_set: Path, run: Make) -> None:
    pytest.importorskip("sklearn")
    data = {"set": RangeImages(figures_set, "all", "train").identity()["set"]}
    for seed in (1, 0):
        run(f"compact-{seed}", data=data)
    folder = run("fcn_alexnet_16th-0", "fcn_alexnet", NARROW, data=data, recipe={"learning_rate": 5e-4})
    (folder / "notes").mkdir()
    seen: list[tuple[int, int]] = []
    found = bench_architectures(
        str(figures_set), (folder,), IMAGES, 2, 4, lambda done, total, note: seen.append((done, total))
    )
    assert json.loads(json.dumps(found)) == found
    cells, runs = 4, 3
    assert seen == [(done, cells + runs + 2) for done in range(1, cells + runs + 3)]
    assert list(found["networks"]) == ["compact", "fcn_alexnet_16th", "forest"] and found["reference"] == "compact"
    compact, alexnet, forest = found["networks"].values()
    assert [row["default"] for row in (compact, alexnet, forest)] == [True, False, False]
    assert (compact["label"], alexnet["label"]) == ("compact", "FCN-AlexNet, width 1/16")
    assert [row["family"] for row in (compact, alexnet, forest)] == ["compact", "fcn_alexnet", "forest"]
    assert compact["commands"] == {"compact-0": "trained compact-0", "compact-1": "trained compact-1"}
    assert compact["parameters"] == parameters(build("compact", TINY)) and forest["parameters"] > 33
    each = [accuracy(load_network(folder / f"compact-{seed}").network, figures_set) for seed in (0, 1)]
    assert compact["accuracy_all"]["seeds"] == each
    assert compact["accuracy_all"]["mean"] == pytest.approx(np.mean(each), abs=1e-5)
    assert compact["accuracy_all"]["sd"] == pytest.approx(np.std(each, ddof=1), abs=1e-5)
    grown = fit_forest(RangeImages(figures_set, "all", "train"), small_forest(4))
    assert forest["accuracy_all"] == {
        "mean": accuracy(grown, figures_set),
        "sd": None,
        "seeds": [accuracy(grown, figures_set)],
    }
    assert set(compact["subsets"]) == set(forest["subsets"]) <= {"A", "people"}
    for name, row in found["networks"].items():
        times = {(cell["task"], cell["frame"]): cell["networks"][name] for cell in found["times"]}
        assert len(times) == cells
        assert row["cpu_ms"] == times["scores", "filled"]["ms"] > 0
        assert row["labels_ms"] == times["labels", "typical"]["ms"] > 0
        assert row["gpu_ms"] is None
    assert {cell["networks"]["compact"]["times_as_long"] for cell in found["times"]} == {1.0}
    scale = found["scale"]
    assert (scale["steps"], scale["batch_size"], scale["test_images"], scale["test_images_of"]) == (10, 8, IMAGES, 8)
    assert (scale["forest_images"], scale["shottons_forest_images"]) == (4, 900_000)


def test_a_forest_may_be_left_out_and_scores_are_kept(
    figures_set: Path, run: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = run("compact_small-0", settings={**TINY, "widths": [4]})  # of another set, which only a forest minds
    first = bench_architectures(str(figures_set), (folder,), IMAGES, 1, 0)
    assert list(first["networks"]) == ["compact_small"] and first["scale"]["forest_images"] is None
    assert first["networks"]["compact_small"]["default"] is False and first["reference"] == "compact_small"
    monkeypatch.setattr("benches.model.variants.scores.evaluate", None)
    again = bench_architectures(str(figures_set), (folder,), IMAGES, 1, 0)
    assert again["networks"]["compact_small"]["accuracy_all"] == first["networks"]["compact_small"]["accuracy_all"]
    with pytest.raises(
        BadConfig, match=r"a forest learns from what the networks learned from: .* is of the set of the"
    ):
        bench_architectures(str(figures_set), (folder,), IMAGES, 1, 4)


def test_a_gpu_is_asked_where_there_is_one(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = bench._cells()
    assert {(cell.frame, cell.task) for cell in plain} == {
        ("filled", "scores"), ("filled", "labels"), ("typical", "scores"), ("typical", "labels"),
    }  # fmt: skip
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    (further,) = bench._cells()[len(plain) :]
    assert (further.device, further.frame, further.task) == ("cuda", "filled", "scores")
    times = [
        {"task": "scores", "frame": "filled", "device": "cpu", "networks": {"a": {"ms": 9.0}, "forest": {"ms": 7.0}}},
        {"task": "scores", "frame": "filled", "device": "cuda", "networks": {"a": {"ms": 0.5}}},
    ]
    assert bench._headlines(times, "a") == {"cpu_ms": 9.0, "labels_ms": None, "gpu_ms": 0.5}
    assert bench._headlines(times, "forest") == {"cpu_ms": 7.0, "labels_ms": None, "gpu_ms": None}


def test_a_subset_too_small_has_no_accuracy() -> None:
    def scores(first: float, second: float | None) -> dict[str, Any]:
        subsets = {"A": {"average_per_class_accuracy": first}, "B": {"average_per_class_accuracy": second}}
        return {"average_per_class_accuracy": 0.5, "subsets": subsets}

    found = bench._accuracies([scores(0.4, None), scores(0.6, None)])
    assert found["subsets"] == {"A": {"mean": 0.5, "sd": 0.14142, "seeds": [0.4, 0.6]}, "B": None}


def test_runs_are_grouped_by_name(run: Make) -> None:
    run("compact-10")
    first = run("compact-2")
    second = run("compact_small-0", folder="further", settings={**TINY, "widths": [4]})
    (first / "compact").mkdir()
    (first / "log-1").write_text("a file")
    groups = groups_in((first, second))
    assert {name: [each.seed for each in group] for name, group in groups.items()} == {
        "compact": [2, 10],
        "compact_small": [0],
    }


@pytest.mark.parametrize(
    ("kind", "settings", "changes", "message"),
    [
        ("fcn_alexnet", NARROW, {"recipe": {"steps": 11}}, "steps is 11 in .*other-0 and 10 in .*compact-0"),
        ("fcn_alexnet", NARROW, {"recipe": {"batch_size": 4}}, "batch_size is 4 in"),
        ("fcn_alexnet", NARROW, {"recipe": {"accumulate": 2}}, "accumulate is 2 in"),
        ("fcn_alexnet", NARROW, {"data": {"set": "of those"}}, "set of the images is 'of those' in"),
        ("fcn_alexnet", NARROW, {"data": {"only": ["x"]}}, r"only of the images is \['x'\] in .* and None in"),
        ("fcn_alexnet", NARROW, {"variant": "md"}, "networks to compare are trained on all, found 'md': .*other-0"),
        ("fcn_alexnet", NARROW, {"data": None}, "networks to compare are trained on all"),
    ],
)
def test_networks_not_trained_alike(kind: str, settings: Any, changes: Any, message: str, run: Make) -> None:
    folder = run("compact-0")
    if changes.get("data", {}) is None:
        run("other-0", kind, settings)
        card = folder / "other-0" / "network.json"
        card.write_text(json.dumps({**json.loads(card.read_text()), "data": None}))
    else:
        run("other-0", kind, settings, **changes)
    with pytest.raises(BadConfig, match=message):
        groups_in((folder,))


def test_seeds_of_a_name_share_everything(run: Make) -> None:
    folder = run("compact-0")
    run("compact-1", settings={**TINY, "widths": [4]})
    with pytest.raises(BadConfig, match=r"trained alike: settings is .*\[4\].* in .*compact-1 and .*\[8\]"):
        groups_in((folder,))
    other = run("compact-1", folder="others", recipe={"learning_rate": 1e-3})
    (folder / "compact-1" / "network.json").unlink()
    with pytest.raises(BadConfig, match="cannot read .*compact-1"):
        groups_in((folder,))
    with pytest.raises(BadConfig, match="recipe is .*0.001"):
        groups_in((run("compact-0", folder="alone"), other))


def test_there_must_be_runs(run: Make, tmp_path: Path, figures_set: Path) -> None:
    folder, again = run("compact-0"), run("compact-0", folder="again")
    with pytest.raises(BadConfig, match=r"every training must be there once, found seeds \[0, 0\] of compact"):
        groups_in((folder, again))
    (tmp_path / "empty").mkdir()
    with pytest.raises(BadConfig, match="no training NAME-SEED in .*empty"):
        groups_in((tmp_path / "empty",))
    with pytest.raises(BadConfig, match="no training NAME-SEED in no folder"):
        groups_in(())
    with pytest.raises(BadConfig, match="--runs must be folders of trainings, found .*nowhere"):
        groups_in((tmp_path / "nowhere",))
    with pytest.raises(BadConfig, match="the number of test images must be a whole number of at least 1, found 0"):
        bench_architectures(str(figures_set), (folder,), 0)
    with pytest.raises(BadConfig, match="the number of the forest's images must be a whole number of at least 0"):
        bench_architectures(str(figures_set), (folder,), forest=-1)


def test_nothing_ships(run: Make, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (group,) = groups_in((run("compact-0"),)).values()
    assert architectures_runs.is_shipped(group[0])
    monkeypatch.setattr(architectures_runs, "SHIPPED", tmp_path / "none.safetensors")
    assert not architectures_runs.is_shipped(group[0])
