"""Training on the classes of a label map, by code and by the command."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from bodyseg_data import RangeImages
from bodyseg_data.core import BadConfig
from bodyseg_data.labels import BACKGROUND, LabelMap, load_label_map
from bodyseg_model.commands import main
from bodyseg_model.networks import build, load_network, predict
from bodyseg_model.training import GeometricAugmentation, Metrics, RunFolder, RunOptions, Training, loop, recipe_for
from bodyseg_model.training.distributed import ProcessGroup
from bodyseg_model.training.loss import part_weights

ONE = ProcessGroup(0, 1, torch.device("cpu"))
TINY = {"patch": 16, "widths": [12, 16], "blocks": [1, 1]}
LIMBS = load_label_map("limbs14")


def test_classes_are_learned(small_set: Path, tmp_path: Path) -> None:
    halves = LabelMap("halves", (("above", LIMBS.classes[0][1] + LIMBS.classes[1][1]), ("below", _legs())))
    images = RangeImages(small_set, "none", "train", labels=halves)
    recipe = recipe_for(
        "compact",
        steps=30,
        batch_size=4,
        learning_rate=6e-3,
        bf16=False,
        geometric_augmentation=GeometricAugmentation(),
    )
    network = build("compact", {"patch": 8, "widths": [16, 24], "blocks": [1, 1], "classes": 2}, seed=3)
    said: list[Metrics] = []
    training = Training(
        network, "compact", images, recipe, RunFolder(tmp_path / "run"), ONE, run_options=RunOptions(10, 1000, 0)
    )
    training.run(False, said.append, {})
    trained = load_network(tmp_path / "run")
    assert trained.label_map == halves
    right = total = 0
    for index in range(len(images)):
        truth = images[index]["labels"].numpy()
        predicted = predict(trained.network, images[index]["range"][None]).labels[0].numpy()
        right += int((truth == predicted)[truth != BACKGROUND].sum())
        total += int((truth != BACKGROUND).sum())
    assert right / total > 0.8
    assert said[-1].accuracy > 0.8


def _legs() -> tuple[str, ...]:
    return tuple(landmark for name, landmarks in LIMBS.classes[8:] for landmark in landmarks)


def test_a_network_of_other_classes_is_refused(small_set: Path, tmp_path: Path) -> None:
    images = RangeImages(small_set, "none", "train", labels="limbs14")
    recipe = recipe_for("compact", steps=1, batch_size=2)
    with pytest.raises(BadConfig, match="the network must have the 14 classes of labels 'limbs14', found 33"):
        Training(build("compact", TINY), "compact", images, recipe, RunFolder(tmp_path / "run"), ONE)
    assert not (tmp_path / "run").exists()


def command(data: Path, out: Path, *more: str) -> list[str]:
    words = ["train", "--data", str(data), "--out", str(out), "--settings", json.dumps(TINY), "--steps", "2"]
    return [*words, "--batch-size", "2", "--num-workers", "0", "--log-every", "1", "--threads", "1", *more]


def test_the_command_writes_the_whole_map(small_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "mine.toml"
    text = 'format = "bodyseg labels 1"\nname = "mine"\n[classes]\narms = ["Rt. Olecranon", "Lt. Olecranon"]\n'
    file.write_text(text + 'head = ["Sellion", "Nuchale"]\n')
    out = tmp_path / "run"
    assert main(command(small_set, out, "--labels", str(file), "--checkpoint-every", "1")) == 0
    expected = {
        "name": "mine",
        "classes": [
            {"name": "arms", "landmarks": ["Rt. Olecranon", "Lt. Olecranon"]},
            {"name": "head", "landmarks": ["Sellion", "Nuchale"]},
        ],
    }
    card, plan = (json.loads((out / name).read_text()) for name in ("network.json", "run.json"))
    assert card["labels"] == plan["labels"] == plan["data"]["labels"] == expected
    assert card["settings"]["classes"] == 2
    assert load_network(out).label_map.names == ("arms", "head")
    capsys.readouterr()

    (out / "network.json").unlink()
    file.write_text(text.replace("arms = [", 'head = ["Sellion", "Nuchale"]\narms = ['))
    assert main(command(small_set, out, "--labels", str(file), "--resume")) == 2
    assert "holds another training" in capsys.readouterr().err, "the same classes in another order are other labels"


def test_without_labels_nothing_is_written_of_them(small_set: Path, tmp_path: Path) -> None:
    assert main(command(small_set, tmp_path / "run")) == 0
    for name in ("network.json", "run.json"):
        content: dict[str, Any] = json.loads((tmp_path / "run" / name).read_text())
        assert "labels" not in content and "classes" not in content["settings"] and "labels" not in content["data"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--labels", "limbs"], "no label map is called 'limbs'"),
        (["--labels", "nowhere.toml"], "cannot read the label map file nowhere.toml"),
        (
            ["--labels", "limbs14", "--settings", '{"classes": 5}'],
            "the network must have the 14 classes of labels 'limbs14', found 5",
        ),
    ],
)
def test_labels_that_are_none_get_one_line(
    small_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], message: str
) -> None:
    assert main([*command(small_set, tmp_path / "run"), *words]) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("bodyseg train: ")]
    assert message in lines[-1]
    assert not list(tmp_path.glob("run/*.json"))


def test_classes_are_weighed_by_their_pixels(small_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    images = RangeImages(small_set, "none", "train", labels="limbs14")
    pixels = np.zeros(14, np.int64)
    for index in range(len(images)):
        pixels += np.bincount(images[index]["labels"].numpy().ravel(), minlength=256)[:14]
    asked: list[list[float]] = []

    def weights(counts: np.ndarray[tuple[int], np.dtype[np.float64]], balance: float) -> torch.Tensor:
        asked.append(counts.tolist())
        return part_weights(counts, balance)

    monkeypatch.setattr(loop, "part_weights", weights)
    recipe = recipe_for("compact", steps=1, batch_size=2)
    network = build("compact", {**TINY, "classes": 14}, seed=1)
    training = Training(
        network, "compact", images, recipe, RunFolder(tmp_path / "run"), ONE, run_options=RunOptions(1, 1, 0)
    )
    training.run(False, lambda _: None, {})
    assert asked == [(pixels / len(images)).tolist()]
