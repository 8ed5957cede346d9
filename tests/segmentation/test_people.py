"""People in real rooms, as the finder and the network that ship find and label them."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from bodyseg_data.core import BadConfig
from bodyseg_model.commands import cli
from bodyseg_model.networks import load_network
from bodyseg_model.segmentation.segmenter import least_confidence_of_people

pytestmark = pytest.mark.usefixtures("one_thread", "prepared")


def run(*words: str | Path) -> None:
    assert cli.main(["segment", *map(str, words), "--device", "cpu", "--threads", "1", "--no-overlay"]) == 0


def each(out: Path) -> list[dict[str, Any]]:
    frames: list[dict[str, Any]] = json.loads((out / "summary.json").read_text())["each"]
    return frames


@pytest.mark.parametrize(
    ("sequence", "names", "least_pixels"),
    [
        ("kinect_v1", ["0000000000_depth.png", "0000000019_depth.png"], 40000),
        ("kinect_v2", ["01.png", "03.png"], 19000),
    ],
)
def test_real_frames_have_one_person_each(
    sequence: str, names: list[str], least_pixels: int, tmp_path: Path, shared_data: Callable[[str], Path]
) -> None:
    files = [shared_data(f"real/{sequence}") / name for name in names]
    run(*files, "--out", tmp_path / "out")
    for frame in each(tmp_path / "out"):
        assert frame["people"] == 1 and frame["pixels"] > least_pixels
        assert frame["bodies"][0]["range_m"] < 2, "not the wall"


@pytest.mark.parametrize("apart", [4, 8])  # so that 2 or 1 of the sensor's pixels make a cell of the finder
def test_people_are_found_in_frames_of_few_pixels(
    apart: int, tmp_path: Path, shared_data: Callable[[str], Path]
) -> None:
    (frames := tmp_path / "frames").mkdir()
    for number in (28, 40, 44):
        with Image.open(shared_data("real/kinect_v1_room") / f"{number:03d}_depth.png") as picture:
            Image.fromarray(np.asarray(picture)[::apart, ::apart].astype(np.uint16)).save(frames / f"{number}.png")
    run(frames, "--focal", str(525 / apart), "--out", tmp_path / "out")
    for number, frame in zip((28, 40, 44), each(tmp_path / "out"), strict=True):
        with Image.open(shared_data("real/kinect_v1_room") / f"{number:03d}_person.png") as picture:
            man = np.count_nonzero(np.asarray(picture)[::apart, ::apart])
        assert 0.7 * man < frame["pixels"] < 1.4 * man


def test_mirrored_frames_are_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], shared_data: Callable[[str], Path]
) -> None:
    file = shared_data("real/kinect_v1") / "0000000000_depth.png"
    run(file, "--out", tmp_path / "out")
    warning = "the projector's shadows lie on the right side of bodies, so frames are probably mirrored"
    assert f"{warning}: give --mirrored" in capsys.readouterr().err.splitlines()
    run(file, "--mirrored", "--out", tmp_path / "out")
    assert "probably" not in capsys.readouterr().err
    with Image.open(file) as picture:
        Image.fromarray(np.asarray(picture)[:, ::-1].astype(np.uint16)).save(tmp_path / "turned.png")
    run(tmp_path / "turned.png", "--mirrored", "--out", tmp_path / "turned")
    assert "probably not mirrored: leave out --mirrored" in capsys.readouterr().err


def test_an_empty_room_shows_nobody(tmp_path: Path) -> None:
    wall = np.full((480, 640), 4000, np.uint16)
    floor = np.rint(1000 * 1.1 * 525 / np.arange(1, 241)).clip(0, 4000).astype(np.uint16)
    wall[240:] = floor[:, None]
    for number, frame in enumerate((wall, np.full_like(wall, 2000))):
        Image.fromarray(frame).save(tmp_path / f"{number}.png")
    run(tmp_path / "0.png", tmp_path / "1.png", "--out", tmp_path / "out")
    assert [frame["people"] for frame in each(tmp_path / "out")] == [0, 0]


def test_the_limit_belongs_to_a_networks_card() -> None:
    assert 0.1 < least_confidence_of_people(load_network().card) < 0.5
    assert least_confidence_of_people({}) == 0
    for bad in (2, "high", True, float("nan")):
        with pytest.raises(BadConfig, match="^a network's card: least_confidence_of_people must be a number from 0 to"):
            least_confidence_of_people({"least_confidence_of_people": bad})
