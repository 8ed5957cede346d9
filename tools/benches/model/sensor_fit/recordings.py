"""Simulated recordings of bodies, with and without a wall behind, by a sensor whose artifacts are known."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts import Augmentation, SensorModel
from bodyseg_data.bodies import Body
from bodyseg_data.labels import BACKGROUND
from bodyseg_data.packing.sampler import faces_towards
from bodyseg_data.rendering import open_renderer
from bodyseg_data.rigs import Rig
from bodyseg_data.samples import Sample, SampleInfo, View, steps
from bodyseg_model.sensor_fit.recording import MarkedFrame, MarkedRecording

DISTANCE_CM: Final = 200
TURN_DEG: Final = 12
"""Turn of a moving body from frame to frame."""

BEHIND_M: Final = 1.0
"""From the body's middle to the wall."""

_BETWEEN_M: Final = 0.5  # everything nearer than the wall by this is the body


@dataclass(frozen=True)
class Scene:
    """A recording's scene. frames: how many; moving: whether the body turns; wall: whether a wall stands behind."""

    frames: int
    moving: bool = False
    wall: bool = False

    def __str__(self) -> str:
        return f"{self.frames} {'moving' if self.moving else 'still'}"


def in_steps(recording: MarkedRecording, step_mm: float) -> MarkedRecording:
    """The recording as files that hold whole multiples of a step have it."""
    step = step_mm / 1000 / recording.step_m
    frames = []
    for frame in recording.frames:
        stored = np.rint(np.rint(frame.stored / step) * step).astype(np.uint16)
        frames.append(replace(frame, stored=stored, range_m=stored * np.float32(recording.step_m)))
    return replace(recording, frames=tuple(frames))


class Scenes:
    """Clean samples of one body by one rig, rendered once a view."""

    def __init__(self, body: Body, rig: Rig) -> None:
        self._mesh, self._rig = body.mesh, rig
        self._renderer = open_renderer("raster", body.mesh)
        self._samples: dict[int, Sample] = {}

    def close(self) -> None:
        """Release the renderer."""
        self._renderer.close()

    def record(self, scene: Scene, sensor: SensorModel, rig: Rig | None = None) -> MarkedRecording:
        """A recording of a scene by a sensor; rig: one of the same camera, whose projector throws the shadow."""
        rig = rig or self._rig
        augmentation = Augmentation(rig, "all", 0, sensor)
        wall_m = DISTANCE_CM / 100 + BEHIND_M
        frames = []
        for number in range(scene.frames):
            azimuth = TURN_DEG * number if scene.moving else 0
            sample = self._sample(azimuth) if rig is self._rig else self._rendered(azimuth, rig)
            if scene.wall:
                sample = _before_wall(sample, wall_m, rig.range_step_m)
            stored = augmentation(sample, number).range
            range_m = stored.astype(np.float32) * np.float32(rig.range_step_m)
            body = (range_m > 0) & (range_m < wall_m - _BETWEEN_M)
            frames.append(MarkedFrame(stored, range_m, body))
        pairs = tuple((index, index + 1) for index in range(scene.frames - 1))
        return MarkedRecording(tuple(frames), rig.camera, rig.range_step_m, pairs)

    def _sample(self, azimuth: int) -> Sample:
        if azimuth not in self._samples:
            self._samples[azimuth] = self._rendered(azimuth, self._rig)
        return self._samples[azimuth]

    def _rendered(self, azimuth: int, rig: Rig) -> Sample:
        """A clean sample with all that the projector sees, also what shades nothing but a wall."""
        camera, projector = rig.placed(self._mesh.centre, View(DISTANCE_CM, azimuth))
        seen, lit = self._renderer.render(camera), self._renderer.render(projector)
        rows, columns = np.nonzero(seen.face >= 0)
        facing = np.zeros(seen.face.shape, np.bool_)
        points = camera.points(seen.range, rows, columns)
        facing[rows, columns] = faces_towards(self._mesh, seen.face[rows, columns], points, projector.position)
        labels = np.where(seen.face >= 0, 0, BACKGROUND).astype(np.uint8)
        key = f"{self._mesh.name}-a{azimuth:03d}"
        info = SampleInfo("test", {"distance_cm": DISTANCE_CM, "azimuth_deg": azimuth})
        return Sample(key, _steps(seen.range, rig, key), _steps(lit.range, rig, key), labels, facing, info)


def _steps(range_m: NDArray[np.floating], rig: Rig, key: str) -> NDArray[np.uint16]:
    stored = np.zeros(range_m.shape, np.uint16)
    known = range_m > 0
    stored[known] = steps(range_m[known], rig.range_step_m, key)
    return stored


def _before_wall(sample: Sample, wall_m: float, step_m: float) -> Sample:
    """The sample with a wall that faces the camera wherever there is no body."""
    empty = sample.range == 0
    ranges = np.where(empty, np.uint16(round(wall_m / step_m)), sample.range)
    labels = np.where(empty, np.uint8(0), sample.labels)
    return replace(sample, range=ranges, labels=labels, faces_projector=sample.faces_projector | empty)
