"""Frames are resampled for the rig that the network was trained for."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from label_networks import Places
from PIL import Image
from small_rig import SMALL

from bodyseg_data import RangeImages
from bodyseg_data.rigs import load_rig, rig_from_json
from bodyseg_model import runtimes
from bodyseg_model.commands import cli
from bodyseg_model.evaluation import ConfusionMatrix
from bodyseg_model.networks import Trained, build, save_network
from bodyseg_model.recordings import frame_camera
from bodyseg_model.runtimes import load_network
from bodyseg_model.segmentation import Background, FrameLabeller
from bodyseg_model.segmentation.views import STEP
from bodyseg_model.training import GeometricAugmentation, RunFolder, RunOptions, Training, recipe_for
from bodyseg_model.training.distributed import ProcessGroup

KEEP = Background("keep")
LENS = frame_camera((60, 80), "a frame", focal_px=100.0).camera


def test_a_body_gets_the_pixel_size_of_the_networks_rig() -> None:
    places = Places(axis=0, step=1)
    _, labels_of = FrameLabeller(Trained(places, {"rig": SMALL.to_json()}), KEEP).of(LENS)
    frame = np.zeros((60, 80), np.float32)
    frame[10:50, 34:46] = 2.0
    (body,) = labels_of(frame).bodies
    assert labels_of.rig == SMALL
    assert body.scale == pytest.approx(SMALL.camera.focal_px / 2.5 / (100 / 2.0))
    assert body.scale == pytest.approx(757.5757 / 4 / 2.5 / (100 / 2.0), rel=1e-6)
    (seen,) = places.seen
    larger = seen.shape[2] - SMALL.camera.rows, seen.shape[3] - SMALL.camera.columns
    assert larger == (0, STEP), "40 by 12 of the frame's pixels are 62 by 20, with 32 pixels around them"


def test_options_and_cameras_are_kept_by_camera() -> None:
    labeller = FrameLabeller(Trained(Places(0, 10), {"network": "places"}), KEEP, mirrored=True, least_confidence=0.5)
    lens, labels_of = labeller.of(LENS)
    assert lens is None and labeller.of(LENS)[1] is labels_of
    assert (labels_of.mirrored, labels_of.least_confidence, labels_of.background) == (True, 0.5, KEEP)
    assert labels_of.rig == load_rig()
    assert repr(labeller).startswith("FrameLabeller(Trained(network='places', ")
    assert repr(labeller).endswith(", for rig paper)")


def test_frames_of_the_rigs_size_are_taken_for_its_cameras() -> None:
    shape = SMALL.camera.rows, SMALL.camera.columns
    camera = frame_camera(shape, "a frame", trained=SMALL)
    assert camera.origin == "assumed: rig small, which the network was trained for, by the frames' size"
    assert (camera.camera, camera.rig, camera.assumed) == (SMALL.camera, SMALL, True)
    paper = frame_camera((640, 329), "a frame", trained=load_rig())
    assert paper.origin == "assumed: the paper's rig, by the frames' size"
    assert frame_camera(shape, "a frame", focal_px=99.0, trained=SMALL).camera.focal_px == 99
    assert frame_camera((480, 640), "a frame", trained=SMALL).origin == "assumed: Kinect v1, by the frames' size"


def test_the_command_labels_frames_of_the_rig_that_the_run_is_of(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frame = np.zeros((160, 82), np.uint16)
    frame[20:140, 20:60] = 2500
    Image.fromarray(frame).save(tmp_path / "a.png")
    network = build("compact", {"patch": 8, "widths": [4], "blocks": [0]})
    sensor = {"name": "mine", "artifacts": []}
    save_network(tmp_path / "network.safetensors", network, "compact", {"rig": SMALL.to_json(), "sensor": sensor})
    words = ["segment", tmp_path / "a.png", "--run", tmp_path, "--background", "keep", "--out", tmp_path / "out"]
    assert cli.main(list(map(str, words))) == 0
    said = capsys.readouterr().err
    assert "camera assumed: rig small, which the network was trained for, by the frames' size: give --focal" in said
    facts = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert rig_from_json(facts["rig"]) == SMALL and facts["network"]["sensor"] == sensor
    assert facts["each"][0]["bodies"][0]["scale"] == pytest.approx(1)


@pytest.mark.parametrize(("steps", "told"), [(1700, True), (1800, False), (4000, False)])
def test_bodies_nearer_than_those_trained_on_are_told(
    steps: int, told: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        runtimes,
        "load_network",
        lambda run, dense=False: load_network(run) if run else Trained(Places(0, 10), {"rig": SMALL.to_json()}),
    )
    frame = np.zeros((160, 82), np.uint16)
    frame[20:140, 20:60] = steps
    Image.fromarray(frame).save(tmp_path / "a.png")
    words = ["segment", tmp_path / "a.png", "--background", "keep", "--out", tmp_path / "out"]
    assert cli.main(list(map(str, words))) == 0
    line = "bodies are 1.7 m away, the network was trained for 2.5 m (rig small): so near, labels are less accurate"
    assert (line in capsys.readouterr().err.splitlines()) == told


def test_a_network_of_another_rig_labels_frames_as_well_as_its_images(small_set: Path, tmp_path: Path) -> None:
    """Trained on figures that are a quarter as large as in the paper's images."""
    images = RangeImages(small_set, "none", "train")
    torch.manual_seed(3)
    network = build("compact", {"patch": 8, "widths": [32], "blocks": [1]})
    recipe = recipe_for(
        "compact",
        steps=40,
        batch_size=4,
        learning_rate=3e-2,
        mirror=False,
        bf16=False,  # several times slower on processors without instructions for it
        geometric_augmentation=GeometricAugmentation(),
    )
    alone = ProcessGroup(0, 1, torch.device("cpu"))
    run = Training(
        network, "compact", images, recipe, RunFolder(tmp_path / "run"), alone, run_options=RunOptions(30, 99, 0)
    )
    run.run(False, lambda metrics: None, {})
    card = load_network(tmp_path / "run").card
    scores = []
    for rig in (SMALL, load_rig()):
        _, labels_of = FrameLabeller(Trained(network.eval(), {**card, "rig": rig.to_json()}), KEEP).of(SMALL.camera)
        matrix = ConfusionMatrix()
        for index in range(0, len(images), 5):
            image = images[index]
            matrix.add(image["labels"].numpy(), labels_of(image["range"][0].numpy()).labels)
        scores.append(matrix.pixel_accuracy())
    own, papers = scores
    assert own > 0.4 and papers < own - 0.25
