"""`bodyseg train` with images held out: what it logs, and that a killed one resumes."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from small_training import TINY, log, written

from bodyseg_model.commands.cli import main

VALIDATED = ["--val-share", "0.5", "--val-every", "2", "--val-images", "3"]


def command(data: Path, out: Path, *more: str) -> list[str]:
    words = ["train", "--data", str(data), "--out", str(out), "--batch-size", "2"]
    if "--settings" not in more:
        words += ["--settings", json.dumps(TINY)]
    return [*words, "--num-workers", "0", "--log-every", "1", "--threads", "1", "--device", "cpu", *more]


def test_a_killed_training_carries_on(small_set: Path, tmp_path: Path) -> None:
    """With images held out and averages, so that all that a training may keep is kept, and a worker that loads."""
    more = [*VALIDATED, "--ema", "0.9", "--patience", "9", "--steps", "6", "--checkpoint-every", "1"]
    more += ["--num-workers", "1"]
    assert main(command(small_set, tmp_path / "whole", *more)) == 0
    process = subprocess.Popen(
        [sys.executable, "-m", "bodyseg_model", *command(small_set, tmp_path / "cut", *more)], stderr=subprocess.PIPE
    )
    deadline = time.monotonic() + 100
    while not (tmp_path / "cut" / "best.json").exists() and time.monotonic() < deadline:
        time.sleep(0.005)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert main(command(small_set, tmp_path / "cut", *more, "--resume")) == 0
    whole, cut = written(tmp_path / "whole"), written(tmp_path / "cut")
    assert whole.keys() == cut.keys() == {"best.json", "best.safetensors", "network.json", "network.safetensors"}
    for name in ("best.safetensors", "network.safetensors"):
        assert whole[name] == cut[name]


def test_scores_reach_the_log_the_progress_line_and_tensorboard(
    small_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    assert main(command(small_set, tmp_path, *VALIDATED, "--steps", "3")) == 0
    lines = log(tmp_path)
    assert ["val_accuracy" in line for line in lines] == [False, True, True]
    shown = f"validation per class {lines[2]['val_accuracy']:.1%} (best in step {lines[2]['val_best_step']})"
    said = capsys.readouterr().err
    assert shown in said
    best = max(lines[1:], key=lambda line: float(line["val_accuracy"]))
    assert said.endswith(
        f"ended after step 3; the network has the weights of step {best['step']}: "
        f"validation per class {best['val_accuracy']:.1%}\n"
    )
    events = EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    for name in ("val_accuracy", "val_pixel_accuracy"):
        found = [(event.step, event.value) for event in events.Scalars(name)]
        assert found == [(line["step"], pytest.approx(line[name])) for line in lines[1:]]
    plan = json.loads((tmp_path / "run.json").read_text())
    assert plan["data"]["val_share"] == plan["validation"]["data"][0]["val_share"] == 0.5
    assert (plan["data"]["split"], plan["validation"]["data"][0]["split"]) == ("train", "val")
    assert plan["sensor"]["artifacts"] == plan["data"]["artifacts"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--val-every", "5"], "--val-every is for a training with images to validate on: give --val-share, like 0.1"),
        (["--val-images", "5"], "--val-images is for a training with images to validate on"),
        (["--patience", "5"], "--patience is for a training with images to validate on"),
        (["--keep", "best"], "--keep is for a training with images to validate on"),
        (["--val-share", "0.5", "--val-every", "0"], "val_every must be a whole number of at least 1, found 0"),
        (["--ema", "1"], "ema must be from 0 to 0.999999, found 1.0"),
    ],
)
def test_bad_options_get_one_line(
    small_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], message: str
) -> None:
    assert main(command(small_set, tmp_path / "run", *words)) == 2
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1
    assert not (tmp_path / "run").exists()
