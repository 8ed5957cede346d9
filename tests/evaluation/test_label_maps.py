"""Scores by the classes of a label map: of a network that predicts them, and of one whose parts are joined."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from label_networks import Places
from matplotlib.text import Text
from PIL import Image
from small_rig import SMALL

from bodyseg_data.core import BadConfig
from bodyseg_data.labels import BACKGROUND, PARTS, PARTS33, LabelMap, load_label_map
from bodyseg_model.commands import cli
from bodyseg_model.evaluation import KINDS, Evaluation, Scores, evaluate, kinds_of, open_images, report, told_kinds
from bodyseg_model.evaluation.figures import draw_confusion, draw_parts
from bodyseg_model.evaluation.scores import count_kinds
from bodyseg_model.networks import Network, build, predict, save_network

LIMBS, ITOP = load_label_map("limbs14"), load_label_map("itop15")
FACES = LabelMap(
    "faces",
    (
        ("chest", ("Suprasternale", "Substernale")),
        ("right_back", ("Rt. PSIS", "Rt. Axilla, Post.")),
        ("left_back", ("Lt. PSIS", "Lt. Axilla, Post.")),
        ("right_breast", ("Rt. Thelion/Bustpoint",)),
        ("left_breast", ("Lt. Thelion/Bustpoint",)),
        ("face", ("Sellion",)),
    ),
)


class Bands(Network):
    """Labels rows from the top in bands of 40 pixels, one class after the other."""

    def __init__(self, classes: int) -> None:
        super().__init__({}, classes)
        self.eval()

    def scores(self, range_m: torch.Tensor) -> torch.Tensor:
        label = (torch.arange(range_m.shape[2]) // 40).clamp(max=self.classes - 1)[:, None]
        scores = torch.zeros(len(range_m), self.classes, *range_m.shape[2:])
        return scores.scatter(1, label.expand(len(range_m), 1, *range_m.shape[2:]), 9.0)


def kind(label_map: LabelMap, truth: str, predicted: str) -> str:
    return KINDS[kinds_of(label_map)[label_map.names.index(truth), label_map.names.index(predicted)]]


def test_the_kinds_of_33_parts_are_as_they_were() -> None:
    """The rule for single parts, written out."""
    regions = ({0, 1, 2}, set(range(3, 15)), set(range(25, 29)))
    for truth in PARTS:
        for predicted in PARTS:
            expected = "other"
            if truth is predicted:
                expected = "right"
            elif truth.mirror == predicted.label:
                expected = "left/right"
            elif any({truth.label, predicted.label} <= region for region in regions) and truth.face != predicted.face:
                swapped = {truth.side, predicted.side} == {"left", "right"}
                expected = "both" if swapped else "front/back"
            assert KINDS[kinds_of(PARTS33)[truth.label, predicted.label]] == expected
    assert not kinds_of(PARTS33).flags.writeable
    assert told_kinds(PARTS33) == set(KINDS)


def test_kinds_are_told_where_the_classes_tell_them() -> None:
    assert kind(LIMBS, "right_hand", "left_hand") == "left/right"
    assert kind(LIMBS, "head", "trunk") == "other"
    assert told_kinds(LIMBS) == told_kinds(ITOP) == {"right", "left/right", "other"}
    assert kind(FACES, "chest", "right_back") == kind(FACES, "left_back", "chest") == "front/back"
    assert kind(FACES, "right_breast", "right_back") == "front/back"
    assert kind(FACES, "right_breast", "left_back") == "both"
    assert kind(FACES, "left_breast", "right_breast") == "left/right"
    assert kind(FACES, "chest", "right_breast") == kind(FACES, "face", "right_back") == "other"
    confusion = np.ones((14, 14), np.int64)
    assert count_kinds(confusion, LIMBS) == {"right": 14, "left/right": 12, "other": 14 * 14 - 26}


def test_a_network_of_classes_is_scored_by_its_classes(small_set: Path) -> None:
    images = open_images(str(small_set), "all", labels=LIMBS)
    network = Bands(14)
    found = evaluate(network, images, batch_size=3)
    counts = np.zeros((14, 14), np.int64)
    for index in range(len(images)):
        shown = images[index]
        truth, predicted = shown["labels"].numpy(), predict(network, shown["range"][None]).labels[0].numpy()
        np.add.at(counts, (truth[truth != BACKGROUND], predicted[truth != BACKGROUND]), 1)
    total = found.total()
    np.testing.assert_array_equal(total.confusion.counts, counts)
    assert total.confidences is not None and total.confidences.pixels == counts.sum()
    assert total.confidences.above(0.0).average_per_class_accuracy == pytest.approx(
        total.confusion.average_per_class_accuracy()
    )
    tree = report(found)
    json.dumps(tree, allow_nan=False)
    assert tree["labels"] == LIMBS.to_json()
    assert [part["name"] for part in tree["classes"]] == list(LIMBS.names)
    assert set(tree["swaps"]) == {"left_right"}, "limbs tell no front from a back"


@pytest.mark.parametrize("draw", [draw_parts, draw_confusion])
def test_charts_show_any_name_and_are_not_cut_by_it(small_set: Path, draw: Callable[[Any], Any]) -> None:
    named = LabelMap("named", (("$x_{$", ("Sellion",)), ("a long name " * 5, ("Nuchale",))))
    figure = draw(report(evaluate(Bands(2), open_images(str(small_set), "all", labels=named))))
    figure.canvas.draw()
    texts = [text for text in figure.findobj(Text) if text.get_text() and text.get_visible()]
    assert any("\\$x" in text.get_text() for text in texts)
    assert all(figure.bbox.padded(1).containsx(text.get_window_extent().x1) for text in texts)


def test_the_confusion_of_classes_with_faces_and_no_sides_is_drawn(small_set: Path) -> None:
    head = LabelMap("head", (("face", ("Sellion",)), ("nape", ("Nuchale",))))
    tree = report(evaluate(Bands(2), open_images(str(small_set), "all", labels=head)))
    legend = draw_confusion(tree).legends[0]
    assert [text.get_text().partition(":")[0] for text in legend.get_texts()] == ["front for back"]


def test_parts_of_a_network_are_joined(small_set: Path) -> None:
    network = Places(0, 20)
    parts = evaluate(network, open_images(str(small_set), "all")).total()
    joined = evaluate(network, open_images(str(small_set), "all", labels=ITOP)).total()
    expected = np.zeros((15, 15), np.int64)
    np.add.at(expected, (ITOP.table[:33, None], ITOP.table[None, :33]), parts.confusion.counts)
    np.testing.assert_array_equal(joined.confusion.counts, expected)
    assert joined.confusion.pixel_accuracy() > parts.confusion.pixel_accuracy()
    assert parts.confidences is not None and joined.confidences is not None
    assert joined.confidences.mean() == parts.confidences.mean(), "a label keeps its own confidence"


def test_scores_of_other_classes_are_refused(small_set: Path) -> None:
    with pytest.raises(BadConfig, match="the network must have the 14 classes of labels 'limbs14', found 15"):
        evaluate(Bands(15), open_images(str(small_set), labels=LIMBS))
    with pytest.raises(BadConfig, match="labels 'limbs14' cannot be joined to 'itop15'"):
        evaluate(Bands(14), open_images(str(small_set), labels=ITOP), label_map=LIMBS)
    with pytest.raises(BadConfig, match="of the same labels, found the labels 'parts33' and 'limbs14': 0 is 'Sellion'"):
        Scores().merge(Scores(label_map=LIMBS))
    mixed, other = Evaluation(), Evaluation(label_map=LIMBS)
    other.subsets["A"] = Scores(label_map=LIMBS)
    with pytest.raises(BadConfig, match="scores to merge must be of the same labels"):
        mixed.merge(other)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folders = {}
    for label_map in (PARTS33, LIMBS, FACES):
        folders[label_map.name] = tmp_path_factory.mktemp("runs") / label_map.name
        folders[label_map.name].mkdir()
        settings = {"patch": 16, "widths": [8], "blocks": [0], "context": False, "classes": len(label_map)}
        facts = {"rig": SMALL.to_json()} | ({} if label_map == PARTS33 else {"labels": label_map.to_json()})
        network = build("compact", settings, seed=1)
        save_network(folders[label_map.name] / "network.safetensors", network, "compact", facts)
    return folders


def call(run: Path, data: Path, out: Path, *more: object) -> dict[str, Any]:
    words = ["--run", run, "--data", data, "--json", out / "x.json", "--frames", 0, "--num-workers", 0, "--images", 4]
    assert cli.main(["evaluate", *map(str, (*words, *more))]) == 0
    found: dict[str, Any] = json.loads((out / "x.json").read_text())
    return found


@pytest.mark.parametrize("name", ["limbs14", "faces"])
def test_the_command_scores_the_classes_of_the_network(
    figures_set: Path, runs: dict[str, Path], tmp_path: Path, name: str
) -> None:
    drawn = name == "faces"
    out = tmp_path / "figures" if drawn else tmp_path  # a folder that is to be made may hold both
    tree = call(runs[name], figures_set, out, *(["--figures", out] if drawn else []))
    label_map = {"limbs14": LIMBS, "faces": FACES}[name]
    assert tree["labels"] == tree["card"]["labels"] == label_map.to_json()
    assert len(tree["classes"]) == len(tree["confusion"]) == len(label_map)
    if not drawn:
        return
    names = ["confidence.png", "confusion.png", "parts.png", "samples.png"]
    assert sorted(path.name for path in out.iterdir()) == [*names, "x.json"]
    for picture_name in names:
        with Image.open(out / picture_name) as picture:
            assert len(set(picture.convert("L").resize((300, 300)).tobytes())) > 20, f"{picture_name} is blank"
    with Image.open(out / "samples.png") as picture:
        shown = {tuple(colour) for colour in np.asarray(picture.convert("RGB")).reshape(-1, 3).tolist()}
    assert {tuple(colour) for colour in label_map.colours.tolist()} <= shown


def test_the_command_joins_the_parts_of_a_network(
    figures_set: Path, runs: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = call(runs["parts33"], figures_set, tmp_path)
    assert "labels" not in whole and [part["name"] for part in whole["classes"]] == list(PARTS33.names)
    joined = call(runs["parts33"], figures_set, tmp_path, "--labels", "limbs14")
    assert joined["labels"] == LIMBS.to_json() and joined["pixels"] == whole["pixels"]
    assert joined["pixel_accuracy"] >= whole["pixel_accuracy"]
    assert "--labels limbs14" in joined["command"]
    capsys.readouterr()
    words = ["--run", runs["limbs14"], "--data", figures_set, "--json", tmp_path / "y.json", "--labels", "itop15"]
    assert cli.main(["evaluate", *map(str, words)]) == 2
    assert (
        capsys.readouterr()
        .err.splitlines()[-1]
        .startswith("bodyseg evaluate: labels 'limbs14' cannot be joined to 'itop15', which splits the class 'trunk'")
    )
    assert not (tmp_path / "y.json").exists()


def test_a_class_for_the_rest_is_mistaken_in_no_kind_of_its_own() -> None:
    assert (
        kind(load_label_map("people"), "person", "none") == kind(load_label_map("people"), "none", "person") == "other"
    )
