"""Networks of any number of classes: settings, files, the mirror, the loss."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from bodyseg_data.core import BadConfig, MissingLibrary
from bodyseg_data.labels import PARTS33, LabelMap, load_label_map
from bodyseg_model.commands import main
from bodyseg_model.networks import Network, Trained, build, load_network, predict, save_network
from bodyseg_model.networks.names import NETWORKS
from bodyseg_model.training.augmentation import mirror
from bodyseg_model.training.loss import NetworkWithLoss, part_weights

SMALL: dict[str, dict[str, Any]] = {
    "fcn_alexnet": {"width": 1 / 16},
    "compact": {"patch": 8, "widths": [6, 8], "blocks": [0, 1]},
}
LIMBS = load_label_map("limbs14")


def small(name: str, **more: Any) -> Network:
    try:
        return build(name, {**SMALL.get(name, {}), **more}, seed=2).eval()
    except MissingLibrary as error:
        pytest.skip(str(error))


@pytest.mark.parametrize("name", NETWORKS)
def test_the_number_of_classes_is_a_setting(name: str) -> None:
    network = small(name, classes=14)
    assert network.classes == network.settings["classes"] == 14
    range_m = torch.zeros(1, 1, 70, 45)
    range_m[:, :, 20:50, 10:30] = 2.5
    with torch.no_grad():
        assert network(range_m).shape == (1, 14, 70, 45)
    assert int(predict(network, range_m).labels[range_m[:, 0] > 0].max()) < 14
    again = build(name, json.loads(json.dumps(network.settings)), seed=2)
    assert all(torch.equal(one, two) for one, two in zip(network.parameters(), again.parameters(), strict=True))


@pytest.mark.parametrize("name", NETWORKS)
def test_33_classes_are_not_written_and_change_no_bit(name: str) -> None:
    plain, given = small(name), small(name, classes=33)
    assert plain.classes == 33 and "classes" not in given.settings and plain.settings == given.settings
    assert all(torch.equal(one, two) for one, two in zip(plain.parameters(), given.parameters(), strict=True))


@pytest.mark.parametrize("name", NETWORKS)
@pytest.mark.parametrize(
    ("classes", "message"),
    [
        (0, "classes must be a whole number from 1 to 255, found 0"),
        ("14", "classes must be a whole number.*, found '14'"),
        (256, "classes must be a whole number from 1 to 255, found 256"),
    ],
)
def test_numbers_of_classes_that_no_network_has(name: str, classes: Any, message: str) -> None:
    with pytest.raises(BadConfig, match=message):
        small(name, classes=classes)


def saved(folder: Path, labels: LabelMap | None, classes: int) -> Path:
    folder.mkdir()
    facts = {} if labels is None else {"labels": labels.to_json()}
    save_network(folder / "network.safetensors", small("compact", classes=classes), "compact", facts)
    return folder


def test_the_label_map_travels_with_the_network(tmp_path: Path) -> None:
    assert Trained(small("compact"), {}).label_map == PARTS33
    assert load_network(saved(tmp_path / "plain", None, 33)).label_map == PARTS33
    mine = LabelMap("mine", (("face", ("Sellion", "Supramenton")), ("neck", ("Cervicale",))))
    run = saved(tmp_path / "mine", mine, 2)
    found = load_network(run)
    assert found.label_map == mine and found.network.classes == 2
    assert main(["export", "--run", str(run), "--out", str(tmp_path / "x.safetensors")]) == 0
    assert load_network(tmp_path / "x.safetensors").label_map == mine


@pytest.mark.parametrize(
    ("labels", "classes", "message"),
    [
        (None, 14, "the network must have the 33 classes of labels 'parts33', found 14"),
        (LIMBS, 15, "the network must have the 14 classes of labels 'limbs14', found 15"),
    ],
)
def test_a_card_of_other_classes_is_refused(
    tmp_path: Path, labels: LabelMap | None, classes: int, message: str
) -> None:
    with pytest.raises(BadConfig, match=rf"network\.json: {message}$"):
        load_network(saved(tmp_path / "run", labels, classes))


def test_a_damaged_label_map_is_named(tmp_path: Path) -> None:
    run = saved(tmp_path / "run", LIMBS, 14)
    card = json.loads((run / "network.json").read_text())
    card["labels"]["classes"][0]["landmarks"] = ["Nose"]
    (run / "network.json").write_text(json.dumps(card))
    with pytest.raises(BadConfig, match=r"network\.json: labels: .*'Nose' is none of the 33 landmarks"):
        load_network(run)


def test_mirrored_images_have_mirrored_classes() -> None:
    names = LIMBS.names
    right, left, head = (names.index(each) for each in ("right_hand", "left_hand", "head"))
    labels = torch.tensor([[[right, head, 255]], [[left, 255, right]]], dtype=torch.uint8)
    range_m = (labels[:, None] < 255).float()
    _, mirrored = mirror(range_m, labels, torch.tensor([True, False]), LIMBS)
    assert mirrored.tolist() == [[[255, head, left]], [[left, 255, right]]]
    arms = LabelMap("arms", (("arms", ("Rt. Olecranon", "Lt. Olecranon")),))
    one = torch.zeros(1, 1, 2, dtype=torch.uint8)
    assert mirror(one[:, None].float(), one, torch.tensor([True]), arms)[1].tolist() == [[[0, 0]]]


def test_loss_and_counts_are_of_the_classes() -> None:
    network = small("compact", classes=14)
    range_m = torch.zeros(1, 1, 32, 32)
    range_m[:, :, 4:28, 8:24] = 2.0
    labels = torch.where(range_m[:, 0] > 0, 13, 255).to(torch.uint8)
    weights = part_weights(LIMBS.table[:14].astype("int64") + 1, 0.5)
    loss, counts, _ = NetworkWithLoss(network, weights, 4)(range_m, labels, torch.zeros(2))
    assert counts.shape == (14, 14) and int(counts[13].sum()) == int(counts.sum()) == 6 * 4
    with torch.no_grad():
        scores = network.scores(range_m)
    shares = scores.log_softmax(1)[0, 13]
    # Score (i, j) lies in the middle of a cell, and offset 0 selects its first pixel: the loss lies between its bounds.
    assert -float(shares.max()) <= loss.item() <= -float(shares.min())
