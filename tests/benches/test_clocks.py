"""What benches time and what they do not: a clock that only work moves makes what the first batches cost visible."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from benches import measuring
from benches.data.loader import passes
from benches.data.render import bench as render
from benches.data.workers import subject
from benches.model import gpu, training_speed
from benches.model.ablation import costs
from benches.model.networks import network_times, runtimes
from benches.model.segment import live
from torch import nn

COLD_S, WARM_S = 100.0, 1.0


class Clock:
    """Stands for the module `time`: it stands still but where work moves it."""

    def __init__(self) -> None:
        self.now = 1000.0

    def perf_counter(self) -> float:
        return self.now

    process_time = perf_counter

    def spend(self, seconds: float) -> None:
        self.now += seconds


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    for module in (measuring, passes, render, subject, gpu, costs, network_times, runtimes, live):
        monkeypatch.setattr(module, "time", clock, raising=False)
    return clock


class Batches:
    """Batches of two samples, of which a pass's first `slow` take long; counts its passes."""

    def __init__(self, clock: Clock, slow: int, count: int = 9) -> None:
        self.clock, self.slow, self.count, self.begun = clock, slow, count, 0

    def __iter__(self) -> Iterator[dict[str, Any]]:
        self.begun += 1
        for number in range(self.count):
            self.clock.spend(COLD_S if number < self.slow else WARM_S)
            keys = [f"{number}-{one}" for one in range(2)]
            yield {"key": keys, "range": torch.zeros(2, 1, 4, 3), "labels": torch.zeros(2, 4, 3, dtype=torch.uint8)}


@pytest.mark.parametrize("workers", [0, 1, 2, 3])
def test_the_clock_starts_when_each_worker_has_delivered_a_batch(
    workers: int, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    batches = Batches(clock, slow=max(workers, 1))
    found = passes.Passes()
    passes._run(passes._Open(batches, []), workers, found)
    assert found.rates == [2 / WARM_S] and found.samples == 18
    timed = subject._timed_pass(batches, workers)  # type: ignore[arg-type]
    assert timed.samples == 18 - 2 * max(workers, 1) and timed.seconds == timed.samples / 2 * WARM_S
    assert subject._first_pass(batches)[0] == 1e3 * COLD_S  # type: ignore[arg-type]

    monkeypatch.setattr(gpu, "loader", lambda *_, **__: batches)
    images: Any = SimpleNamespace(step_m=0.001)
    assert gpu.loading_rate(images, torch.device("cpu"), workers, "thread", True, 10) == 2 / WARM_S


def test_every_loader_makes_a_pass_that_is_not_timed_before_the_first_that_is(clock: Clock) -> None:
    loaders = {name: Batches(clock, slow=2) for name in ("a", "b")}
    expected = {
        f"{number}-{one}": passes.checksum(np.zeros((1, 4, 3), np.float32), np.zeros((4, 3), np.uint8))
        for number in range(9)
        for one in range(2)
    }
    begun: list[list[int]] = []
    found = passes.run_rounds(
        {name: lambda made=made: made for name, made in loaders.items()},  # type: ignore[misc]
        2,
        3,
        dict.fromkeys(loaders, expected),
        lambda: begun.append([made.begun for made in loaders.values()]),
    )
    assert begun[1] == [1, 1] and begun[-1] == [4, 4]
    for one in found.values():
        assert one.rates == [2 / WARM_S] * 3 and one.samples == 3 * 18


class Cached:
    """Work that is slow where other work came before it, as the caches of a processor make it."""

    last: object = None

    def __init__(self, clock: Clock) -> None:
        self.clock = clock

    def __call__(self, who: object) -> None:
        self.clock.spend(WARM_S if Cached.last is who else COLD_S)
        Cached.last = who


def test_networks_run_untimed_after_another_one(clock: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    work = Cached(clock)

    class Net(nn.Module):
        def forward(self, x: torch.Tensor) -> torch.Tensor:
            work(self)
            return x

    networks: Any = {name: Net() for name in ("a", "b", runtimes.REFERENCE)}
    cell = network_times.Cell("typical", "scores", "cpu", 1, "float32")
    found = network_times.time_cell(cell, networks, [torch.zeros(1, 1, 2, 2)], 6, 1e9)
    assert found == dict.fromkeys(networks, [1e3 * WARM_S] * 6)

    monkeypatch.setattr(runtimes, "predict", lambda network, image: network(image))
    rows = runtimes._timed(networks, [torch.zeros(1)], 1)
    assert {row["ms"] for row in rows.values()} == {1e3 * WARM_S}


def test_first_rounds_and_first_frames_are_left_out(clock: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = iter(range(100))

    def job() -> None:
        clock.spend(COLD_S if next(calls) < 1 else WARM_S)

    assert costs.processor_ms({"a": job}, 2, 3) == {"a": {"ms": 500.0}}

    frames = iter(range(100))

    def predict(network: Any, range_m: torch.Tensor) -> Any:
        clock.spend(COLD_S if next(frames) < 2 else WARM_S)
        return SimpleNamespace(labels=range_m)

    monkeypatch.setattr(gpu, "predict", predict)
    found = gpu.real_time(nn.Identity(), np.zeros((2, 2), np.float32), torch.device("cpu"), "float32")  # type: ignore[arg-type]
    assert found["ms"] == found["p95_ms"] == 1e3 * WARM_S and not found["holds_30"]


@pytest.mark.parametrize("rates", [[1.0, 50.0, 60.0, 70.0]])
def test_the_first_window_of_a_training_warms_up(
    rates: Sequence[float], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lines = [SimpleNamespace(images_per_second=rate, data_wait=rate / 100) for rate in rates]

    def run(*_: Any, **__: Any) -> Any:
        (tmp_path / "log.jsonl").write_text("\n".join(json.dumps(vars(line)) for line in lines))
        return subprocess.CompletedProcess([], 0)

    class Training:
        def __init__(self, *_: Any) -> None: ...

        def run(self, resume: bool, report: Any, facts: Any) -> None:
            for line in lines:
                report(line)

    monkeypatch.setattr(training_speed.subprocess, "run", run)
    monkeypatch.setattr(gpu, "Training", Training)
    found = training_speed._trained(training_speed.Way(1, 1), "", 4, tmp_path)
    assert found == {"images_per_second": 60.0, "data_wait": 0.6}
    speed = gpu.training_speed(None, None, "compact", torch.device("cpu"), 0, 4)  # type: ignore[arg-type]
    assert (speed["images_per_second"], speed["data_wait"]) == (60.0, 0.6)


def test_packing_is_timed_from_the_second_body_on(
    clock: Clock, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def pack(packing: Any, out: Path, executor: Any, workers: int, watch: Any) -> Any:
        for done in range(1, 13):
            clock.spend(COLD_S if done <= 4 else WARM_S)
            watch(done, 12)
        return SimpleNamespace(samples=lambda: 12, shards=[SimpleNamespace(size=240)])

    monkeypatch.setattr(render, "pack", pack)
    rate, size = render._pack_round(None, [None] * 3, [None] * 4, None, tmp_path)  # type: ignore[arg-type]
    assert (rate, size) == (1 / WARM_S, 20)


def test_the_median_of_several_calls_counts(clock: Clock) -> None:
    seconds = iter([COLD_S, WARM_S, 2 * WARM_S])

    def work() -> float:
        spent = next(seconds)
        clock.spend(spent)
        return spent

    assert measuring.median_time(work, 3) == (2 * WARM_S, 2 * WARM_S)
