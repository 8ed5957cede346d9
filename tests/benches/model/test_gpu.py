"""`bench gpu` on the processor with tiny networks, and what it says without a GPU."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from benches.__main__ import main
from benches.model import gpu
from benches.model.gpu import COMPACT, FILLED, SENSOR, measured, real_time
from benches.model.networks import network_times

from bodyseg_data import RangeImages
from bodyseg_model.networks import build


def frame(rows: int, columns: int) -> np.ndarray:
    return np.linspace(2, 3, rows * columns, dtype=np.float32).reshape(rows, columns)


def test_all_is_measured_on_any_device(small_set: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gpu, "MOST_ROUNDS", 2)
    monkeypatch.setattr(network_times, "MOST_ROUNDS", 2)
    monkeypatch.setattr(gpu, "ROUNDS", 1)
    monkeypatch.setattr(network_times, "WARM_S", 0.0)
    networks = {COMPACT: build(COMPACT, {"patch": 16, "widths": [8], "blocks": [1]}, 0).eval()}
    frames = {FILLED: frame(64, 48), SENSOR: frame(96, 64)}
    done: list[tuple[int, int]] = []
    images = RangeImages(small_set, "all", "train")
    found = measured(images, networks, frames, "cpu", 30, (0, 2), 4, lambda *numbers: done.append(numbers))
    assert [number for number, _ in done] == [*range(1, done[-1][1] + 1)]
    ways = [(row["workers"], row["method"], row["ranges"]) for row in found["loading"]]
    assert ways == [
        *((0, None, ranges) for ranges in ("metres", "steps")),
        *((2, method, ranges) for method in ("thread", "process") for ranges in ("metres", "steps")),
    ]
    assert all(row["samples_per_second"] > 0 for row in found["loading"])
    assert {(row["frame"], row["together"]) for row in found["times"]} == {(FILLED, 1), (FILLED, 16), (SENSOR, 1)}
    for row in found["times"]:
        (shown,) = row["networks"].values()
        assert shown["times_as_long"] == 1
        assert shown["frames_per_second"] == pytest.approx(1e3 * row["together"] / shown["ms"], abs=0.01)
    for by_precision in found["full_resolution"].values():
        for facts in by_precision.values():
            assert 0 < facts["ms"] <= facts["p95_ms"] and facts["holds_30"] == (facts["p95_ms"] <= 1e3 / 30)
    assert [(row["network"], row["workers"]) for row in found["training"]] == [(COMPACT, 0), (COMPACT, 2)]
    for row in found["training"]:
        assert row["images_per_second"] > 0 and 0 <= row["data_wait"] < 1
        assert row["batch_size"] == 16
    json.dumps(found)


def test_what_is_slower_than_the_sensor_does_not_hold(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gpu, "MOST_ROUNDS", 5)
    clock = iter(np.arange(100) * 0.04)  # each frame takes 40 ms
    monkeypatch.setattr(gpu.time, "perf_counter", lambda: float(next(clock)))
    network = build(COMPACT, {"patch": 16, "widths": [8], "blocks": [1]}, 0).eval()
    facts = real_time(network, frame(32, 32), torch.device("cpu"), "float32")
    assert facts == {"ms": 40.0, "p95_ms": 40.0, "frames_per_second": 25.0, "holds_30": False}


def test_without_a_gpu_it_is_one_line(
    small_set: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert main(["bench", "gpu", "--data", str(small_set)]) == 2
    assert "bench gpu needs a GPU that PyTorch can use, found none: nothing was measured" in capsys.readouterr().err
