"""Depth tracks of Matroska files, as Azure Kinect's recorder and ffmpeg write them."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

import av
import numpy as np
import pytest
from damaged_recordings import reads_or_refuses
from kinect_mkv import calibration, write_mkv
from pngs import RAMP

from bodyseg_data.core import BadConfig, MissingLibrary
from bodyseg_model.recordings.formats.matroska import depth_camera
from bodyseg_model.recordings.frames import open_recording

STACK = np.stack([RAMP + number for number in range(20)])
LENS = [0.51, 0.52, 0.49, 0.491, 0.55, -0.02, -0.003, 0.89, 0.086, -0.014, 0, 0, -7e-5, 2e-5]
"""Values of an Azure Kinect's size: cx, cy, fx, fy, k1 to k6, two unused, p2, p1."""


def refusal(path: Path, topic: str | None = None) -> str:
    with pytest.raises(BadConfig) as caught:
        open_recording(path, topic)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_the_depth_track_is_read_without_loss(tmp_path: Path) -> None:
    path = write_mkv(tmp_path / "a.mkv", {"IR": STACK // 3, "DEPTH": STACK})
    recording = open_recording(path)
    assert len(recording) == 20 and recording[0].camera is None and recording[0].step_m == 1e-3
    assert [frame.time_s for frame in recording][:3] == pytest.approx([0, 0.033, 0.067])
    for number in (0, 1, 2, 17, 3, 19, 0):
        np.testing.assert_array_equal(recording[number].read(), STACK[number])
    np.testing.assert_array_equal(open_recording(path, "IR")[4].read(), STACK[4] // 3)
    assert "--topic must be a track of 16-bit grey, found IR, DEPTH" in refusal(path, "COLOR")
    two = write_mkv(tmp_path / "b.mkv", {"a": STACK, "b": STACK})
    assert "one track must be 16-bit grey, or --topic one of, found a, b" in refusal(two)


def test_frames_that_need_others_are_read_in_any_order(tmp_path: Path) -> None:
    """FFV1 with one frame in ten that stands alone, in slices, which decoders share over threads; also by a fork."""
    path = tmp_path / "a.mkv"
    with av.open(str(path), "w", format="matroska") as container:
        track = container.add_stream("ffv1", rate=30, options={"g": "10", "level": "3", "slices": "4"})
        track.height, track.width, track.pix_fmt = *RAMP.shape, "gray16le"
        for values in STACK:
            container.mux(track.encode(av.VideoFrame.from_ndarray(values, format="gray16le")))
        container.mux(track.encode(None))
    recording = open_recording(path)
    for number in (0, 1, 15, 16, 3, 17):
        np.testing.assert_array_equal(recording[number].read(), STACK[number])
    child = os.fork()
    if not child:
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(20)  # ends a hang
        os._exit(0 if np.array_equal(recording[18].read(), STACK[18]) else 1)
    assert os.waitpid(child, 0)[1] == 0


def test_the_calibration_is_that_of_the_mode(tmp_path: Path) -> None:
    frames = np.zeros((1, 576, 640), np.uint16)
    camera = open_recording(write_mkv(tmp_path / "a.mkv", {"DEPTH": frames}, calibration(LENS)))[0].camera
    assert camera is not None and camera.size == (576, 640) and camera.distortion is not None
    assert (camera.fx, camera.fy) == pytest.approx((0.49 * 1024, 0.491 * 1024))
    assert (camera.cx, camera.cy) == pytest.approx((0.51 * 1024 - 192.5, 0.52 * 1024 - 180.5))
    x, y = np.meshgrid(np.linspace(-0.65, 0.6, 9), np.linspace(-0.6, 0.55, 9))
    squared = x * x + y * y
    _, _, _, _, k1, k2, k3, k4, k5, k6, _, _, p2, p1 = LENS
    factor = (1 + k1 * squared + k2 * squared**2 + k3 * squared**3) / (
        1 + k4 * squared + k5 * squared**2 + k6 * squared**3
    )
    across, down = camera.distortion.apply(x, y)
    assert np.abs(across - x * factor - 2 * p1 * x * y - p2 * (squared + 2 * x * x)).max() * camera.fx < 0.5
    assert np.abs(down - y * factor - p1 * (squared + 2 * y * y) - 2 * p2 * x * y).max() * camera.fx < 0.5
    small = depth_camera(calibration(LENS), (288, 320), "x")
    assert small is not None and (small.fx, small.cx) == pytest.approx((0.49 * 512, 0.51 * 512 - 96.5))


@pytest.mark.parametrize(
    ("data", "shape"),
    [
        (calibration(LENS), (512, 512)),  # the five coefficients do not reach to the corners
        (calibration(LENS), (60, 84)),
        (calibration(LENS, "CALIBRATION_CameraLocationPV0"), (576, 640)),
        (calibration(LENS[:9]), (576, 640)),
        (calibration([float("nan"), *LENS[1:]]), (576, 640)),
        (calibration([*LENS[:2], -1, *LENS[3:]]), (576, 640)),
        (calibration([*LENS[:3], 0.6, *LENS[4:]]), (576, 640)),  # pixels that are not square
        (b"{", (576, 640)),
        (b"[]", (576, 640)),
    ],
)
def test_a_calibration_of_no_use_is_none(data: bytes, shape: tuple[int, int]) -> None:
    assert depth_camera(data, shape, "x") is None


def test_damaged_and_other_files_are_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_mkv(tmp_path / "a.mkv", {"DEPTH": STACK})
    whole = path.read_bytes()
    frames = open_recording(path)
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(BadConfig, match="the frame cannot be decoded"):
        frames[15].read()
    assert len(open_recording(path)) in (9, 10), "a recording that was cut off has the frames before"
    for size in (20, 200):
        path.write_bytes(whole[:size])
        refusal(path)
    path.write_bytes(b"no film")
    assert "must be a Matroska file" in refusal(path)
    random = np.random.default_rng(3)
    for _ in range(20):
        data = bytearray(whole)
        for place in random.integers(0, 600, 3):
            data[place] = random.integers(0, 256)
        reads_or_refuses(path, bytes(data))
    wide = write_mkv(tmp_path / "d.mkv", {"DEPTH": np.zeros((1, 2, 5000), np.uint16)})
    assert "a frame's side must be 1 to 4096 pixels, found 2 x 5000" in refusal(wide)
    colour = write_mkv(tmp_path / "c.mkv", {"COLOR": STACK}, codec=b"YUY2")
    assert "one track must be 16-bit grey, or --topic one of, found COLOR" in refusal(colour)
    unknown = write_mkv(tmp_path / "u.mkv", {"DEPTH": STACK}, codec=b"\0\1\2\3")
    assert "one track must be 16-bit grey, or --topic one of, found DEPTH" in refusal(unknown)
    path.write_bytes(whole)
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(MissingLibrary, match=r"needs the package 'av': pip install 'bodyseg\[recordings\]'"):
        open_recording(path)
