"""The whole measurement: verdicts on clean frames, on too few, on a known sensor and on real frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from known_sensors import CAMERA, by_artifact, fitted, recorded

from bodyseg_data.artifacts import MissingData, MixedPixels, Noise, Occlusion
from bodyseg_data.artifacts.lost_pixels import PatchLoss
from bodyseg_data.artifacts.sensor_model import parse_sensor_model
from bodyseg_model.recordings import find_frames, frame_camera
from bodyseg_model.segmentation import Background
from bodyseg_model.sensor_fit import fit_sensor, read_recording
from bodyseg_model.sensor_fit.finding import NEEDED, NOT_SEEN, UNKNOWN
from bodyseg_model.sensor_fit.fit import ORDER


@pytest.mark.parametrize("moving", [False, True])
def test_clean_frames_need_no_artifact(moving: bool) -> None:
    fit = fit_sensor(recorded(moving=moving, wall=True), CAMERA)
    assert tuple(finding.artifact for finding in fit.findings) == ORDER
    assert [finding.artifact for finding in fit.findings if finding.verdict == NEEDED] == []
    verdicts = {finding.artifact: finding.verdict for finding in fit.findings}
    assert verdicts.pop("patch_loss") == (UNKNOWN if moving else NOT_SEEN)
    assert set(verdicts.values()) == {NOT_SEEN}
    assert fit.still is not moving and fit.mirrored is None and len(fit.model("clean")) == 0


def test_too_little_data_tells_nothing() -> None:
    recording = recorded(frames=1)
    (frame,) = recording.frames
    small = np.zeros(frame.body.shape, np.bool_)
    rows, columns = np.nonzero(frame.body)
    small[rows[300] : rows[300] + 20, columns[300] : columns[300] + 20] = True
    small &= frame.body
    few = replace(frame, stored=frame.stored * small, range_m=frame.range_m * small, body=small)
    found = fitted(replace(recording, frames=(few,)))
    assert {finding.verdict for finding in found.values()} == {UNKNOWN}
    assert all(finding.reason and not finding.strengths for finding in found.values())


def test_a_known_sensor_comes_back_as_a_file_that_can_be_read() -> None:
    known = (Occlusion(), Noise(4.0, 4.0), MixedPixels(0.5), PatchLoss(0.1, 0.1), MissingData((0.05,)))
    seen: list[tuple[int, int]] = []
    fit = fit_sensor(recorded(*known, frames=5, wall=True), CAMERA, lambda *numbers: seen.append(numbers))
    assert seen[0] == (0, 3) and seen[-1] == (3, 3)
    found = by_artifact(fit)
    needed = [finding.artifact for finding in fit.findings if finding.verdict == NEEDED]
    assert needed == ["occlusion", "noise", "mixed_pixels", "patch_loss", "missing_data"]
    assert found["occlusion"].estimates["baseline_right_m"].value < 0.01
    assert found["occlusion"].estimates["baseline_left_m"].value == pytest.approx(0.075, rel=0.15)
    assert found["mixed_pixels"].strengths["share"] == pytest.approx(0.5, rel=0.2)
    assert found["missing_data"].strengths["rates"][0] == pytest.approx(0.05, rel=0.1)
    assert found["noise"].strengths["low_mm"] == pytest.approx(4.0, rel=0.1)
    assert fit.mirrored is False and "mirrored" not in fit.comments()[""]
    model = fit.model("mine", "My sensor")
    text = model.to_toml(fit.comments())
    assert parse_sensor_model(text, "text") == model and "# needed: " in text and "# stripe_loss: " in text
    assert max(map(len, text.splitlines())) <= 112
    tree = fit.to_json()
    assert tree["frames"] == 5 and tree["still"] and tree["mirrored"] is False
    assert tree["findings"][0]["artifact"] == "occlusion" and tree["findings"][0]["verdict"] == NEEDED


def test_real_frames_of_a_kinect_are_mirrored(shared_data: Callable[[str], Path]) -> None:
    files = find_frames([shared_data("real/kinect_v1")])[:4]
    camera = frame_camera((480, 640), "a frame")
    fit = fit_sensor(read_recording(files, camera.camera, Background(), 1.2), camera)
    found = by_artifact(fit)
    assert fit.mirrored and "probably mirrored" in found["occlusion"].reason
    assert found["occlusion"].estimates["baseline_right_m"].value == pytest.approx(0.057, rel=0.1)
    assert found["occlusion"].estimates["baseline_left_m"].value == pytest.approx(0.021, rel=0.1)
    assert 0.4 < found["noise"].estimates["sigma_mm"].value < 1 and found["mixed_pixels"].verdict != NEEDED
    assert "probably mirrored" in fit.comments()[""]
