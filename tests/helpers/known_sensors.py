"""Recordings of the plain figure by sensors with known artifacts, on a narrow Kinect v1's rig with steps of 0.1 mm."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Final

import numpy as np
from benches.model.sensor_fit.recordings import Scene, Scenes
from fakes import Figures

from bodyseg_data.artifacts import Artifact, SensorModel
from bodyseg_data.rigs import Rig, load_rig
from bodyseg_model.recordings import FrameCamera
from bodyseg_model.sensor_fit import fit_sensor
from bodyseg_model.sensor_fit.finding import Finding
from bodyseg_model.sensor_fit.fit import SensorFit
from bodyseg_model.sensor_fit.recording import MarkedRecording


def _narrow_rig() -> Rig:
    """The rig of a Kinect v1 whose camera has the middle 224 columns alone: a body at 2 m covers 170 of them."""
    rig = load_rig("kinect_v1")
    return replace(rig, range_step_mm=0.1, camera=replace(rig.camera, columns=224, centre_px=(112.0, 240.0)))


RIG: Final = _narrow_rig()
CAMERA: Final = FrameCamera(RIG.camera, "known", rig=RIG)


@cache
def _scenes() -> Scenes:
    source = Figures()
    return Scenes(source.build(next(iter(source.bodies()))), RIG)


@cache
def recorded(*artifacts: Artifact, frames: int = 4, moving: bool = False, wall: bool = False) -> MarkedRecording:
    """A recording of the figure with these artifacts, made once."""
    return _scenes().record(Scene(frames, moving, wall), SensorModel("known", artifacts))


def fitted(recording: MarkedRecording, camera: FrameCamera = CAMERA) -> dict[str, Finding]:
    """All findings by artifact."""
    return by_artifact(fit_sensor(recording, camera))


def by_artifact(fit: SensorFit) -> dict[str, Finding]:
    """The findings of a fit by artifact."""
    return {finding.artifact: finding for finding in fit.findings}


def flipped(recording: MarkedRecording) -> MarkedRecording:
    """The recording with left and right exchanged."""
    frames = tuple(
        replace(
            frame,
            stored=np.ascontiguousarray(frame.stored[:, ::-1]),
            range_m=np.ascontiguousarray(frame.range_m[:, ::-1]),
            body=np.ascontiguousarray(frame.body[:, ::-1]),
        )
        for frame in recording.frames
    )
    return replace(recording, frames=frames)
