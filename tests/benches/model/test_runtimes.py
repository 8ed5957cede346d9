"""`bench runtimes` on plain figures and with a tiny network."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from benches.model.networks import network_times
from benches.model.networks import runtimes as bench
from benches.model.networks.runtimes import PAPERS, REFERENCE, bench_runtimes
from benches.model.networks.runtimes_figure import _COLOURS, draw_runtimes
from pictures import decoded, marks

from bodyseg_model.networks import build, save_network


def test_every_backend_is_timed_and_scored(small_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for package in ("onnx", "onnxruntime", "openvino"):
        pytest.importorskip(package)
    frame = np.zeros((64, 48), np.float32)
    frame[10:60, 10:40] = np.linspace(2, 3, 30, dtype=np.float32)
    monkeypatch.setattr(bench, "typical_frames", lambda views: [frame] * views)
    monkeypatch.setattr(bench, "ROUNDS", 1)
    monkeypatch.setattr(bench, "processors", lambda: 1)
    monkeypatch.setattr(bench, "example_set", lambda: str(small_set))  # to calibrate 8 bits on
    monkeypatch.setattr(network_times, "WARM_S", 0.0)
    monkeypatch.setattr(bench, "build", lambda name, seed: build(name, {"width": 1 / 16}, seed))
    save_network(tmp_path / "network.safetensors", build("compact", {"widths": [8], "blocks": [1]}, 0), "compact", {})
    done: list[tuple[int, int]] = []
    found = bench_runtimes(str(small_set), 2, 3, (tmp_path,), lambda *numbers: done.append(numbers))
    assert done[-1][0] == done[-1][1] == len(done)
    assert found["networks"].keys() | {PAPERS} == found["times"][0]["networks"].keys() and len(found["networks"]) == 7
    assert found["networks"][REFERENCE]["labels_that_differ"] == 0
    assert found["networks"]["onnxruntime float32"]["labels_that_differ"] < 0.001
    assert 0 < found["networks"]["onnxruntime int8"]["labels_that_differ"] < 0.1
    assert found["test_images"] == 3
    for row in found["times"]:
        assert all(each["ms"] > 0 for each in row["networks"].values())
    draw_runtimes(found, tmp_path / "runtimes.png")
    picture = decoded(tmp_path / "runtimes.png")
    row = [row for row in found["times"] if row["frame"] == "filled"][-1]
    slowest = max(found["networks"], key=lambda name: row["networks"][name]["ms"])
    points = {name: marks(picture, colour, 25) for name, colour in _COLOURS.items()}
    assert all(points[name.split(" ")[1]] for name in found["networks"])
    rightmost = max((mark.right, name) for name, several in points.items() for mark in several)[1]
    assert rightmost == slowest.split(" ")[1]
