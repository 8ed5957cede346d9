"""Shadows beside bodies: side, width, baseline, and frames that show left for right."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from benches.model.sensor_fit.recordings import BEHIND_M
from known_sensors import CAMERA, RIG, fitted, flipped, recorded

from bodyseg_data.artifacts import MixedPixels, Occlusion
from bodyseg_data.rigs import load_rig
from bodyseg_model.recordings import FrameCamera, frame_camera
from bodyseg_model.sensor_fit import ShadowFrames
from bodyseg_model.sensor_fit.edges import measure_shadow, probably_mirrored, shadow_finding
from bodyseg_model.sensor_fit.finding import NEEDED, NOT_SEEN, UNKNOWN


def test_the_baseline_follows_from_the_width() -> None:
    shadow = measure_shadow(recorded(Occlusion(), wall=True))
    assert shadow is not None and shadow.side == "left", "a projector on the right leaves the left dark"
    assert shadow.baseline_m["left"].value == pytest.approx(RIG.baseline_m, rel=0.1)
    assert shadow.width_px["right"] == 0
    finding = shadow_finding(shadow, "right")
    assert finding.verdict == NEEDED and finding.reason.endswith("frames are not mirrored")
    assert finding.estimates["baseline_m"].value == pytest.approx(0.075, rel=0.1)
    assert shadow_finding(shadow, "right", RIG).reason == finding.reason
    wrong = replace(RIG, projector=replace(RIG.projector, position_m=(0.0075, 0.0, 0.0), aims_at_m=(0.0075, 0.0, 1.0)))
    assert shadow_finding(shadow, "right", wrong).reason == f"{finding.reason}; the rig's baseline is 0.0075 m"


@pytest.mark.parametrize("mixed", [0.0, 0.8])
def test_the_baseline_is_within_its_error_also_beside_mixed_pixels(mixed: float) -> None:
    mixed_pixels = MixedPixels(mixed, background_m=2.55 + BEHIND_M)
    shadow = measure_shadow(recorded(Occlusion(), mixed_pixels, wall=True, frames=6))
    assert shadow is not None
    found = shadow.baseline_m["left"]
    assert abs(found.value - RIG.baseline_m) < 3 * found.error < 0.02
    assert shadow.baseline_m["right"].error > 0.001, "a gap of no pixel is known to a pixel, no better"


def test_mirrored_frames_have_their_shadow_on_the_projectors_side() -> None:
    shadow = measure_shadow(flipped(recorded(Occlusion(), wall=True)))
    assert shadow is not None and shadow.side == "right"
    assert probably_mirrored(shadow, "right") is True and probably_mirrored(shadow, "left") is False
    assert probably_mirrored(shadow, None) is None
    assert shadow_finding(shadow, "right").reason.endswith("frames are probably mirrored")


def test_no_shadow_and_no_room() -> None:
    shadow = measure_shadow(recorded(wall=True))
    assert shadow is not None and shadow.side is None
    assert shadow_finding(shadow, "right").verdict == NOT_SEEN
    assert measure_shadow(recorded()) is None
    assert shadow_finding(None, "right").verdict == UNKNOWN and probably_mirrored(None, "right") is None


@pytest.mark.parametrize(("y", "verdict"), [(0.1, UNKNOWN), (-0.1, UNKNOWN), (0.0, NOT_SEEN)])
def test_shadows_above_or_below_bodies_are_not_said_to_be_absent(y: float, verdict: str) -> None:
    rig = replace(RIG, projector=replace(RIG.projector, position_m=(0.0, y, 0.0), aims_at_m=(0.0, y, 1.0)))
    finding = fitted(recorded(wall=True), FrameCamera(rig.camera, "known", rig=rig))["occlusion"]
    assert finding.verdict == verdict


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_few_frames_of_a_recording_tell(mirrored: bool) -> None:
    recording = recorded(Occlusion(), wall=True)
    recording = flipped(recording) if mirrored else recording
    frames = ShadowFrames(len(recording.frames), 2)
    for number, frame in enumerate(recording.frames):
        labelled: Any = SimpleNamespace(number=number, range_m=frame.range_m, persons=frame.body.astype(np.uint16))
        frames.add(labelled)
    assert frames.mirrored(CAMERA) is mirrored
    assert frames.mirrored(FrameCamera(RIG.camera, "given")) is None
    assert ShadowFrames(3, 2).mirrored(CAMERA) is None


def test_the_projectors_side_is_the_rigs() -> None:
    assert frame_camera((480, 640), "a frame").projector_side == "right"
    assert frame_camera((640, 329), "a frame", rig="paper").projector_side == "left"
    assert frame_camera((480, 640), "a frame", focal_px=500.0).projector_side is None


@pytest.mark.parametrize(("x", "side"), [(-0.3, "left"), (0.5, None)])
def test_two_projectors_have_a_side_only_if_they_share_it(x: float, side: str | None) -> None:
    rig = load_rig()
    two = replace(rig, second_projector=replace(rig.projector, position_m=(x, 0.0, 0.0)))
    assert FrameCamera(rig.camera, "known", rig=two).projector_side == side
