"""`bench architectures` on small networks with new weights."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benches import result_cache
from benches.model.chosen import parameters
from benches.model.networks import architectures as bench
from benches.model.networks import architectures_runs, network_times
from benches.model.networks.architectures import bench_architectures
from benches.model.networks.architectures_forest import ForestScale, fit_forest
from benches.model.networks.architectures_runs import groups_in
from benches.model.networks.network_times import LEAST_ROUNDS
from same_code import names_alone
from slow_accuracy import slow_accuracy

from bodyseg_data.core import BadConfig
from bodyseg_data.loading import RangeImages
from bodyseg_model.networks import build, load_network, save_network

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
    """Small frames, one thread, five rounds, one run before each, a small forest; what ships is a tiny network."""
    monkeypatch.setattr(bench, "processors", lambda: 1)
    monkeypatch.setattr(bench, "typical_frames", lambda count: [person() for _ in range(count)])
    monkeypatch.setattr(network_times, "MOST_ROUNDS", LEAST_ROUNDS)
    monkeypatch.setattr(network_times, "WARM_S", 0.0)
    monkeypatch.setattr(bench, "ForestScale", small_forest)
    monkeypatch.setattr(result_cache, "code_digest", names_alone)
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


def test_every_network_is_judged_and_timed(figures_set: Path, run: Make) -> None:
    pytest.importorskip("sklearn")
    images = RangeImages(figures_set, "all", "test", 0)
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
    each = [slow_accuracy(load_network(folder / f"compact-{seed}").network, images, IMAGES) for seed in (0, 1)]
    assert compact["accuracy_all"]["seeds"] == each
    assert compact["accuracy_all"]["mean"] == pytest.approx(np.mean(each), abs=1e-5)
    assert compact["accuracy_all"]["sd"] == pytest.approx(np.std(each, ddof=1), abs=1e-5)
    grown = fit_forest(RangeImages(figures_set, "all", "train"), small_forest(4))
    expected = slow_accuracy(grown, images, IMAGES)
    assert forest["accuracy_all"] == {"mean": expected, "sd": None, "seeds": [expected]}
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


def test_a_forest_may_be_left_out(figures_set: Path, run: Make) -> None:
    folder = run("compact_small-0", settings={**TINY, "widths": [4]})  # of another set, which only a forest minds
    found = bench_architectures(str(figures_set), (folder,), IMAGES, 1, 0)
    assert list(found["networks"]) == ["compact_small"] and found["scale"]["forest_images"] is None
    row = found["networks"]["compact_small"]
    network = load_network(folder / "compact_small-0").network
    expected = slow_accuracy(network, RangeImages(figures_set, "all", "test", 0), IMAGES)
    assert row["accuracy_all"] == {"mean": expected, "sd": None, "seeds": [expected]}
    assert (row["default"], found["reference"], row["gpu_ms"]) == (False, "compact_small", None)
    assert row["parameters"] == parameters(network) and row["cpu_ms"] > 0 and row["labels_ms"] > 0
    with pytest.raises(BadConfig, match="a forest learns from what the networks learned from: .* is of the set of the"):
        bench_architectures(str(figures_set), (folder,), IMAGES, 1, 4)


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
