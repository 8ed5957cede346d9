"""Networks of trainings that have not ended: their last checkpoint, and the weights of their best validation."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from small_rig import SMALL
from small_training import CutError, GivenScores, cut_at, train

from bodyseg_data import RangeImages
from bodyseg_data.core import BadConfig
from bodyseg_data.rigs import rig_from_json
from bodyseg_model.commands import main
from bodyseg_model.networks import checkpoints, load_network, read_checkpoint
from bodyseg_model.training import RunOptions


@pytest.fixture(scope="module")
def unfinished(small_set: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A training of four steps that ended after its third checkpoint; the best validation was that of step 1."""
    out = tmp_path_factory.mktemp("runs") / "unfinished"
    validation = GivenScores([RangeImages(small_set, "all", "test")], 1, accuracies=(0.5, 0.4, 0.3, 0.2))
    with pytest.raises(CutError):
        train(small_set, out, ema=0.9, validation=validation, report=cut_at(4))
    return out


def test_a_training_that_has_not_ended_gives_its_last_checkpoint(unfinished: Path) -> None:
    stored = load_file(unfinished / "checkpoint-00000003.safetensors")
    trained = load_network(unfinished)
    assert (trained.card["step"], trained.card["recipe"]["steps"]) == (3, 4)
    assert rig_from_json(trained.card["rig"]) == SMALL
    assert not trained.network.training
    for name, weight in trained.network.state_dict().items():
        assert torch.equal(weight, stored[f"average.{name}"])
    best = load_network(unfinished / "best.safetensors")
    assert best.card["step"] == 1
    assert best.card["sensor"]["name"] == "paper"


def test_the_end_comes_before_the_last_checkpoint_until_the_training_goes_on(small_set: Path, tmp_path: Path) -> None:
    train(small_set, tmp_path, steps=2)
    assert load_network(tmp_path).card["commit"] == "none"
    with pytest.raises(CutError):
        train(small_set, tmp_path, steps=5, report=cut_at(4), resume=True)
    assert load_network(tmp_path).card["step"] == 3


def test_a_checkpoint_that_is_replaced_while_it_is_read_is_read_again(
    small_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = RunOptions(1, 1, 0)
    with pytest.raises(CutError):
        train(small_set, tmp_path, report=cut_at(3), options=options)
    read, waiting = checkpoints.read_bytes, [True]

    def slow_read(path: Path) -> bytes:
        if path.suffix == ".safetensors" and waiting.pop():
            with monkeypatch.context() as patch, pytest.raises(CutError):
                patch.setattr(checkpoints, "read_bytes", read)
                train(small_set, tmp_path, resume=True, report=cut_at(4), options=options)
            waiting.append(False)
        return read(path)

    monkeypatch.setattr(checkpoints, "read_bytes", slow_read)
    assert load_network(tmp_path).card["step"] == 3


def test_a_run_that_names_no_network_is_refused(small_set: Path, tmp_path: Path) -> None:
    (tmp_path / "run.json").write_text("{}")
    with pytest.raises(BadConfig, match="has no checkpoint yet$"):
        load_network(tmp_path)
    (tmp_path / "run.json").unlink()
    train(small_set, tmp_path, steps=1)
    (tmp_path / "run.json").write_text("{}")
    (tmp_path / "network.json").unlink()
    with pytest.raises(BadConfig, match=r"run.json must name the network and its settings"):
        load_network(tmp_path)
    (file,) = tmp_path.glob("checkpoint-*.safetensors")
    file.unlink()
    with pytest.raises(BadConfig, match="cannot read .*checkpoint-00000001.safetensors"):
        read_checkpoint(tmp_path)


@pytest.mark.parametrize(("file", "step"), [(".", 3), ("best.safetensors", 1)])
def test_evaluate_says_which_step_it_scores(
    unfinished: Path, small_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], file: str, step: int
) -> None:
    words = ["--run", str(unfinished / file), "--data", str(small_set), "--json", str(tmp_path / "scores.json")]
    assert main(["evaluate", *words, "--images", "2", "--num-workers", "0", "--frames", "0"]) == 0
    assert f"the network's weights are those after step {step} of 4\n" in capsys.readouterr().err
    assert json.loads((tmp_path / "scores.json").read_text())["card"]["step"] == step
