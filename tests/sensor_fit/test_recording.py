"""Frames chosen and read, and bodies that stand still."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from known_sensors import recorded
from PIL import Image

from bodyseg_data.artifacts import Noise
from bodyseg_data.artifacts.lost_pixels import PatchLoss
from bodyseg_data.core import BadConfig, MissingLibrary
from bodyseg_model.recordings import Skipping, find_frames, frame_camera
from bodyseg_model.segmentation import Background
from bodyseg_model.sensor_fit import read_recording
from bodyseg_model.sensor_fit.recording import MarkedFrame, MarkedRecording, chosen_frames

CAMERA = frame_camera((60, 80), "a frame", focal_px=100.0).camera


def save(folder: Path, name: str, frame: np.ndarray) -> None:  # type: ignore[type-arg]
    Image.fromarray(frame.astype(np.uint16)).save(folder / f"{name}.png")


def test_long_recordings_are_thinned_to_fours() -> None:
    assert chosen_frames(3) == ([0, 1, 2], ((0, 1), (1, 2)))
    chosen, pairs = chosen_frames(1000, 12)
    assert len(chosen) == 12 and len(pairs) == 9 and chosen[0] == 0 and chosen[-1] == 999
    assert all(chosen[b] == chosen[a] + 1 for a, b in pairs)


@pytest.mark.usefixtures("near_is_person")
def test_bodies_are_found_by_a_limit_or_as_people(tmp_path: Path) -> None:
    frame = np.full((60, 80), 4000)
    frame[10:50, 30:42] = 1500
    save(tmp_path, "1", frame)
    files = find_frames([tmp_path])
    recording = read_recording(files, CAMERA, Background(), 2.0)
    (found,) = recording.frames
    np.testing.assert_array_equal(found.body, frame == 1500)
    np.testing.assert_array_equal(found.room, frame == 4000)
    (people,) = read_recording(files, CAMERA, Background(), None).frames
    np.testing.assert_array_equal(people.body, found.body)
    assert not recording.still


def test_frames_must_fit_and_show_a_body(tmp_path: Path) -> None:
    save(tmp_path, "1", np.full((60, 80), 3000))
    with pytest.raises(BadConfig, match="no frame shows a body: are --units, --near, --far or --nearer-than right"):
        read_recording(find_frames([tmp_path]), CAMERA, Background(), 2.0)
    save(tmp_path, "2", np.full((60, 81), 1000))
    first, second = find_frames([tmp_path])
    with pytest.raises(BadConfig, match="the size of the first, 60 x 80, found 60 x 81: .*2.png"):
        read_recording([first, second], CAMERA, Background(), 2.0)
    with pytest.raises(BadConfig, match="must have one unit, found 0.001 and 0.0001 m a step: .*2.png"):
        read_recording([first, replace(second, step_m=1e-4)], CAMERA, Background(), 2.0)


def test_frames_beside_one_that_is_skipped_are_no_neighbours(tmp_path: Path) -> None:
    for name in "1345":
        save(tmp_path, name, np.full((60, 80), 1000))
    (tmp_path / "2.png").write_bytes(b"no PNG")
    recording = read_recording(find_frames([tmp_path]), CAMERA, Background(), 2.0, Skipping(1))
    assert len(recording.frames) == 4 and recording.pairs == ((1, 2), (2, 3))


@pytest.mark.parametrize(
    ("frames", "expected"),
    [
        ("ABCD EFGH IJKL", "ABCD EFGH IJKL"),
        ("AACD EFGH", "ACEF"),  # the driver gave the first frame twice; D and G, H have nobody to be with
        ("BCD EFGH", "BCEF"),
        ("D EFGH", "EFGH"),
        ("AABB CCDD", "ABCD"),
        ("AAAA BBBB", ""),
    ],
)
def test_of_four_frames_two_and_two_are_neighbours_wherever_one_is_missing(frames: str, expected: str) -> None:
    shown = {name: np.full((2, 2), number, np.uint16) for number, name in enumerate("ABCDEFGHIJKL")}
    marked = tuple(
        MarkedFrame(shown[name], shown[name] / np.float32(1000), shown[name] > 0) for name in frames if name != " "
    )
    starts = [len(group) for group in frames.split()]
    pairs, first = [], 0
    for length in starts:
        pairs += [(at, at + 1) for at in range(first, first + length - 1)]
        first += length
    recording = MarkedRecording(marked, CAMERA, 0.001, tuple(pairs))
    found = [
        "".join(name for frame in four for name in shown if shown[name] is frame.stored) for four in recording.fours
    ]
    assert found == expected.split()


@pytest.mark.parametrize("package", ["scipy", "skimage"])
def test_without_its_libraries_the_extra_is_named(
    package: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save(tmp_path, "1", np.full((60, 80), 1000))
    monkeypatch.setitem(sys.modules, package, None)
    wanted = rf"bodyseg sensor fit needs the package '{package}': pip install 'bodyseg\[sensor\]'"
    with pytest.raises(MissingLibrary, match=wanted):
        read_recording(find_frames([tmp_path]), CAMERA, Background(), 2.0)


def test_a_body_is_still_whatever_is_lost_of_it() -> None:
    assert recorded(Noise(8.0, 8.0), PatchLoss(0.2, 0.2)).still
    assert not recorded(Noise(8.0, 8.0), moving=True).still
    assert not recorded(frames=1).still


def test_frames_of_fewer_rows_than_a_block_are_measured(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for name in "1234":
        save(tmp_path, name, 1000 + rng.integers(-2, 3, (24, 32)))
    camera = frame_camera((24, 32), "a frame", focal_px=30.0).camera
    assert read_recording(find_frames([tmp_path]), camera, Background(), 2.0).still
