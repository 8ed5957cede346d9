"""Validation while training: its scores, the best weights, the early end, and that all of it resumes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from small_training import CutError, GivenScores, cut_at, log, train, written

from bodyseg_data import RangeImages
from bodyseg_data.core import BadConfig
from bodyseg_model.evaluation import evaluate
from bodyseg_model.networks import load_network
from bodyseg_model.training import RunOptions, Validation
from bodyseg_model.training.distributed import ProcessGroup
from bodyseg_model.training.validation import Metrics, MetricsWindow

NAN = float("nan")


@pytest.fixture
def held_out(small_set: Path) -> RangeImages:
    return RangeImages(small_set, "all", "test")


@pytest.mark.parametrize("ema", [0.0, 0.9])
def test_scores_are_those_of_evaluate(small_set: Path, held_out: RangeImages, tmp_path: Path, ema: float) -> None:
    said = train(small_set, tmp_path, validation=Validation([held_out], 2, 5, keep="last"), ema=ema)
    assert [metrics.val_accuracy is not None for metrics in said] == [False, True, False, True]
    scores = evaluate(load_network(tmp_path).network, held_out, 5, confidences=False).total().confusion
    last = log(tmp_path)[-1]
    assert last["val_accuracy"] == said[-1].val_accuracy == round(scores.average_per_class_accuracy(), 5)
    assert last["val_pixel_accuracy"] == round(scores.pixel_accuracy(), 5)
    assert "val_accuracy" not in log(tmp_path)[0]


def test_several_sets_are_scored_together(held_out: RangeImages, small_set: Path, tmp_path: Path) -> None:
    other = RangeImages(small_set, "none", "test", only=("*A-*",))
    train(small_set, tmp_path, steps=1)
    network = load_network(tmp_path).network
    each = [evaluate(network, images, 3, confidences=False).total().confusion.counts for images in (held_out, other)]
    found = Validation([held_out, other], count=3).scores(network)
    assert found.images == 6
    assert (found.confusion.counts == each[0] + each[1]).all()


def test_validating_changes_no_weights(small_set: Path, held_out: RangeImages, tmp_path: Path) -> None:
    train(small_set, tmp_path / "without")
    train(small_set, tmp_path / "with", validation=Validation([held_out], 1, keep="last"))
    name = "network.safetensors"
    assert (tmp_path / "with" / name).read_bytes() == (tmp_path / "without" / name).read_bytes()


@pytest.mark.parametrize("keep", ["best", "last"])
def test_the_best_weights_are_kept(small_set: Path, held_out: RangeImages, tmp_path: Path, keep: Any) -> None:
    """The first of the best ones; equal ones later do not take its place."""
    validation = GivenScores([held_out], 1, keep=keep, accuracies=(0.2, 0.6, NAN, 0.6))
    said = train(small_set, tmp_path / "run", validation=validation)
    assert [metrics.val_best_step for metrics in said] == [1, 2, None, 2]
    best, network = load_network(tmp_path / "run/best.safetensors"), load_network(tmp_path / "run")
    assert (best.card["step"], best.card["val_accuracy"]) == (2, 0.6)
    assert network.card["step"] == (2 if keep == "best" else 4)
    assert network.card["last_step"] == 4
    with pytest.raises(CutError):
        train(small_set, tmp_path / "two", report=cut_at(3))
    after_two = load_network(tmp_path / "two")
    assert after_two.card["step"] == 2
    for name, weight in after_two.network.state_dict().items():
        assert torch.equal(weight, best.network.state_dict()[name])
        assert torch.equal(weight, network.network.state_dict()[name]) or keep == "last"


def test_a_network_that_never_had_a_score_is_the_last(small_set: Path, held_out: RangeImages, tmp_path: Path) -> None:
    said = train(small_set, tmp_path, steps=2, validation=GivenScores([held_out], 1, accuracies=(NAN, NAN)))
    assert [metrics.val_accuracy for metrics in said] == [None, None]
    assert load_network(tmp_path).card["step"] == 2
    assert not (tmp_path / "best.json").exists()


def test_steps_with_a_validation() -> None:
    validation = Validation([object.__new__(RangeImages)], 100)
    assert [step for step in (50, 100, 150, 200, 250) if validation.due(step, 250)] == [100, 200, 250]


@pytest.mark.parametrize("cut", [2, 3])
def test_a_validated_averaged_training_carries_on_with_the_same_bits(
    small_set: Path, held_out: RangeImages, tmp_path: Path, cut: int
) -> None:
    """Cut after a validation's weights are written and before its checkpoint, or between two validations."""
    options = RunOptions(1, 1, 0)

    def go(name: str, **more: Any) -> None:
        validation = Validation([held_out], 2)
        train(small_set, tmp_path / name, ema=0.9, validation=validation, options=options, **more)

    go("whole")
    with pytest.raises(CutError):
        go("cut", report=cut_at(cut))
    assert json.loads((tmp_path / "cut" / "checkpoint.json").read_text())["step"] == cut - 1
    go("cut", resume=True)
    assert written(tmp_path / "cut") == written(tmp_path / "whole")
    measured = {"images_per_second", "data_wait", "waited_for", "peak_mb"}
    logs = [
        [{name: line[name] for name in line.keys() - measured} for line in log(tmp_path / name)]
        for name in ("cut", "whole")
    ]
    assert logs[0] == logs[1]


def test_one_set_stands_for_itself(small_set: Path) -> None:
    held_out: Any = RangeImages(small_set, split="test")
    assert Validation(held_out).images == (held_out,)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"every": 0}, "every must be at least 1, found 0"),
        ({"count": 0}, "count must be at least 1, found 0"),
        ({"keep": "worst"}, "keep must be 'best' or 'last', found 'worst'"),
        ({"images": []}, "a validation needs one or several RangeImages, found []"),
        ({"images": [Path("shards")]}, "a validation needs one or several RangeImages, found [PosixPath('shards')]"),
        ({"images": object()}, "images must be of class Sequence, found "),
    ],
)
def test_bad_validations_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(BadConfig) as caught:
        Validation(**{"images": [object.__new__(RangeImages)], **options})
    assert message in str(caught.value)


def test_a_damaged_card_of_the_best_is_refused(small_set: Path, held_out: RangeImages, tmp_path: Path) -> None:
    def validation() -> GivenScores:
        return GivenScores([held_out], 1, accuracies=(0.2, 0.6))

    train(small_set, tmp_path, steps=1, validation=validation())
    (tmp_path / "best.json").write_text('{"step": 1}')
    with pytest.raises(BadConfig, match="best.json must hold the step and the val_accuracy of a validation"):
        train(small_set, tmp_path, steps=2, validation=validation(), resume=True)


class Twins(ProcessGroup):
    """Two processes that have the same figures."""

    def add_up(self, values: torch.Tensor) -> torch.Tensor:
        return values * self.world_size


@pytest.mark.parametrize("world_size", [1, 2])
def test_metrics_are_of_all_steps_and_processes_since_the_last_line(
    world_size: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = iter([100.0, 101.0, 101.5, 104.0])
    monkeypatch.setattr("time.perf_counter", lambda: next(clock))
    window = MetricsWindow(Twins(0, world_size, torch.device("cpu")), 2)
    with window.watch("data"):
        pass
    window.add(torch.tensor(2.0), torch.tensor([[3, 1], [0, 0]]), 4, torch.tensor(10.0))
    window.add(torch.tensor(1.0), torch.tensor([[0, 0], [1, 0]]), 4, torch.tensor(20.5))
    assert window.metrics(7, 0.25) == Metrics(
        step=7,
        loss=1.5,
        accuracy=0.375,
        pixel_accuracy=0.6,
        learning_rate=0.25,
        images_per_second=2.0 * world_size,
        data_wait=0.125,
        off_mm=15.25,
    )
