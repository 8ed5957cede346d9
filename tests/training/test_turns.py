"""Images of several sizes in one training: batches of one size each, in turns by their weights."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from small_training import RECIPE, TINY, CutError, cut_at, train, written

from bodyseg_data import Mixture, RangeImages, loader
from bodyseg_data.core import BadConfig
from bodyseg_data.loading import Crop
from bodyseg_model.commands import main
from bodyseg_model.networks import build, load_network
from bodyseg_model.training import RunOptions, mixed
from bodyseg_model.training import train as trained
from bodyseg_model.training.loss import class_pixels
from bodyseg_model.training.turns import Turns


def two_sizes(small_set: Path) -> tuple[RangeImages, RangeImages]:
    whole = RangeImages(small_set, "all", "train")
    return whole, RangeImages(small_set, "none", "train", transform=[Crop(64, 48, "anywhere")])


@pytest.mark.parametrize("weights", [(3, 1), (0.7, 0.3), (0, 2), (1e-3, 1)])
def test_each_batch_is_of_one_size_and_the_sizes_take_turns_by_their_weights(
    small_set: Path, weights: tuple[float, float]
) -> None:
    turns = Turns([*zip(two_sizes(small_set), weights, strict=True)])
    sizes = [tuple(batch["range"].shape) for batch in itertools.islice(turns.loader(2), 40)]
    assert {size[0] for size in sizes} == {2}
    small = np.cumsum([size[2:] == (64, 48) for size in sizes])
    share = weights[1] / sum(weights)
    assert np.abs(small - share * np.arange(1, 41)).max() <= 0.5 + 1e-9
    assert turns.identity()["turns"][1]["weight"] == weights[1]


def test_the_batches_of_each_are_those_of_its_own_loader(small_set: Path) -> None:
    images = two_sizes(small_set)
    turns = Turns([(each, 1) for each in images]).loader(4, drop_last=True)
    found = [batch["key"] for batch in itertools.islice(turns, 12)]
    for number, each in enumerate(images):
        own = itertools.chain.from_iterable(itertools.repeat(loader(each, 4, drop_last=True)))
        assert found[number::2] == [batch["key"] for batch in itertools.islice(own, 6)]
    assert turns.stats()["batches"] == 12


def test_images_of_one_kind_are_read_and_named_as_without_turns(small_set: Path) -> None:
    images = two_sizes(small_set)[0]
    turns = Turns(images)
    assert (turns.identity(), turns.variant, turns.sets) == (images.identity(), "all", (images,))
    np.testing.assert_array_equal(turns.class_pixels(), class_pixels(images))
    assert turns.loader(2).state_dict()["loaders"] == [loader(images, 2).state_dict()]


def test_parts_are_weighed_by_the_pixels_of_all_in_their_turns(small_set: Path) -> None:
    images = [RangeImages(small_set, "none", "train", only=[name]) for name in ("open-A-*", "*-people-1-*")]
    whole, small = map(class_pixels, images)
    assert (whole != small).any()
    np.testing.assert_allclose(Turns([(images[0], 3), (images[1], 1)]).class_pixels(), 0.75 * whole + 0.25 * small)


def test_a_set_of_few_samples_weighs_by_its_turns_and_not_by_their_number(small_set: Path) -> None:
    whole, _ = two_sizes(small_set)
    one = RangeImages(small_set, "none", "train", only=[whole.keys[0]])
    assert len(one) == 1 < len(whole)
    mean = np.mean([class_pixels(RangeImages(small_set, "none", only=[key])) for key in whole.keys], 0)
    np.testing.assert_allclose(Turns([(one, 1), (whole, 1)]).class_pixels(), 0.5 * class_pixels(one) + 0.5 * mean)


def test_a_training_on_two_sizes_carries_on_with_the_same_bits(small_set: Path, tmp_path: Path) -> None:
    def run(out: str, **more: Any) -> None:
        parts: Any = [*zip(two_sizes(small_set), (1, 2), strict=True)]
        train(small_set, tmp_path / out, images=parts, steps=5, accumulate=2, **more)

    run("whole")
    with pytest.raises(CutError):
        run("cut", report=cut_at(3))
    run("cut", resume=True)
    assert written(tmp_path / "cut") == written(tmp_path / "whole")
    card = load_network(tmp_path / "cut").card
    assert [part["weight"] for part in card["data"]["turns"]] == [1.0, 2.0]
    assert card["variant"] == "all, none"


def test_a_command_mixes_sets_of_one_size_and_lets_sizes_take_turns(
    small_set: Path, paper_set: Path, tmp_path: Path
) -> None:
    words = ["train", "--data", *map(str, (small_set, paper_set, small_set)), "--weights", "1", "2", "3"]
    words += ["--samples", "12", "--settings", json.dumps(TINY), "--steps", "3", "--batch-size", "1"]
    assert main([*words, "--num-workers", "0", "--threads", "1", "--out", str(tmp_path)]) == 0
    small, large = json.loads((tmp_path / "run.json").read_text())["data"]["turns"]
    assert (small["weight"], large["weight"]) == (4.0, 2.0)
    assert [part["weight"] for part in small["mixture"]] == [1.0, 3.0]
    images = mixed([RangeImages(each, "all", "train") for each in (small_set, paper_set, small_set)], (1, 2, 3), 12, 0)
    assert isinstance(images, list)
    assert [len(each) for each, _ in images] == [8, 4]
    assert all(isinstance(each, Mixture) for each, _ in images)
    alone = mixed([RangeImages(each, "all", "train") for each in (small_set, paper_set)], (0, 1), None, 0)
    assert isinstance(alone, RangeImages) and alone.path == str(paper_set)


def test_what_cannot_take_turns_is_refused(small_set: Path, tmp_path: Path) -> None:
    whole, small = two_sizes(small_set)
    few = RangeImages(small_set, "none", "train", labels="people")
    wrong: dict[str, Any] = {
        r"images must be RangeImages, a Mixture or a list of \(images, weight\), found str": "shards",
        r"a list of \(images, weight\), found list": [whole, small],
        "weights of images that take turns must be finite, at least 0 and not all 0, found ": [(whole, 1), (small, -1)],
        r"and not all 0, found \(0, 0\)": [(whole, 0), (small, 0)],
        "all images of a training must have the same classes, found": [(whole, 1), (few, 1)],
    }
    for said, images in wrong.items():
        with pytest.raises(BadConfig, match=said):
            trained(images, tmp_path / "run", recipe=RECIPE, run_options=RunOptions(1, 1, 0))
    assert not (tmp_path / "run").exists()


def test_a_share_of_the_start_is_in_what_is_saved_and_not_in_what_is_trained(small_set: Path, tmp_path: Path) -> None:
    start = {name: each.clone() for name, each in build("compact", TINY, 0).state_dict().items()}
    losses = [metrics.loss for metrics in train(small_set, tmp_path / "plain", steps=3)]
    assert losses == [each.loss for each in train(small_set, tmp_path / "half", steps=3, start_share=0.25)]
    plain, half = (load_network(tmp_path / name) for name in ("plain", "half"))
    assert half.card["recipe"]["start_share"] == 0.25
    assert "start_share" not in plain.card["recipe"]
    for name, weights in plain.network.state_dict().items():
        expected = 0.75 * weights + 0.25 * start[name] if weights.is_floating_point() else weights
        torch.testing.assert_close(half.network.state_dict()[name], expected)
    with pytest.raises(CutError):
        train(small_set, tmp_path / "cut", steps=3, start_share=0.25, report=cut_at(2))
    held = load_file(next((tmp_path / "cut").glob("*.safetensors")))
    for name, weights in load_network(tmp_path / "cut").network.state_dict().items():  # as it would be saved now
        now = held[f"network.{name}"]
        expected = 0.75 * now + 0.25 * start[name] if now.is_floating_point() else now
        torch.testing.assert_close(weights, expected)
    train(small_set, tmp_path / "cut", steps=3, start_share=0.25, resume=True, seed=0)
    assert written(tmp_path / "cut") == written(tmp_path / "half")


def test_a_share_of_the_start_needs_a_trained_network_with_all_weights(
    small_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["train", "--data", str(small_set), "--out", str(tmp_path / "run"), "--start-share", "0.5"]
    wrong = {
        "--start-share is a share of a trained network's weights: give that as --pretrained": [],
        "--start-share needs all weights in --pretrained compact, which lacks head.": [
            *("--pretrained", "compact", "--labels", "people")
        ],
        "start_share must be from 0 to 0.99, found 1.0": ["--start-share", "1", "--pretrained", "compact"],
    }
    for said, more in wrong.items():
        assert main([*words, *more]) == 2
        assert said in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
