"""The tutorial's commands run as they are written, at small size."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
import pytest
from pngs import pixels
from tutorials import prepare, read_tutorial, smaller

from bodyseg_data.labels import BACKGROUND
from bodyseg_model.commands import main as bodyseg_main
from bodyseg_model.commands.cli import COMMANDS

SIZES: Final = {
    "shard --meshes": "6",
    "shard --views": "1",
    "shard --workers": "1",
    "shard --geodesics": "edges",
    "inspect --rows": "1",
    "train --steps": "1",
    "train --batch-size": "2",
    "train --num-workers": "0",
    "train --val-every": "1",
    "train --precision": "float32",  # several times faster on processors without instructions for bfloat16
    "evaluate --images": "2",
    "evaluate --frames": "1",
    "evaluate --num-workers": "0",
}
"""Options that make the commands short."""

RIG: Final = "my_rig.toml"


def coarser(rig: str) -> str:
    """The tutorial's rig with a quarter of the pixels a side."""
    for whole, quarter in (("rows = 480", "rows = 120"), ("columns = 848", "columns = 212"), ("425.0", "106.25")):
        assert rig.count(whole) == 2, "of the camera and of the projector"
        rig = rig.replace(whole, quarter)
    return rig


@pytest.mark.usefixtures("packing_here", "prepared")
def test_the_tutorial_runs_from_a_recording_to_labels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    tutorial = read_tutorial()
    monkeypatch.chdir(tmp_path)
    prepare(tmp_path, replace(tutorial, files={RIG: coarser(tutorial.files[RIG])}), 2)
    for command in tutorial.commands:
        assert bodyseg_main(smaller(command, SIZES)) == 0, (command, capfd.readouterr().err)
    assert 0 < json.loads((tmp_path / "scores.json").read_text())["average_per_class_accuracy"] < 1
    summary = json.loads((tmp_path / "labelled" / "summary.json").read_text())
    assert [len(frame["bodies"]) for frame in summary["each"]] == [1, 1]
    card = json.loads((tmp_path / "my_network.json").read_text())
    assert (card["rig"]["name"], card["sensor"]["name"]) == ("my_rig", "my_sensor")
    for out in ("labelled", "labelled_again"):
        assert len(list((tmp_path / out / "overlay").glob("*.png"))) == 2
    labels, exported = (pixels(tmp_path / out / "labels" / "0000.png") for out in ("labelled", "labelled_again"))
    named = labels != BACKGROUND
    np.testing.assert_array_equal(exported != BACKGROUND, named)
    # Weights are exported in 16 bits; of a network that has hardly learned anything many pixels are near ties.
    assert named.sum() > 500 and (labels != exported).sum() < 0.01 * named.sum()


def test_the_tutorial_has_every_step_of_the_way() -> None:
    tutorial = read_tutorial()
    assert list(tutorial.files) == [RIG]
    steps = [" ".join(command[:2]) if command[0] == "sensor" else command[0] for command in tutorial.commands]
    assert steps[0] == "sensor fit"
    assert {"shard", "train", "evaluate", "segment", "export"} <= set(steps)
    assert {command[0] for command in tutorial.commands} <= {name.split()[0] for name in COMMANDS}


def test_what_is_nearer_leaves_out_the_wall() -> None:
    """The page asks for a person 2 m away, and a wall half a metre behind at least."""
    (words,) = [command for command in read_tutorial().commands if command[:2] == ("sensor", "fit")]
    assert 2.2 < float(words[words.index("--nearer-than") + 1]) < 2.5


def test_a_command_is_made_smaller_by_changed_and_added_options() -> None:
    command = ("train", "--steps", "1200", "--out", "run")
    assert smaller(command, {"train --steps": "2", "train --seed": "1", "shard --views": "2"}) == [
        *("train", "--steps", "2", "--out", "run"),
        *("--seed", "1"),
    ]
