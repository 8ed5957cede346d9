from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from benches.__main__ import main
from benches.model.networks import network as bench
from benches.model.networks import network_times
from benches.model.networks.network import bench_network
from benches.model.networks.network_figure import draw_network
from benches.model.networks.network_frames import stretched, typical_frames
from benches.model.networks.network_times import LEAST_ROUNDS, Cell, operations, summary, time_cell
from fakes import Figures
from PIL import Image
from torch import nn

from bodyseg_data.core.errors import BadConfig, MissingLibrary
from bodyseg_data.packing import pack as packing
from bodyseg_model.networks.checkpoints import save_network
from bodyseg_model.networks.network import Network
from bodyseg_model.networks.registry import build, parameters

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
    """Small networks and images, no shipped weights, one thread, five rounds."""
    monkeypatch.setattr(bench, "processors", lambda: 1)
    monkeypatch.setattr(bench, "build", new)
    monkeypatch.setattr(bench, "typical_frames", lambda count: [person() for _ in range(count)])
    monkeypatch.setattr(bench, "SENSOR_SIZE", (96, 72))
    monkeypatch.setattr(bench, "SHIPPED", tmp_path / "none.safetensors")
    monkeypatch.setattr(bench, "MOST_ROUNDS", LEAST_ROUNDS)


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
    run: Callable[..., Path], scores: Callable[..., Path], capsys: pytest.CaptureFixture[str]
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


def test_operations_are_counted_as_by_hand() -> None:
    network = nn.Conv2d(1, 7, 3, padding=1, bias=False)
    assert operations(network, np.ones((1000, 100), np.float32)) == round(2 * 9 * 7 * 1e5 / 1e9, 6)


def test_further_runs_have_their_folders_names(run: Callable[..., Path], scores: Callable[..., Path]) -> None:
    paths = run("all-0"), run("md-0"), run("paper", "fcn_alexnet")
    found = bench._contestants(paths)
    assert {name: (one.kind, one.run) for name, one in found.items()} == {
        "fcn_alexnet": ("fcn_alexnet", "paper"),
        "compact": ("compact", "all-0"),
        "md-0": ("compact", "md-0"),
    }
    assert bench._accuracies((scores("md-0"),), found) == {"md-0": 0.87}
    with pytest.raises(BadConfig, match="called after their folders, found a second 'md-0'"):
        bench._contestants((*paths, paths[1]))


def test_shipped_weights_stand_in_for_a_run(
    run: Callable[..., Path], scores: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    shipped = run("weights") / "network.safetensors"
    monkeypatch.setattr(bench, "SHIPPED", shipped)
    alone, beside = bench._contestants(()), bench._contestants((run("all-0"),))
    assert {name: one.run for name, one in alone.items()} == {"fcn_alexnet": None, "compact": "network.safetensors"}
    assert {name: one.run for name, one in beside.items()} == {"fcn_alexnet": None, "compact": "all-0"}
    assert bench._accuracies((scores(None),), alone) == {"compact": 0.87}


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


class Noted(Network):
    """Writes down when it is asked, about what, and how."""

    def __init__(self, name: str, notes: list[Any]) -> None:
        super().__init__()
        self.name, self.notes = name, notes

    def scores(self, range_m: torch.Tensor) -> torch.Tensor:
        self.notes.append((self.name, float(range_m.max()), torch.get_num_threads(), torch.is_autocast_enabled("cpu")))
        return torch.zeros(len(range_m), 33, *range_m.shape[2:])


def test_networks_take_turns_on_the_same_image() -> None:
    notes: list[Any] = []
    networks = {name: Noted(name, notes).eval() for name in ("one", "two")}
    batches = [torch.full((1, 1, 4, 4), float(value)) for value in (1, 2, 3)]
    found = time_cell(Cell("typical", "labels", "cpu", 2, "bfloat16"), networks, batches, 4, 60.0)
    asked = ["one", "two", "one", "two", "two", "one", "one", "two", "two", "one"]  # the first two are untimed
    assert notes == [(name, value, 2, True) for name, value in zip(asked, [1, 1, 1, 1, 2, 2, 3, 3, 1, 1], strict=True)]
    assert {name: len(values) for name, values in found.items()} == {"one": 4, "two": 4}
    notes.clear()
    time_cell(Cell("typical", "scores", "cpu", 1, "float32"), networks, batches, 1, 60.0)
    assert notes[0] == ("one", 1, 1, False)


def test_slow_networks_get_fewer_rounds() -> None:
    networks = {"one": Noted("one", [])}
    cell = Cell("typical", "scores", "cpu", 1, "float32")
    found = time_cell(cell, networks, [torch.ones(1, 1, 4, 4)], 50, 0.0)
    assert len(found["one"]) == LEAST_ROUNDS


def test_medians_quartiles_and_the_quotient_of_neighbours() -> None:
    found = summary({"slow": [20.0, 30.0, 400.0], "quick": [10.0, 10.0, 100.0]}, "quick")
    assert found["slow"] == {"ms": 30.0, "quartiles": [25.0, 215.0], "rounds": 3, "times_as_long": 3.0}
    assert found["quick"] == {"ms": 10.0, "quartiles": [10.0, 55.0], "rounds": 3, "times_as_long": 1.0}


def test_a_gpu_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    order: list[str] = []
    monkeypatch.setattr(torch.cuda, "synchronize", lambda device: order.append("waited"))
    network_times._milliseconds(lambda: order.append("asked"), torch.device("cuda"))
    assert order == ["waited", "asked", "waited"]


def test_all_processors_and_a_gpu_are_measured_where_there_are(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "processors", lambda: 6)
    plain = bench._cells()
    assert {(cell.frame, cell.threads) for cell in plain} == {
        ("filled", 1), ("filled", 6), ("typical", 1), ("typical", 6), ("sensor", 6),
    }  # fmt: skip
    assert {cell.device for cell in plain} == {"cpu"}
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    cells = bench._cells()
    assert cells[: len(plain)] == plain
    assert {(cell.frame, cell.together) for cell in cells[len(plain) :]} == {
        ("filled", 1), ("filled", 16), ("typical", 1), ("typical", 16), ("sensor", 1),
    }  # fmt: skip


def test_a_stretched_body_fills_its_image() -> None:
    frame = person()
    body = frame[8:56, 12:40]
    assert np.array_equal(stretched(frame, 96, 56), body.repeat(2, 0).repeat(2, 1))
    odd = stretched(frame, 101, 33)
    assert odd.shape == (101, 33) and odd[0].any() and odd[-1].any() and odd[:, 0].any() and odd[:, -1].any()


def test_typical_frames_are_bodies_with_all_artifacts(monkeypatch: pytest.MonkeyPatch) -> None:
    packing._source.cache_clear()
    monkeypatch.setattr(packing, "open_source", lambda *where: Figures())
    try:
        frames = typical_frames(2)
    finally:
        packing._source.cache_clear()
    assert [(frame.shape, frame.dtype) for frame in frames] == [((640, 329), np.float32)] * 2
    assert all(1000 < (frame > 0).sum() < frame.size / 2 for frame in frames)
    assert all(1.0 < np.median(frame[frame > 0]) < 4.0 for frame in frames)
    assert not np.array_equal(*frames)
    with pytest.raises(BadConfig, match="the number of typical frames must be a whole number of at least 1, found 0"):
        typical_frames(0)


def test_the_command_measures_and_draws(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("matplotlib")
    cells = [cell for cell in bench._cells() if cell.precision == "float32"]
    monkeypatch.setattr(bench, "_cells", lambda: cells)
    out, drawn = tmp_path / "network.json", tmp_path / "network.png"
    assert main(["bench", "network", "--views", "2", "--json", str(out), "--figure", str(drawn)]) == 0
    figures = json.loads(out.read_text())
    assert figures["command"].startswith("tools/bench network --views 2 --json ")
    assert {"parameters", "cpu_ms", "gpu_ms", "accuracy_all"} <= set(figures["networks"]["fcn_alexnet"])
    with Image.open(drawn) as picture:
        assert min(picture.size) > 400
    with pytest.raises(BadConfig, match="cannot write"):
        draw_network(figures, tmp_path / "nowhere" / "x.png")
