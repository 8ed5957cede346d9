"""Two processes as torchrun starts them: what their loaders give them, and trainings that they do together."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch
from servers import free_port
from small_training import log
from warm import run_on_two_ranks

from bodyseg_data import RangeImages, loader
from bodyseg_model.commands import main
from bodyseg_model.networks import load_network

_SMALL = ["--network", "fcn_alexnet", "--settings", '{"width": 0.0625}', "--batch-size", "2", "--num-workers", "0"]


def _train(data: Path, out: Path, *more: str) -> list[str]:
    return ["train", "--data", str(data), "--out", str(out), *_SMALL, "--device", "cpu", *more]


def _together(data: Path, out: Path) -> list[str]:
    return _train(data, out, "--steps", "2", "--accumulate", "2", "--seed", "4")


def _ending(data: Path, out: Path) -> list[str]:
    more = ["--val-share", "0.5", "--val-images", "2", "--val-every", "1", "--log-every", "1"]
    return _train(data, out, *more, "--lr", "1e-9", "--ema", "0.5", "--accumulate", "1", "--steps", "3")


@dataclass(frozen=True)
class Ran:
    """What two processes left in a folder, and said on standard error."""

    folder: Path
    said: str


@pytest.fixture(scope="module")
def ran(small_set: Path, tmp_path_factory: pytest.TempPathFactory) -> Ran:
    folder = tmp_path_factory.mktemp("torchrun")
    trainings = _together(small_set, folder / "together"), _ending(small_set, folder / "ending")
    jobs = json.dumps([(free_port(), training) for training in trainings])
    errors = run_on_two_ranks("torchrun_worker.py", str(folder), str(small_set), "2", jobs)
    return Ran(folder, errors)


def test_loaders_share_batches_and_go_on_with_one_and_three(small_set: Path, ran: Ran) -> None:
    images = RangeImages(small_set, "all")
    expected = [batch["key"] for batch in loader(images, 6, shuffle=True)]
    ranks = [json.loads((ran.folder / f"{rank}-of-2.json").read_text()) for rank in range(2)]
    assert ranks[0]["state"] == ranks[1]["state"]
    assert _put_together([rank["keys"] for rank in ranks]) == expected[:2]
    for count in (1, 3):
        shares = []
        for rank in range(count):
            order = loader(images, 12 // count // 2, shuffle=True, rank=rank, world_size=count)
            order.load_state_dict(ranks[0]["state"])
            shares.append([batch["key"] for batch in order])
        assert _put_together(shares) == expected[2:]


def _put_together(batches: list[list[list[str]]]) -> list[list[str]]:
    """The global batches that the ranks' batches make up."""
    return [[key for batch in side_by_side for key in batch] for side_by_side in zip(*batches, strict=True)]


def test_processes_together_learn_as_one(
    small_set: Path, tmp_path: Path, ran: Ran, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two processes with half of each batch give the weights of one with all of it, but for rounding."""
    monkeypatch.setattr(torch.nn.Dropout, "forward", lambda self, x: x)  # as in the worker
    assert main(_together(small_set, tmp_path / "one")) == 0
    one, two = (load_network(folder).network.state_dict() for folder in (tmp_path / "one", ran.folder / "together"))
    for name, weight in one.items():
        torch.testing.assert_close(two[name], weight, atol=2e-5, rtol=1e-3)


def test_processes_end_together(ran: Ran) -> None:
    """With a learning rate near 0, and without statistics of batches, no validation is better than the first."""
    assert "the network has the weights of step 1 of 3: validation per class" in ran.said
    assert [line["val_best_step"] for line in log(ran.folder / "ending")] == [1, 1, 1]
    card = load_network(ran.folder / "ending").card
    assert (card["step"], card["last_step"]) == (1, 3)
