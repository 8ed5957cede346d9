"""The folder of a training: what may begin in it, what may go on, and what a refusal names."""

from __future__ import annotations

import dataclasses
import json
import resource
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from small_rig import SMALL
from small_training import RECIPE, TINY, CutError, GivenScores, cut_at, log, train, written

from bodyseg_data import RangeImages
from bodyseg_data.artifacts import Noise, load_sensor_model
from bodyseg_data.core import BadConfig
from bodyseg_data.files import part_beside
from bodyseg_model.networks import load_network
from bodyseg_model.training import RunOptions
from bodyseg_model.training.plan import RunFolder, check_plan

SELDOM = RunOptions(1, 100, 0)


def test_a_try_that_fails_before_its_first_step_leaves_the_folder_usable(small_set: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    with pytest.raises(BadConfig, match="they do not fill one batch of 64"):
        train(small_set, out, batch_size=64)
    assert list(out.iterdir()) == []
    train(small_set, out, batch_size=4, steps=1)
    assert json.loads((out / "run.json").read_text())["recipe"]["batch_size"] == 4


def test_a_folder_with_a_plan_alone_is_begun_anew(small_set: Path, tmp_path: Path) -> None:
    """As a training leaves it that ends after its first step and before its first line of the log."""
    train(small_set, tmp_path / "whole", seed=1)
    train(small_set, tmp_path / "run", steps=1)
    for file in (tmp_path / "run").iterdir():
        if file.name != "run.json":
            file.unlink()
    train(small_set, tmp_path / "run", seed=1)
    assert written(tmp_path / "run") == written(tmp_path / "whole")
    assert json.loads((tmp_path / "run/run.json").read_text()) == json.loads((tmp_path / "whole/run.json").read_text())


def test_a_training_without_a_checkpoint_repeats_its_log(small_set: Path, tmp_path: Path) -> None:
    with pytest.raises(CutError):
        train(small_set, tmp_path, options=SELDOM, report=cut_at(2))
    with pytest.raises(BadConfig, match="holds this training already: --resume carries it on"):
        train(small_set, tmp_path, options=SELDOM)
    train(small_set, tmp_path, options=SELDOM, resume=True)
    assert [line["step"] for line in log(tmp_path)] == [1, 2, 3, 4]


def test_a_log_stays_whole_where_a_full_disk_ends_the_training_that_goes_on(small_set: Path, tmp_path: Path) -> None:
    train(small_set, tmp_path, steps=2)
    file = tmp_path / "log.jsonl"
    before = file.read_bytes()
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) // 2, limit[1]))
    try:
        with pytest.raises(BadConfig, match=r"^cannot write .*log\.jsonl: "):
            RunFolder(tmp_path).forget_after(2)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert file.read_bytes() == before


def test_a_line_of_a_damaged_log_that_is_no_text_is_dropped(small_set: Path, tmp_path: Path) -> None:
    train(small_set, tmp_path, steps=2)
    file = tmp_path / "log.jsonl"
    before = file.read_bytes()
    file.write_bytes(b"\xff\x00" + before.splitlines()[0] + b"\n" + before + b'{"step": 1, "cut')
    train(small_set, tmp_path, steps=3, resume=True)
    assert file.read_bytes().startswith(before) and [line["step"] for line in log(tmp_path)] == [1, 2, 3]


def test_what_a_kill_cut_short_goes_with_the_next_checkpoint(small_set: Path, tmp_path: Path) -> None:
    train(small_set, tmp_path, steps=2)
    cut = [part_beside(tmp_path / name) for name in ("checkpoint-00000003.safetensors", "best.safetensors")]
    for part in cut:
        part.write_bytes(bytes(1000))
    kept = tmp_path / "checkpoint-00000002-before-decay.safetensors"
    kept.write_bytes((tmp_path / "checkpoint-00000002.safetensors").read_bytes())
    train(small_set, tmp_path, steps=4, resume=True)
    assert kept.exists() and not (tmp_path / "checkpoint-00000002.safetensors").exists(), "a copy of the user's stays"
    assert not any(part.exists() for part in cut) and (tmp_path / "checkpoint-00000004.safetensors").exists()


def test_steps_may_grow_and_the_rate_follows_the_new_schedule(small_set: Path, tmp_path: Path) -> None:
    first = train(small_set, tmp_path, steps=2)
    more = train(small_set, tmp_path, steps=5, resume=True)
    rates = [metrics.learning_rate for metrics in (*first, *more)]
    schedules = [dataclasses.replace(RECIPE, steps=steps).learning_rate_at for steps in (2, 5)]
    assert rates == pytest.approx([*map(schedules[0], range(2)), *map(schedules[1], range(2, 5))])
    train(small_set, tmp_path, steps=7, resume=True)
    for file in ("run.json", "network.json"):
        plan = json.loads((tmp_path / file).read_text())
        assert plan["recipe"]["steps"] == 7
        assert plan["earlier_steps"] == [{"steps": 2, "until": 2}, {"steps": 5, "until": 5}]
    assert [line["step"] for line in log(tmp_path)] == [1, 2, 3, 4, 5, 6, 7]
    assert load_network(tmp_path).card["last_step"] == 7


def test_the_best_of_a_schedule_that_was_left_is_no_result(small_set: Path, tmp_path: Path) -> None:
    """The best of step 3 is not among the steps that were kept, once their number is another."""
    images, few = [RangeImages(small_set, "all", "test")], RunOptions(1, 2, 0)
    for steps, expected in ((9, 3), (4, 4)):
        out = tmp_path / str(steps)
        with pytest.raises(CutError):
            before = GivenScores(images, 1, accuracies=(0.1, 0.2, 0.9))
            train(small_set, out, steps=9, options=few, validation=before, report=cut_at(3))
        after = GivenScores(images, 1, accuracies=(0.3, 0.4, *(0.1,) * 7))
        train(small_set, out, steps=steps, options=few, resume=True, validation=after)
        assert load_network(out).card["step"] == expected
        assert [line["step"] for line in log(out)] == [*range(1, steps + 1)]


def test_weights_that_a_kill_left_without_their_card_are_no_best(small_set: Path, tmp_path: Path) -> None:
    images, few = [RangeImages(small_set, "all", "test")], RunOptions(1, 2, 0)
    with pytest.raises(CutError):
        before = GivenScores(images, 1, accuracies=(0.8, 0.2, 0.1))
        train(small_set, tmp_path, steps=9, options=few, validation=before, report=cut_at(3))
    (tmp_path / "best.safetensors").write_bytes(b"those of step 3, beside the card of step 1")
    after = GivenScores(images, 1, accuracies=(0.3, 0.4))
    train(small_set, tmp_path, steps=4, options=few, resume=True, validation=after)
    assert load_network(tmp_path).card["step"] == load_network(tmp_path / "best.safetensors").card["step"] == 4


def test_steps_may_shrink_to_those_done(small_set: Path, tmp_path: Path) -> None:
    with pytest.raises(CutError):
        train(small_set, tmp_path, steps=9, report=cut_at(4))
    with pytest.raises(BadConfig, match=r"has reached step 3: --steps must be at least that, found 2"):
        train(small_set, tmp_path, steps=2, resume=True)
    assert train(small_set, tmp_path, steps=3, resume=True) == []
    assert load_network(tmp_path).card["step"] == 3


def test_a_growing_training_keeps_its_best_weights(small_set: Path, tmp_path: Path) -> None:
    held_out = RangeImages(small_set, "all", "test")
    train(small_set, tmp_path, steps=2, validation=GivenScores([held_out], 1, accuracies=(0.7, 0.3)))
    best = (tmp_path / "best.safetensors").read_bytes()
    said = train(small_set, tmp_path, steps=3, resume=True, validation=GivenScores([held_out], 1, accuracies=(0.6,)))
    assert [metrics.val_best_step for metrics in said] == [1]
    assert (tmp_path / "network.safetensors").read_bytes() == (tmp_path / "best.safetensors").read_bytes() == best


def held_out(data: Path, count: int | None = None, every: int = 1) -> GivenScores:
    return GivenScores([RangeImages(data, "all", "test")], every, count, accuracies=(0.1,) * 9)


def with_noise(data: Path, most: float) -> RangeImages:
    return RangeImages(data, "all", "train", sensor=load_sensor_model().with_artifacts(Noise(0.0, most)))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (lambda data: {"learning_rate": 0.02}, "recipe.learning_rate was 0.01, now 0.02"),
        (lambda data: {"seed": 1}, "seed was 0, now 1"),
        (lambda data: {"seed": 1, "steps": 9}, "seed was 0, now 1"),
        (lambda data: {"settings": {**TINY, "patch": 8}}, "settings.patch was 16, now 8"),
        (lambda data: {"bf16": True}, "recipe.bf16 was false, now true"),
        (lambda data: {"ema": 0.9}, "recipe.ema was not given, now 0.9"),
        (lambda data: {"momentum": 0.5}, "recipe.momentum was 0.9, now 0.5"),
        (
            lambda data: {"geometric_augmentation": dataclasses.replace(RECIPE.geometric_augmentation, zoom=0.5)},
            "recipe.geometric_augmentation.zoom was 0.0, now 0.5",
        ),
        (
            lambda data: {"batch_size": 4, "accumulate": 2},
            "recipe.batch_size was 2, now 4",
        ),
        (
            lambda data: {"batch_size": 4, "accumulate": 2, "learning_rate": 0.02, "balance": 0, "clip": 0},
            "recipe.batch_size was 2, now 4",
        ),
        (lambda data: {"images": RangeImages(data, "noise", "train")}, 'variant was "all", now "noise"'),
        (lambda data: {"images": with_noise(data, 50.0)}, "sensor.artifacts[1].high_mm was 100.0, now 50.0"),
        (lambda data: {"images": RangeImages(data, "all", "train", only=("*",))}, 'data.only was not given, now ["*"]'),
        (
            lambda data: {
                "images": RangeImages(data, "all", "train", labels="limbs14"),
                "settings": {**TINY, "classes": 14},
            },
            "settings.classes was not given, now 14",
        ),
        (lambda data: {"images": RangeImages(data, "all", "train", sensor="kinect_v1")}, "sensor.name was "),
        (lambda data: {"images": RangeImages(data / "train-*0.tar", "all", "train")}, 'data.set was "'),
        (lambda data: {"validation": held_out(data)}, "validation was not given, now given"),
    ],
)
def test_a_refusal_names_the_field_that_differs(
    small_set: Path, tmp_path: Path, changes: Callable[[Path], dict[str, Any]], message: str
) -> None:
    train(small_set, tmp_path, steps=1)
    with pytest.raises(BadConfig) as caught:
        train(small_set, tmp_path, resume=True, **{"steps": 1, **changes(small_set)})
    said = str(caught.value)
    assert f"{tmp_path} holds another training: {message}" in said
    if message[-1] not in ' "':
        assert said.endswith(message)


def test_a_refusal_names_the_field_of_validation_that_differs(small_set: Path, tmp_path: Path) -> None:
    train(small_set, tmp_path, steps=1, validation=held_out(small_set, 3))
    for validation, message in (
        (held_out(small_set, 4), "validation.images was 3, now 4"),
        (held_out(small_set, 3, 2), "validation.every was 1, now 2"),
        (None, "validation was given, now not given"),
    ):
        with pytest.raises(BadConfig, match=message):
            train(small_set, tmp_path, steps=1, validation=validation, resume=True)


def test_another_rig_is_named_by_its_fields(small_set: Path, tmp_path: Path, pack_figures: Callable[..., Path]) -> None:
    farther = pack_figures(tmp_path / "shards", rig=dataclasses.replace(SMALL, stand_off_m=3.0))
    train(small_set, tmp_path / "run", steps=1)
    with pytest.raises(BadConfig) as caught:
        train(farther, tmp_path / "run", steps=1, resume=True)
    assert str(caught.value).endswith("holds another training: rig.stand_off_m was 2.5, now 3.0")


def test_differences_of_mixtures_are_named_like_those_of_sets(tmp_path: Path) -> None:
    def plan(*sets: dict[str, Any]) -> dict[str, Any]:
        return {"recipe": {"steps": 1}, "data": {"mixture": list(sets), "seed": 0} if len(sets) > 1 else sets[0]}

    one, other = {"set": "a", "weight": 1.0}, {"set": "b", "weight": 2.0}
    check_plan(tmp_path, plan(one, other), plan(one, other), 0)
    for found, wanted, message in (
        (plan(one, other), plan(one, {**other, "weight": 3.0}), "data.mixture[1].weight was 2.0, now 3.0"),
        (plan(one, other), plan({**one, "set": "c"}, other), 'data.mixture[0].set was "a", now "c"'),
        (
            plan(one),
            plan(one, other),
            'data.mixture was not given, now [{"set": "a", "weight": 1.0}, {"set": "b", "weight": 2.0}]',
        ),
    ):
        with pytest.raises(BadConfig) as caught:
            check_plan(tmp_path, found, wanted, 0)
        assert str(caught.value) == f"{tmp_path} holds another training: {message}"
