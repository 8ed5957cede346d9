"""The picture of a frame beside its simulation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from known_sensors import recorded

from bodyseg_data.artifacts import MissingData, Noise, Occlusion, SensorModel
from bodyseg_data.rigs import Distortion
from bodyseg_model.sensor_fit import draw_comparison
from bodyseg_model.sensor_fit.fit import HEIGHT, simulate


def test_a_simulation_has_the_sensors_artifacts_but_no_shadow() -> None:
    recording = recorded(frames=1)
    clean = recording.frames[0].range_m.astype(np.float64)
    sensor = SensorModel("mine", (Occlusion(), Noise(5.0, 5.0), MissingData((0.2,))))
    shown = simulate(clean, recording, sensor)
    both = (shown > 0) & (clean > 0)
    assert abs(np.std((shown - clean)[both]) - 0.005) < 0.0002
    assert abs(1 - both.sum() / (clean > 0).sum() - 0.2) < 0.01 and not shown[clean == 0].any()


def test_a_simulation_reaches_as_far_as_the_frame() -> None:
    recording = recorded(frames=1)
    near = recording.frames[0].range_m.astype(np.float64)
    far = np.where(near > 0, near + 10.0, 0)
    shown = simulate(far, recording, SensorModel("mine", (Noise(5.0, 5.0),)))
    assert abs(np.std((shown - far)[far > 0]) - 0.005) < 0.0002


@pytest.mark.parametrize("lens", [None, Distortion(k1=0.05)])
def test_the_picture_has_four_panels(lens: Distortion | None) -> None:
    recording = recorded(Noise(5.0, 5.0), frames=1)
    recording = replace(recording, camera=replace(recording.camera, distortion=lens))
    picture = draw_comparison(recording, SensorModel("mine", (Noise(5.0, 5.0),)))
    assert picture.height > HEIGHT and picture.width > 4 * 240
    assert len(picture.getcolors(picture.width * picture.height) or []) > 50


def test_a_body_that_lies_makes_no_picture_wider_than_screens() -> None:
    recording = recorded(Noise(5.0, 5.0), frames=1)
    frame, low = recording.frames[0], np.zeros_like(recording.frames[0].body)
    row = frame.body.sum(axis=1).argmax()
    low[row] = frame.body[row]
    recording = replace(recording, frames=(replace(frame, body=low),))
    picture = draw_comparison(recording, SensorModel("mine", (Noise(5.0, 5.0),)))
    assert picture.width <= 4 * 640 + 5 * 12
