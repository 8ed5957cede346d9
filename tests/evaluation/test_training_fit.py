"""A network beside images of another rig or with other artifacts: what is said, and what is refused."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from benches.model.rooms.bench import UNSEEN_FINDER
from small_rig import SMALL

from bodyseg_data.artifacts import Augmentation, Losses, MissingData, Noise, load_sensor_model
from bodyseg_data.core import BadConfig
from bodyseg_data.rigs import Rig, load_rig
from bodyseg_model.commands import cli
from bodyseg_model.evaluation import RigFit, sensor_warning
from bodyseg_model.evaluation.reports import FAR_OFF, SIMILAR
from bodyseg_model.networks import Trained, build, load_network, save_network

PAPER = load_rig()
MODEL = load_sensor_model()


def focused(factor: float) -> Rig:
    """The paper's rig with a camera of another focal length."""
    camera = replace(PAPER.camera, focal_px=PAPER.camera.focal_px * factor)
    return replace(PAPER, name="other", camera=camera)


def test_the_same_rig_is_quiet_and_a_name_is_no_difference() -> None:
    assert RigFit(PAPER, load_rig()).check("set", False) is None
    assert RigFit(PAPER, replace(PAPER, name="mine")).check("set", False) is None


@pytest.mark.parametrize(
    ("images", "ratio"),
    [(focused(0.5), 0.5), (replace(PAPER, stand_off_m=1.25), 2.0), (SMALL, 0.25)],
)
def test_pixels_a_metre_are_those_at_the_stand_off(images: Rig, ratio: float) -> None:
    fit = RigFit(PAPER, images)
    assert fit.pixels_a_metre == pytest.approx(ratio) and fit.factor == pytest.approx(max(ratio, 1 / ratio))
    assert RigFit(images, PAPER).pixels_a_metre == pytest.approx(1 / ratio)


RIGS = "set is of rig other, the network was trained for rig paper: "


@pytest.mark.parametrize(
    ("factor", "line"),
    [
        (1 / (SIMILAR - 0.01), "bodies have 0.81 times as many pixels a metre, which costs a few points of accuracy"),
        (SIMILAR - 0.01, "bodies have 1.2 times as many pixels a metre, which costs a few points of accuracy"),
        (1 / (SIMILAR + 0.01), "bodies have 0.79 times as many pixels a metre, which costs much accuracy"),
        (FAR_OFF - 0.01, "bodies have 1.5 times as many pixels a metre, which costs much accuracy"),
    ],
)
def test_another_pixel_size_is_told(factor: float, line: str) -> None:
    for other_rig in (False, True):
        assert RigFit(PAPER, focused(factor)).check("set", other_rig) == RIGS + line


@pytest.mark.parametrize(
    ("change", "difference"),
    [
        ({"range_step_mm": 2.0}, "range_step_mm"),
        ({"camera": replace(PAPER.camera, rows=600)}, "camera"),
        ({"projector": replace(PAPER.projector, position_m=(0.1, 0.0, 0.0))}, "projector"),
        (
            {"stand_off_m": 2.505, "second_projector": replace(PAPER.projector, position_m=(0.75, 0.0, 0.0))},
            "stand_off_m, second_projector",
        ),
    ],
)
def test_what_else_differs_is_named(change: dict[str, Any], difference: str) -> None:
    line = RigFit(PAPER, replace(PAPER, name="other", **change)).check("set", False)
    assert line == f"{RIGS}as many pixels a metre, another {difference}"


@pytest.mark.parametrize("factor", [0.5, 1 / (FAR_OFF + 0.01), FAR_OFF + 0.01])
def test_a_rig_far_off_is_refused_unless_it_is_asked_for(factor: float) -> None:
    fit = RigFit(PAPER, focused(factor))
    with pytest.raises(BadConfig) as caught:
        fit.check("set", False)
    told = f"{RIGS}bodies have {factor:.2g} times as many pixels a metre"
    assert str(caught.value) == f"{told}, too far off to score the network; --other-rig does so all the same"
    assert fit.check("set", True) == f"{told}, which costs much accuracy"


def test_of_several_rigs_the_one_farthest_off_tells() -> None:
    for rigs in itertools.permutations([PAPER, focused(FAR_OFF - 0.01), focused(0.5)]):
        assert RigFit.worst(PAPER, rigs) == RigFit(PAPER, focused(0.5))


def trained(**card: Any) -> Trained:
    return Trained(build("compact", {"patch": 16, "widths": [4], "blocks": [0]}), card)


def test_the_artifacts_trained_on_are_quiet() -> None:
    for variant in ("all", "none", "occ+md"):
        assert sensor_warning(trained(), Augmentation(PAPER, variant, sensor=MODEL), "set") is None  # type: ignore[arg-type]
    other = trained(sensor=MODEL.with_artifacts(Noise(0.0, 5.0)).to_json())
    assert sensor_warning(other, Augmentation(PAPER, "occ", sensor=MODEL), "set") is None, "no noise is applied"


def test_other_artifacts_are_named() -> None:
    card = MODEL.with_artifacts(Noise(0.0, 5.0), MissingData((0.9,))).without("occlusion").to_json()
    shown = Augmentation(PAPER, "all", sensor=MODEL.without("missing_data").with_artifacts(Losses(0.1)))
    assert sensor_warning(trained(sensor=card), shown, "set") == (
        "set has other artifacts than in training (sensor paper): other strengths of noise; also occlusion, losses; "
        "without missing_data"
    )


def test_artifacts_that_are_not_installed_are_told() -> None:
    card = {"name": "rusty", "artifacts": [{"artifact": "rust", "version": 1}]}
    line = sensor_warning(trained(sensor=card), Augmentation(PAPER, "all", sensor=MODEL), "set")
    assert line is not None and line.startswith("the artifacts of set cannot be compared with those trained on: ")
    assert "'rust'" in line


def test_cards_whose_artifacts_were_removed_are_read_and_say_so_when_asked() -> None:
    finder = load_network(UNSEEN_FINDER)
    assert "lateral_noise" in json.dumps(finder.card["sensor"]) and finder.label_map.name == "people"
    line = sensor_warning(finder, Augmentation(PAPER, "all", sensor=MODEL), "set")
    told = (
        "the artifacts of set cannot be compared with those trained on: a network's card, sensor: an artifact must be "
    )
    assert line is not None and line.startswith(told) and line.endswith("found 'lateral_noise'")


def test_evaluate_tells_refuses_and_goes_on(
    paper_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    torch.manual_seed(1)
    small = build("compact", {"patch": 16, "widths": [8], "blocks": [0], "context": False})
    facts = {"variant": "all", "rig": SMALL.to_json(), "sensor": MODEL.with_artifacts(Noise(0.0, 5.0)).to_json()}
    save_network(tmp_path / "network.safetensors", small, "compact", facts)
    words = ["evaluate", "--run", tmp_path, "--data", paper_set, "--json", tmp_path / "x.json", "--images", 1]
    words += ["--frames", 0, "--num-workers", 1, "--worker-method", "process"]
    assert cli.main(list(map(str, words))) == 2
    told = "shards is of rig paper, the network was trained for rig small: bodies have 4 times as many pixels a metre"
    (line,) = capsys.readouterr().err.splitlines()
    assert line == f"bodyseg evaluate: {told}, too far off to score the network; --other-rig does so all the same"
    assert not (tmp_path / "x.json").exists()
    assert cli.main([*map(str, words), "--other-rig"]) == 0
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == f"bodyseg evaluate: warning: {told}, which costs much accuracy"
    assert lines[1].startswith(
        "bodyseg evaluate: warning: shards has other artifacts than in training (sensor paper): "
    )
    tree = json.loads((tmp_path / "x.json").read_text())
    assert tree["data"][0]["pixels_a_metre_of_trained"] == 4
    assert tree["peak_mb"] > 50, "this process alone takes more"
