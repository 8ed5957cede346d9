"""`bench training` on a small set."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import warm
from benches.model import training_speed
from benches.model.training_speed import Way, bench_training, summary
from small_training import TINY

from bodyseg_data.core import BadConfig


def _run_warm(command: list[str], env: dict[str, str], **_: Any) -> subprocess.CompletedProcess[str]:
    assert command[:3] == [sys.executable, "-m", "bodyseg_model"]
    return warm.run(["-c", "from bodyseg_model.commands import main; raise SystemExit(main())", *command[3:]], env=env)


def test_every_way_is_timed_by_the_command(small_set: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(training_speed, "ROUNDS", 1)
    monkeypatch.setattr(training_speed, "_BATCH", 2)
    monkeypatch.setattr(training_speed, "ways", lambda cores: {"default": Way(1, 1)})
    command, tiny = Way.command, ["--settings", json.dumps(TINY), "--precision", "float32"]
    monkeypatch.setattr(Way, "command", lambda *arguments: [*command(*arguments), *tiny])
    monkeypatch.setattr(training_speed.subprocess, "run", _run_warm)
    done: list[tuple[int, int]] = []
    found = bench_training(str(small_set), 4, lambda *numbers: done.append(numbers))
    assert done == [(1, 1)]
    (way,) = found["ways"].values()
    assert (way["processes"], way["threads"]) == (1, 1)
    assert way["images_per_second"] > 0 and 0 <= way["data_wait"] < 1


def test_several_processes_are_torchruns(tmp_path: Path) -> None:
    """Which tests/training/test_torchrun.py starts."""
    alone, several = (Way(count, 1).command("shards", 8, tmp_path) for count in (1, 2))
    assert several[:4] == ["-m", "torch.distributed.run", "--nproc-per-node=2", "-m"]
    assert alone[0] == "-m" and several[4] == alone[1] == "bodyseg_model"
    sizes = [words[words.index("--batch-size") + 1] for words in (alone, several)]
    assert sizes == ["16", "32"], "each process has as many images"


def test_ways_are_compared_by_their_medians() -> None:
    named = {"default": Way(1, 2), "one thread": Way(1, 1)}
    runs = {
        "default": [{"images_per_second": rate, "data_wait": 0.1} for rate in (50.0, 80.0, 60.0)],
        "one thread": [{"images_per_second": rate, "data_wait": 0.0} for rate in (45.0, 10.0, 46.0)],
    }
    found = summary(named, runs)["ways"]
    assert found["default"]["images_per_second"] == 60 and found["default"]["times_as_fast"] == 1
    assert found["one thread"]["images_per_second"] == 45 and found["one thread"]["times_as_fast"] == 0.75
    assert found["one thread"]["all"] == [45, 10, 46]


def test_what_a_training_says_is_passed_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    saying = ["-c", "import sys; sys.exit('starting\\nno shards in nowhere')"]
    monkeypatch.setattr(Way, "command", lambda way, data, steps, out: saying)  # a training takes seconds to say it
    with pytest.raises(BadConfig, match=r"^a training failed: no shards in nowhere$"):
        bench_training(str(tmp_path / "nowhere"), 4)
