"""Frames as they come, from iterables and from cameras whose packages fakes stand in for."""

from __future__ import annotations

import runpy
import sys
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_cameras import FakeOrbbec, FakeRealSense
from folders import DOCS
from pngs import RAMP

from bodyseg_data.core import BadConfig
from bodyseg_model.recordings import LiveRecording, open_recording, to_metres

CAMERAS = runpy.run_path(str(DOCS / "examples" / "live_cameras.py"))
realsense, orbbec = CAMERAS["realsense"], CAMERAS["orbbec"]


def test_any_iterable_is_a_recording_and_is_read_as_it_comes() -> None:
    asked = []

    def arrays() -> Iterator[Any]:
        for number in range(1000):
            asked.append(number)
            yield (number / 10, RAMP) if number % 2 else RAMP / 1000

    recording = LiveRecording(arrays(), step_m=0.002)
    first, second = islice(recording, 2)
    assert asked == [0, 1] and (first.time_s, second.time_s) == (None, 0.1)
    assert (first.name, second.where) == ("live-000000", "live-000001") and first.stamp() is None
    np.testing.assert_array_equal(second.read(), RAMP)
    assert second.step_m == 0.002 and second.sequence == 0
    ranges = to_metres(first.read(), first.step_m)
    np.testing.assert_allclose(ranges[RAMP < 16_000], RAMP[RAMP < 16_000] / 1000, atol=1.3e-4)
    with pytest.raises(BadConfig, match="live-000000: a frame must have rows and columns"):
        next(iter(LiveRecording([np.zeros(3, np.uint16)]))).read()
    with pytest.raises(
        BadConfig, match="must be of whole numbers, steps, or of floating point, metres, found complex128"
    ):
        next(iter(LiveRecording([np.zeros((3, 3), complex)]))).read()
    wrong: Any
    for wrong in ([0.5, RAMP], (0.5, 1, RAMP), (RAMP, RAMP // 2), ("12:00", RAMP)):
        with pytest.raises(BadConfig, match=r"^live-000000 must be an array or a tuple \(seconds, array\): "):
            next(iter(LiveRecording([wrong])))


def test_pictures_are_no_ranges() -> None:
    """In millimetres they would end 0.255 m away, and nobody be found in them."""
    picture = np.full((4, 5), 200, np.uint8)
    with pytest.raises(BadConfig, match="^live-000000: of 8 bits, most images are pictures: step_m must say"):
        next(iter(LiveRecording([picture])))
    (frame,) = LiveRecording([picture], step_m=0.02)
    np.testing.assert_array_equal(frame.read() * frame.step_m, 4.0)


@pytest.mark.parametrize("step_m", [0, -0.001, float("nan"), float("inf")])
def test_a_step_is_above_nothing(step_m: float, tmp_path: Path) -> None:
    """Frames would be empty, or not a number, and nobody be found in them."""
    np.save(tmp_path / "a.npy", RAMP[np.newaxis])
    for opened in (
        lambda: LiveRecording([RAMP], step_m=step_m),
        lambda: open_recording(tmp_path / "a.npy", None, step_m),
    ):
        with pytest.raises(BadConfig, match="step_m must be above 0, found "):
            opened()


def test_frames_stay_what_they_were_where_a_driver_fills_one_array_again() -> None:
    held = np.zeros_like(RAMP)

    def live() -> Iterator[Any]:
        for number in (1, 2):
            held[:] = number
            yield np.ma.masked_array(held, RAMP > 9)

    for number, frame in enumerate(list(LiveRecording(live())), 1):
        np.testing.assert_array_equal(frame.read(), np.where(RAMP > 9, 0, number))


def test_a_realsense_camera_is_a_recording(monkeypatch: pytest.MonkeyPatch) -> None:
    fake = FakeRealSense(coeffs=(0.1, 0.2, 0.3, 0.4, 0.5))
    monkeypatch.setitem(sys.modules, "pyrealsense2", fake)
    with realsense(60, 84, 15) as recording:
        assert fake.running and fake.asked == [("depth", 84, 60, "z16", 15)]
        frames = iter(recording)
        for time_s in (1.0, 2.0):
            frame = next(frames)
            assert frame.time_s == time_s and frame.step_m == 0.00025
            np.testing.assert_array_equal(frame.read(), RAMP)
        assert frame.camera is not None and frame.camera.size == (60, 84) and frame.camera.distortion is not None
        assert (frame.camera.cx, frame.camera.distortion.p1, frame.camera.distortion.k3) == (41.5, 0.3, 0.5)
        with pytest.raises(BadConfig, match="the RealSense camera has stopped: Frame didn't arrive"):
            next(frames)
    assert not fake.running


def test_an_orbbec_camera_is_a_recording(monkeypatch: pytest.MonkeyPatch) -> None:
    fake = FakeOrbbec()
    monkeypatch.setitem(sys.modules, "pyorbbecsdk", fake)
    with orbbec() as recording:
        frames = iter(recording)
        for _ in range(3):
            frame = next(frames)
            assert frame.time_s == 2.0 and frame.step_m == 0.0005
            np.testing.assert_array_equal(frame.read(), RAMP)
        assert frame.camera is not None and frame.camera.distortion is not None
        assert (frame.camera.fy, frame.camera.distortion.p2, frame.camera.distortion.k3) == (100.5, 0.02, 0.3)
        with pytest.raises(BadConfig, match="the Orbbec camera has stopped"):
            next(frames)
    assert not fake.running


def test_cameras_that_cannot_be_used_are_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    for fake, message in (
        (FakeRealSense(starts=False), "the RealSense camera does not start: No device connected"),
        (FakeRealSense(coeffs=(0.1, 0, 0, 0, 0), model="f-theta"), "must be Brown-Conrady's, found f-theta"),
    ):
        monkeypatch.setitem(sys.modules, "pyrealsense2", fake)
        with pytest.raises(BadConfig, match=message), realsense():
            pass
        assert not fake.running
    for other, message in (
        (FakeOrbbec(starts=False), "the Orbbec camera does not start: no device"),
        (FakeOrbbec(k4=-50.0), "five coefficients must follow the lens"),
    ):
        monkeypatch.setitem(sys.modules, "pyorbbecsdk", other)
        with pytest.raises(BadConfig, match=message), orbbec():
            pass
        assert not other.running
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    with pytest.raises(BadConfig, match="this camera needs the package 'pyrealsense2': pip install"), realsense():
        pass
    monkeypatch.setitem(sys.modules, "pyorbbecsdk", None)
    with pytest.raises(BadConfig, match="pip install pyorbbecsdk2"), orbbec():
        pass
