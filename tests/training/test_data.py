"""Training on several sets."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from bodyseg_data import Mixture, RangeImages, loader
from bodyseg_data.core import BadConfig
from bodyseg_data.labels import load_label_map
from bodyseg_model.commands import main
from bodyseg_model.networks import build, load_network
from bodyseg_model.training import Metrics, RunFolder, RunOptions, Training, mixed, recipe_for
from bodyseg_model.training.augmentation import mirror_draws
from bodyseg_model.training.distributed import ProcessGroup

ONE = ProcessGroup(0, 1, torch.device("cpu"))
TINY = {"patch": 16, "widths": [12, 16], "blocks": [1, 1]}


def words(data: list[Path], out: Path, *more: str) -> list[str]:
    given = ["train", "--data", *map(str, data), "--out", str(out), "--settings", json.dumps(TINY), "--steps", "2"]
    return [*given, "--batch-size", "2", "--num-workers", "0", "--log-every", "1", "--threads", "1", *more]


def opened(small_set: Path, names: list[str], weights: tuple[float, ...], samples: int | None) -> Any:
    return mixed([RangeImages(small_set, "all", "train", only=[name]) for name in names], weights, samples, 3)


def test_one_set_is_read_as_before(small_set: Path) -> None:
    images = opened(small_set, ["*"], (), None)
    assert isinstance(images, RangeImages)
    assert isinstance(opened(small_set, ["*"], (2.5,), None), RangeImages)


def test_several_sets_are_mixed(small_set: Path) -> None:
    names = ["open-A-*", "*-people-1-*"]
    images = opened(small_set, names, (), None)
    assert isinstance(images, Mixture)
    assert (len(images), images.counts(0), images.counts(5), images.seed) == (12, [8, 4], [8, 4], 3)
    weighted = opened(small_set, names, (1.0, 3.0), 40)
    assert (len(weighted), weighted.counts(0)) == (40, [10, 30])
    assert opened(small_set, ["*"], (), 5).counts(7) == [5]


def test_every_set_needs_a_weight(small_set: Path) -> None:
    with pytest.raises(BadConfig, match=r"^--weights needs a number for each set by each sensor, 2, found 3$"):
        opened(small_set, ["*", "*"], (1.0, 2.0, 3.0), None)


def test_the_weight_of_one_set_is_checked_too(small_set: Path) -> None:
    with pytest.raises(BadConfig, match=r"^a weight must be finite and at least 0, found -3.0$"):
        opened(small_set, ["*"], (-3.0,), None)


def test_a_command_trains_on_a_mixture_and_its_plan_names_all_sets(small_set: Path, tmp_path: Path) -> None:
    data = [small_set, small_set]
    more = ["--weights", "3", "1", "--samples", "12", "--only", "open-A-*"]
    assert main(words(data, tmp_path / "run", *more)) == 0
    plan = json.loads((tmp_path / "run" / "run.json").read_text())
    one = RangeImages(small_set, "all", "train", only=["open-A-*"])
    expected = [{"weight": weight, **one.identity()} for weight in (3.0, 1.0)]
    assert plan["data"] == {"mixture": expected, "seed": 0}
    assert plan["variant"] == "all"
    assert load_network(tmp_path / "run").card["data"] == plan["data"]
    (state,) = json.loads((tmp_path / "run" / "checkpoint.json").read_text())["loader_state"]["loaders"]
    assert (state["samples"], state["position"]) == (12, 4)


def test_a_command_trains_on_a_set_with_the_artifacts_of_several_sensors(small_set: Path, tmp_path: Path) -> None:
    more = ["--sensor", "paper", "kinect_v1", "--weights", "1", "3", "--labels", "people", "--recipe", "finder"]
    assert main(words([small_set], tmp_path, *more)) == 0
    parts = RunFolder(tmp_path).plan()["data"]["mixture"]
    assert [part["weight"] for part in parts] == [1, 3] and len({part["set"] for part in parts}) == 1
    kinds = [{each["artifact"] for each in part["artifacts"]} for part in parts]
    assert "patch_loss" in kinds[1] - kinds[0]
    assert load_network(tmp_path).label_map == load_label_map("people")


def test_a_training_on_a_mixture_carries_on_with_the_same_bits(small_set: Path, tmp_path: Path) -> None:
    class CutError(Exception):
        pass

    def train(out: Path, resume: bool, last: int) -> None:
        images = opened(small_set, ["open-A-*", "*-people-1-*"], (1.0, 3.0), 5)
        recipe = recipe_for("compact", steps=6, batch_size=2, bf16=False)
        network = build("compact", TINY, 1)
        made = Training(network, "compact", images, recipe, RunFolder(out), ONE, run_options=RunOptions(1, 1, 0))

        def report(metrics: Metrics) -> None:
            if metrics.step > last:
                raise CutError

        made.run(resume, report, {})

    train(tmp_path / "whole", False, 6)
    with pytest.raises(CutError):
        train(tmp_path / "cut", False, 3)  # in the middle of the second epoch
    train(tmp_path / "cut", True, 6)
    networks = [(tmp_path / name / "network.safetensors").read_bytes() for name in ("whole", "cut")]
    assert networks[0] == networks[1]


def test_a_sample_that_comes_again_in_an_epoch_is_mirrored_as_drawn_anew(small_set: Path) -> None:
    images = Mixture([(RangeImages(small_set, "none", "train"), 1)], samples=64)
    (batch,) = loader(images, 64)
    drawn = mirror_draws(0, batch["epoch"], batch["key"])
    assert sorted(set(batch["epoch"])) == [0, 1, 2, 3]
    mirrored = {key: {bool(drawn[at]) for at in range(64) if batch["key"][at] == key} for key in batch["key"]}
    assert sum(len(each) == 2 for each in mirrored.values()) > 8


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--weights", "3"], "--weights needs a number for each set by each sensor, 2, found 1"),
        (["--weights", "1", "-2"], "a weight must be finite and at least 0, found -2.0"),
        (["--weights", "0", "0"], "weights of a mixture must have a sum above 0 and finite, found 0 in epoch 0"),
        (["--samples", "0"], "samples must be a whole number of at least 1, found 0"),
        (["--samples", "1"], "they do not fill one batch of 2"),
    ],
)
def test_bad_arguments_get_one_line(
    small_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], more: list[str], message: str
) -> None:
    assert main(words([small_set, small_set], tmp_path / "run", *more)) == 2
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1
