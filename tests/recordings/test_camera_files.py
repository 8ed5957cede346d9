"""Cameras in files beside frames."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pngs import png

from bodyseg_data.core import BadConfig
from bodyseg_data.rigs import Camera, Distortion, Rig
from bodyseg_model.recordings import Skipping, find_frames, frame_camera
from bodyseg_model.recordings.camera_files import FrameCameras, cameras_beside
from bodyseg_model.recordings.cameras import Intrinsics

PLAIN = {"fx": 50.0, "fy": 50.0, "cx": 19.5, "cy": 14.5}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three frames of 30 x 40 pixels."""
    home = tmp_path / "recording"
    home.mkdir()
    for number in (1, 2, 3):
        (home / f"{number}.png").write_bytes(png(np.full((30, 40), 1000, np.uint16)))
    return home


def write(path: Path, tree: Any) -> None:
    path.write_text(json.dumps(tree))


def focal_lengths(path: Path) -> list[float | None]:
    return [None if each is None else each.fx for each in cameras_beside(find_frames([path]))]


def refusal(path: Path) -> str:
    with pytest.raises(BadConfig) as caught:
        cameras_beside(find_frames([path]))
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_opencvs_terms_become_a_camera(folder: Path) -> None:
    given = {"fx": 50.0, "fy": 50.2, "cx": 19.0, "cy": 14.0, "distortion": [0.1, -0.2, 0.01, 0.02, 0.03]}
    write(folder / "2.json", {**given, "width": 40, "height": 30})
    none, found, other = cameras_beside(find_frames([folder]))
    assert none is None and other is None and found is not None
    camera = found.frame_camera((30, 40))
    pose = (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)
    lens = Distortion(k1=0.1, k2=-0.2, p1=0.01, p2=0.02, k3=0.03)
    assert camera.camera == Camera(30, 40, math.sqrt(50 * 50.2), (19.5, 14.5), *pose, distortion=lens)
    assert (camera.origin, camera.assumed) == (f"file {folder / '2.json'}", False)
    with pytest.raises(BadConfig, match="must have 30 x 40 pixels, found 30 x 41"):
        found.frame_camera((30, 41))


def test_four_coefficients_lack_the_last_and_zeros_are_no_lens(folder: Path) -> None:
    write(folder / "1.json", {**PLAIN, "distortion": [0.1, 0, 0, 0]})
    write(folder / "2.json", {**PLAIN, "distortion": [0, 0, 0, 0, 0]})
    first, second, _ = cameras_beside(find_frames([folder]))
    assert first is not None and first.distortion == Distortion(k1=0.1)
    assert second is not None and second.distortion is None


def test_a_frames_own_file_comes_before_its_entry_and_that_before_the_default(folder: Path) -> None:
    assert focal_lengths(folder) == [None, None, None]
    write(folder / "cameras.json", {"default": PLAIN})
    assert focal_lengths(folder) == [50, 50, 50]
    assert focal_lengths(folder / "3.png") == [50]
    named = {"1": PLAIN | {"fx": 60.0, "fy": 60.0}, "2.png": PLAIN | {"fx": 70.0, "fy": 70.0}}
    write(folder / "cameras.json", {"default": PLAIN, "frames": named})
    assert focal_lengths(folder) == [60, 70, 50]
    write(folder / "cameras.json", {"frames": named})
    write(folder / "1.json", PLAIN | {"fx": 80.0, "fy": 80.0})
    assert focal_lengths(folder) == [80, 70, None]


def test_entries_may_have_the_suffixes_of_other_files(tmp_path: Path) -> None:
    for name in ("a.npy", "b.npy", "c.npy"):
        np.save(tmp_path / name, np.full((30, 40), 1000, np.uint16))
    named = {"a": PLAIN | {"fx": 51.0}, "b.npy": PLAIN | {"fx": 52.0}, "c.png": PLAIN | {"fx": 53.0}}
    write(tmp_path / "cameras.json", {"default": PLAIN, "frames": named})
    assert focal_lengths(tmp_path) == [51, 52, 50], "c.png is another file"


def test_other_files_of_a_frames_name_are_no_cameras(folder: Path) -> None:
    write(folder / "1.json", {"subject": "A", "time": 3})
    assert focal_lengths(folder) == [None, None, None]


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("1.json", "{", "1.json is not JSON"),
        ("1.json", "[1]", "1.json must hold a JSON object, found list"),
        ("1.json", json.dumps({"fx": 50.0}), "1.json: number 'fy' is missing"),
        ("1.json", json.dumps(PLAIN | {"cx": "middle"}), "1.json: 'cx' must be a finite number"),
        ("1.json", json.dumps(PLAIN | {"fy": 60.0}), "above 0, and pixels square, found 'fx' 50 and 'fy' 60"),
        ("1.json", json.dumps(PLAIN | {"skew": 1}), "1.json: unknown 'skew'"),
        ("1.json", json.dumps(PLAIN | {"width": 40}), "1.json: number 'height' is missing"),
        ("1.json", json.dumps(PLAIN | {"distortion": [1, 2]}), "1.json: 'distortion' must be 5 finite numbers"),
        (
            "1.json",
            json.dumps(PLAIN | {"distortion": [1e7] * 5}),
            "1.json: Distortion: k1 must be from",
        ),
        ("cameras.json", json.dumps(PLAIN), "cameras.json must hold 'frames'"),
        ("cameras.json", "{}", "cameras.json must hold 'frames'"),
        ("cameras.json", json.dumps({"frames": [PLAIN]}), "cameras.json must hold 'frames'"),
        ("cameras.json", json.dumps({"frames": {"9": {"fx": 1}}}), "cameras.json, 9: number 'fy' is missing"),
        ("cameras.json", json.dumps({"default": 3}), "cameras.json, default must be a camera with fx, fy, cx and cy"),
        ("cameras.json", " " * (1 << 24) + "{}", "cameras.json is larger than 16777216 bytes"),
    ],
)
def test_files_that_are_no_cameras_are_named(name: str, content: str, message: str, folder: Path) -> None:
    (folder / name).write_text(content)
    said = refusal(folder)
    assert message in said and str(folder / name) in said


def test_a_file_that_cannot_be_read_is_named(folder: Path) -> None:
    (folder / "cameras.json").mkdir()
    assert refusal(folder) == f"cannot read {folder / 'cameras.json'}: Is a directory"


def test_a_frame_must_fit_its_camera(folder: Path) -> None:
    intrinsics = Intrinsics(50.0, 50.0, 20.0, 15.0, None, (30, 41), "a.json")
    with pytest.raises(BadConfig, match=r"^a\.json: the frame must have 30 x 41 pixels, found 30 x 40$"):
        intrinsics.frame_camera((30, 40))
    with pytest.raises(BadConfig, match=r"^a\.json: lens distortion must not fold the image over"):
        Intrinsics(50.0, 50.0, 20.0, 15.0, Distortion(k1=-9.0), None, "a.json").frame_camera((30, 40))
    with pytest.raises(BadConfig, match=r"^a\.json: Camera: focal_px must be above 0 and at most"):
        Intrinsics(1e7, 1e7, 20.0, 15.0, None, None, "a.json").frame_camera((30, 40))


def chosen(folder: Path) -> FrameCameras:
    """A network was trained for frames of this size, as no sensor has them."""
    camera = frame_camera((30, 40), "", focal_px=99.0).camera
    return FrameCameras(find_frames([folder]), None, None, (), Rig("frame", 1.0, camera, camera), Skipping())


def test_frames_without_a_camera_of_their_own_share_one(folder: Path) -> None:
    write(folder / "1.json", PLAIN | {"distortion": [0.1, 0, 0, 0]})
    frames = find_frames([folder])
    cameras = chosen(folder)
    assert [cameras.of(frame, (30, 40)).camera.focal_px for frame in frames] == [50, 99, 99]
    assert [cameras.of(frame, (30, 40)) is cameras.common for frame in frames] == [False, True, True]
    assert cameras.first.camera.focal_px == 50 and cameras.bent
    assert (cameras.to_json()["focal_px"], cameras.to_json()["frames_with_their_own"]) == (99, 1)


@pytest.mark.parametrize("given", [(None, 60.0, ()), (None, 60.0, (21.0, 16.0))])
def test_a_camera_that_is_given_comes_before_files(folder: Path, given: Any) -> None:
    write(folder / "cameras.json", {"default": PLAIN | {"distortion": [0.1, 0, 0, 0]}})
    camera = frame_camera((30, 40), "", focal_px=99.0).camera
    cameras = FrameCameras(find_frames([folder]), *given, Rig("frame", 1.0, camera, camera), Skipping())
    found = cameras.of(find_frames([folder])[1], (30, 40)).camera
    assert (found.focal_px, found.centre_px) == (60, given[2] or (20, 15)) and not cameras.bent
    assert "frames_with_their_own" not in cameras.to_json()


def test_the_lens_of_a_rig_is_that_of_all_frames_without_their_own(folder: Path) -> None:
    rig = folder.parent / "bent.toml"
    rig.write_text(
        'format = "bodyseg rig 1"\nname = "bent"\n[camera]\nrows = 30\ncolumns = 40\nfocal_px = 50.0\n'
        'centre_px = [20.0, 15.0]\n[camera.distortion]\nmodel = "brown_conrady"\nk1 = 0.1\n'
    )
    camera = frame_camera((30, 40), "", focal_px=99.0).camera
    cameras = FrameCameras(find_frames([folder]), str(rig), None, (), Rig("frame", 1.0, camera, camera), Skipping())
    assert cameras.bent and cameras.first.camera.distortion == Distortion(k1=0.1)


def test_nothing_is_chosen_where_every_frame_has_its_own(folder: Path) -> None:
    write(folder / "cameras.json", {"default": PLAIN})
    cameras = chosen(folder)
    assert cameras.common is None and not cameras.bent
    assert cameras.to_json() == {**cameras.first.to_json(), "frames_with_their_own": 3}
    write(folder / "cameras.json", {"default": PLAIN, "frames": {"2": {**PLAIN, "cx": 18.0}}})
    assert chosen(folder).to_json() == {"origin": "each frame's own", "frames_with_their_own": 3}
