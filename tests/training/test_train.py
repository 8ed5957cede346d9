"""`bodyseg_model.train`: what a user's program trains by."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from label_networks import Places
from small_rig import SMALL
from small_training import RECIPE, TINY, written
from torch.utils.data import ConcatDataset

from bodyseg_data import BadConfig, LabelClass, RangeImages, ShardWriter
from bodyseg_model import RunOptions, Validation, load_network, train
from bodyseg_model.networks import build
from bodyseg_model.training import Metrics

ALONE = RunOptions(log_every=1, checkpoint_every=1, num_workers=0)
RECIPE_OF_TWO = dataclasses.replace(RECIPE, steps=2)


def test_a_network_by_name_is_trained_and_returned(small_set: Path, tmp_path: Path) -> None:
    said: list[Metrics] = []
    images = RangeImages(small_set, variant="all", split="train", labels="limbs14")
    out = tmp_path / "run"
    trained = train(images, str(out), "compact", RECIPE_OF_TWO, run_options=ALONE, device="cpu", report=said.append)
    assert [metrics.step for metrics in said] == [1, 2]
    assert not trained.network.training and trained.network.classes == 14
    assert trained.label_map.name == "limbs14" and trained.card["step"] == 2 and trained.card["network"] == "compact"
    again = load_network(str(out))
    assert again.card == trained.card
    for name, weight in trained.network.state_dict().items():
        assert torch.equal(weight, again.network.state_dict()[name])
    assert again.card["read_from"] == [small_set.name]


def test_without_a_recipe_a_network_has_its_own(
    small_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []

    def recipe_for(name: str) -> Any:
        asked.append(name)
        return RECIPE_OF_TWO

    monkeypatch.setattr("bodyseg_model.training.loop.recipe_for", recipe_for)
    images = RangeImages(small_set, variant="all", split="train")
    train(images, tmp_path / "run", build("compact", TINY, 0), run_options=ALONE, device="cpu")
    assert asked == ["compact"]


def test_a_network_that_is_given_keeps_its_weights(small_set: Path, tmp_path: Path) -> None:
    images, network = RangeImages(small_set, variant="all", split="train"), build("compact", TINY, 0).eval()
    first, second = (
        train(images, tmp_path / name, network, RECIPE_OF_TWO, run_options=ALONE, device="cpu") for name in "ab"
    )
    before, after = build("compact", TINY, 0).state_dict(), first.network.state_dict()
    assert not network.training
    for name, weight in network.state_dict().items():
        assert torch.equal(weight, before[name]) and torch.equal(after[name], second.network.state_dict()[name])
    assert not torch.equal(after["head.weight"], before["head.weight"])
    means = [name for name in before if name.endswith("running_mean")]
    assert means and not any(torch.equal(after[name], before[name]) for name in means), "it was given to evaluate"


def test_a_training_that_was_cut_resumes_with_the_same_bits(small_set: Path, tmp_path: Path) -> None:
    def options(seed: int = 0) -> dict[str, Any]:
        images = RangeImages(small_set, variant="all", split="train", val_share=0.5)
        held_out = RangeImages(small_set, variant="all", split="val", val_share=0.5)
        return {
            "images": images,
            "network": build("compact", TINY, 0),
            "recipe": RECIPE,
            "seed": seed,
            "validation": Validation([held_out], every=2, count=2),
            "run_options": ALONE,
            "device": "cpu",
        }

    def cut(metrics: Metrics) -> None:
        if metrics.step == 3:
            raise KeyboardInterrupt

    whole = train(out=tmp_path / "whole", **options())
    assert "val_accuracy" in whole.card
    with pytest.raises(KeyboardInterrupt):
        train(out=tmp_path / "cut", report=cut, **options())
    with pytest.raises(BadConfig, match="holds this training already"):
        train(out=tmp_path / "cut", **options())
    with pytest.raises(BadConfig, match="holds another training: seed was 0, now 1"):
        train(out=tmp_path / "cut", resume=True, **options(seed=1))
    train(out=tmp_path / "cut", resume=True, **options())
    assert written(tmp_path / "cut") == written(tmp_path / "whole")


def test_a_folder_in_which_another_training_is_at_work_is_left_alone(small_set: Path, tmp_path: Path) -> None:
    images = RangeImages(small_set, variant="all", split="train")

    def other(metrics: Metrics) -> None:
        for resume in (False, True):
            before = written(tmp_path / "run")
            with pytest.raises(BadConfig, match=f"^another training is at work in {tmp_path / 'run'}: wait for its"):
                train(images, tmp_path / "run", build("compact", TINY, 0), RECIPE_OF_TWO, resume=resume, device="cpu")
            assert written(tmp_path / "run") == before

    network = build("compact", TINY, 0)
    train(images, tmp_path / "run", network, RECIPE_OF_TWO, run_options=ALONE, device="cpu", report=other)
    assert not [each for each in (tmp_path / "run").iterdir() if each.name.startswith(".")]


def test_another_dataset_is_refused(small_set: Path, tmp_path: Path) -> None:
    joined: Any = ConcatDataset([RangeImages(small_set), RangeImages(small_set)])
    message = r"^images must be RangeImages, a Mixture or a list of \(images, weight\), found ConcatDataset$"
    with pytest.raises(BadConfig, match=message):
        train(joined, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_test_split_among_the_images_is_told(small_set: Path, tmp_path: Path) -> None:
    network = build("compact", TINY, 0)
    with pytest.warns(UserWarning, match="^images to train on include the test split: open them with split='train'$"):
        train(RangeImages(small_set), tmp_path / "run", network, RECIPE_OF_TWO, run_options=ALONE, device="cpu")


def test_bodies_that_are_trained_and_validated_on_are_told(small_set: Path, tmp_path: Path) -> None:
    """Sets that share bodies hold out different ones, so those of one may be trained on in another."""
    network, held_out = build("compact", TINY, 0), Validation([RangeImages(small_set, split="val", val_share=0.5)])
    told = "^images to validate on show [0-9]+ bodies named as those trained on, like '.+': if they are the same, "
    with pytest.warns(UserWarning, match=told):
        whole = RangeImages(small_set, split="train")
        train(whole, tmp_path / "run", network, RECIPE_OF_TWO, validation=held_out, run_options=ALONE, device="cpu")
    rest = RangeImages(small_set, split="train", val_share=0.5)
    train(rest, tmp_path / "rest", network, RECIPE_OF_TWO, validation=held_out, run_options=ALONE, device="cpu")


def test_names_of_two_sides_that_are_no_pair_are_told(tmp_path: Path) -> None:
    """Half of the images are mirrored, in which their labels would stay as they are."""
    seen = np.full((SMALL.camera.rows, SMALL.camera.columns), 2.0)
    for name, classes in (("own", ["FL", "FR"]), ("said", [LabelClass("FL", mirror="FR"), "FR"])):
        with ShardWriter(tmp_path / name, rig=SMALL, classes=classes, projector="none", workers=0) as out:
            for number in range(RECIPE.batch_size):
                out.write(key=f"room-{number}", range_m=seen, labels=np.full(seen.shape, number % 2, np.uint8))
    network, told = build("compact", TINY | {"classes": 2}, 0), "^classes FL and FR are no pair, .*, or --no-mirror$"
    with pytest.warns(UserWarning, match=told):
        own = RangeImages(tmp_path / "own", "none")
        train(own, tmp_path / "run", network, RECIPE_OF_TWO, run_options=ALONE, device="cpu")
    unmirrored = dataclasses.replace(RECIPE_OF_TWO, mirror=False)
    train(own, tmp_path / "run 2", network, unmirrored, run_options=ALONE, device="cpu")
    said = RangeImages(tmp_path / "said", "none")
    train(said, tmp_path / "run 3", network, RECIPE_OF_TWO, run_options=ALONE, device="cpu")


def test_surfaces_that_no_class_has_are_refused(small_set: Path, tmp_path: Path) -> None:
    with pytest.raises(BadConfig, match="^images to train on have no class for surfaces of none: open them with"):
        train(RangeImages(small_set, split="train", unlabelled=True), tmp_path / "run", device="cpu")
    held_out = Validation([RangeImages(small_set, split="test", unlabelled=True)])
    with pytest.raises(BadConfig, match="^images to train on have no class for surfaces of none: open them with"):
        train(RangeImages(small_set, split="train"), tmp_path / "run", validation=held_out, device="cpu")


def test_images_to_validate_on_have_the_classes_of_those_to_train_on(small_set: Path, tmp_path: Path) -> None:
    """At the start: or others of the same number would be scored in silence, and of another number after many steps."""
    images = RangeImages(small_set, split="train", labels="limbs14")
    limbs = images.label_map
    turned_round = dataclasses.replace(limbs, classes=limbs.classes[::-1])
    message = "^all images of a training must have the same classes, found the labels 'limbs14' and "
    for labels in (None, turned_round):
        held_out = Validation([RangeImages(small_set, split="test", labels=labels)])
        with pytest.raises(BadConfig, match=message):
            train(images, tmp_path / "run", validation=held_out, device="cpu")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"seed": None}, "^a seed must be a whole number from 0 to .*, found None$"),
        ({"seed": 1.0}, "^a seed must be .*found 1.0$"),
        ({"facts": {"subjects": np.int64(3)}}, "^facts must be plain JSON: .*int64"),
    ],
)
def test_what_a_card_cannot_hold_is_refused_at_the_start(
    given: dict[str, Any], message: str, small_set: Path, tmp_path: Path
) -> None:
    images = RangeImages(small_set, variant="all", split="train")
    with pytest.raises(BadConfig, match=message):
        train(images, tmp_path / "run", build("compact", TINY, 0), RECIPE_OF_TWO, device="cpu", **given)
    assert not (tmp_path / "run").exists()


def test_a_program_that_computes_in_double_precision_is_told_so(small_set: Path, tmp_path: Path) -> None:
    images = RangeImages(small_set, variant="all", split="train")
    message = r"^weights and torch.get_default_dtype\(\) must be float32 in training, found torch.float64$"
    with pytest.raises(BadConfig, match=message):
        train(images, tmp_path / "run", build("compact", TINY, 0).double(), RECIPE_OF_TWO, device="cpu")
    torch.set_default_dtype(torch.float64)
    try:
        with pytest.raises(BadConfig, match=message):
            train(images, tmp_path / "run", build("compact", TINY, 0).float(), RECIPE_OF_TWO, device="cpu")
    finally:
        torch.set_default_dtype(torch.float32)
    assert not (tmp_path / "run").exists()


def test_a_network_that_no_file_could_name_is_refused(small_set: Path, tmp_path: Path) -> None:
    images = RangeImages(small_set, variant="all", split="train")
    with pytest.raises(BadConfig, match=r"of a class in NETWORKS.*found label_networks\.Places"):
        train(images, tmp_path / "run", Places(axis=0, step=20), RECIPE_OF_TWO, device="cpu")
    assert not (tmp_path / "run").exists()
