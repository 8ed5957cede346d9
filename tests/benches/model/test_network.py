from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from benches.model.chosen import parameters
from benches.model.networks import network as bench
from benches.model.networks import network_times
from benches.model.networks.network import bench_network
from benches.model.networks.network_figure import _MARKS, draw_network
from benches.model.networks.network_times import operations, summary
from pictures import decoded, marks, part
from torch import nn

from bodyseg_data.core import BadConfig, MissingLibrary
from bodyseg_model.networks import Network, build, save_network

TINY: dict[str, dict[str, Any]] = {
    "fcn_alexnet": {"width": 1 / 16},
    "compact": {"patch": 16, "widths": [8], "blocks": [0]},
}


def person(rows: int = 64, columns: int = 48) -> np.ndarray[Any, np.dtype[np.float32]]:
    frame = np.zeros((rows, columns), np.float32)
    frame[8:56, 12:40] = 2.5
    frame[8:20, 12:20] = frame[8:20, 32:40] = 0  # shoulders
    return frame


def new(name: str, settings: Any = None, seed: int | None = None) -> Network:
    """Small, and as on a machine where networks of other packages are not installed."""
    if name not in TINY:
        raise MissingLibrary(f"{name} needs another package")
    return build(name, settings or TINY[name], seed)


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Small networks and images, no shipped weights, one thread, two rounds, one run before each."""
    monkeypatch.setattr(bench, "processors", lambda: 1)
    monkeypatch.setattr(bench, "build", new)
    monkeypatch.setattr(bench, "typical_frames", lambda count: [person() for _ in range(count)])
    monkeypatch.setattr(bench, "SENSOR_SIZE", (96, 72))
    monkeypatch.setattr(bench, "SHIPPED", tmp_path / "none.safetensors")
    monkeypatch.setattr(network_times, "MOST_ROUNDS", 2)
    monkeypatch.setattr(network_times, "WARM_S", 0.0)


@pytest.fixture
def run(tmp_path: Path) -> Callable[..., Path]:
    def make(name: str, kind: str = "compact", **facts: Any) -> Path:
        folder = tmp_path / name
        folder.mkdir()
        save_network(folder / "network.safetensors", new(kind), kind, facts)
        return folder

    return make


@pytest.fixture
def scores(tmp_path: Path) -> Callable[..., Path]:
    def make(run: str | None, **changes: Any) -> Path:
        content = {
            "run": run,
            "card": {"network": "compact"},
            "variant": "all",
            "split": "test",
            "noise_mm": None,
            "missing": None,
            "average_per_class_accuracy": 0.87,
        }
        file = tmp_path / "scores.json"
        file.write_text(json.dumps({**content, **changes}))
        return file

    return make


def test_size_time_and_accuracy_of_both_networks(
    run: Callable[..., Path], scores: Callable[..., Path], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    threads = torch.get_num_threads()
    seen: list[tuple[int, int]] = []
    found = bench_network(
        2, (run("all-0"),), (scores("all-0"),), progress=lambda done, total: seen.append((done, total))
    )
    assert list(found["networks"]) == ["fcn_alexnet", "compact"]
    assert "segformer is left out: segformer needs another package" in capsys.readouterr().err
    cells = 2 * 2 * 2 + 4
    assert len(found["times"]) == len(seen) == cells and seen[-1] == (cells, cells)
    for name, network in found["networks"].items():
        assert network["parameters"] == parameters(new(name))
        assert network["gpu_ms"] is None and network["cpu_ms"] > 0 and network["giga_operations"] > 0
        (row,) = (
            row
            for row in found["times"]
            if (row["frame"], row["task"], row["threads"], row["precision"]) == ("filled", "scores", 1, "float32")
        )
        assert row["networks"][name]["ms"] == network["cpu_ms"]
        assert row["networks"][name]["frames_per_second"] == pytest.approx(1000 / network["cpu_ms"], rel=0.01)
    assert found["networks"]["compact"]["accuracy_all"] == 0.87 and found["networks"]["compact"]["weights"] == "all-0"
    assert found["networks"]["fcn_alexnet"]["accuracy_all"] is found["networks"]["fcn_alexnet"]["weights"] is None
    assert found["frames"]["typical"] == {"rows": 64, "columns": 48, "count": 2, "median_body": [48, 28]}
    assert found["frames"]["sensor"] == {"rows": 96, "columns": 72, "count": 1}
    assert torch.get_num_threads() == threads
    assert json.loads(json.dumps(found)) == found
    draw_network(found, tmp_path / "network.png")
    picture = part(decoded(tmp_path / "network.png"), down=(0, 0.82))  # without the legend
    colours = dict(
        zip([found["reference"], *(n for n in found["networks"] if n != found["reference"])], _MARKS, strict=False)
    )
    places = {name: [mark.middle[0] for mark in marks(picture, colour, 12)] for name, (colour, _) in colours.items()}
    assert all(len(each) >= len(found["times"]) // 2 for each in places.values()), "a mark in every row"
    by_time = sorted(places, key=lambda name: np.mean([np.log(row["networks"][name]["ms"]) for row in found["times"]]))
    assert sorted(places, key=lambda name: np.mean(places[name])) == by_time, "slower ones stand to the right"


def test_operations_are_counted_as_by_hand() -> None:
    network = nn.Conv2d(1, 7, 3, padding=1, bias=False)
    assert operations(network, np.ones((1000, 100), np.float32)) == round(2 * 9 * 7 * 1e5 / 1e9, 6)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"variant": "md"}, "must be what bodyseg evaluate found on the test images of all, found {'variant': 'md'"),
        ({"noise_mm": 40.0}, "'noise_mm': 40.0"),
        ({"split": "train"}, "'split': 'train'"),
        ({"card": None}, "must be what bodyseg evaluate found"),
        ({"run": "md-1"}, "has the scores of md-1, which is not among the networks measured"),
    ],
)
def test_scores_of_something_else_are_refused(
    changes: dict[str, Any], message: str, run: Callable[..., Path], scores: Callable[..., Path]
) -> None:
    with pytest.raises(BadConfig, match=message):
        bench_network(1, (run("all-0"),), (scores(**{"run": "all-0", **changes}),))


def test_medians_quartiles_and_the_quotient_of_neighbours() -> None:
    found = summary({"slow": [20.0, 30.0, 400.0], "quick": [10.0, 10.0, 100.0]}, "quick")
    assert found["slow"] == {"ms": 30.0, "quartiles": [25.0, 215.0], "rounds": 3, "times_as_long": 3.0}
    assert found["quick"] == {"ms": 10.0, "quartiles": [10.0, 55.0], "rounds": 3, "times_as_long": 1.0}
