"""The camera of a sequence of frames."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from bodyseg_data.core import BadConfig
from bodyseg_data.rigs import Camera, load_rig, load_sensor, rig_names
from bodyseg_model.recordings import frame_camera, other_sensors
from bodyseg_model.recordings.cameras import assumed_sensors


def test_a_camera_is_given_or_told_by_the_size_of_frames() -> None:
    given = frame_camera((30, 40), "a.png", focal_px=50.0)
    assert (given.camera.focal_px, given.camera.centre_px, given.assumed) == (50.0, (20.0, 15.0), False)
    assert frame_camera((30, 40), "a.png", focal_px=50.0, centre_px=(19.0, 16.0)).camera.centre_px == (19.0, 16.0)
    for shape in ((640, 329), [640, 329], np.array([640, 329])):
        paper = frame_camera(shape, "a.png", rig="paper")  # type: ignore[arg-type]
        assert (paper.camera, paper.assumed) == (load_rig().camera, False)
    told = {shape: frame_camera(shape, "a.png") for shape in ((640, 329), (480, 640), (424, 512))}
    assert all(camera.assumed and camera.origin.startswith("assumed: ") for camera in told.values())
    assert [camera.camera.focal_px for camera in told.values()] == pytest.approx([757.58, 525, 365], abs=0.01)
    assert [camera.origin for camera in told.values()] == [
        f"assumed: {name}, by the frames' size" for name in ("the paper's rig", "Kinect v1", "Kinect v2")
    ]
    assert given.to_json() == {
        "rows": 30,
        "columns": 40,
        "focal_px": 50.0,
        "centre_px": [20.0, 15.0],
        "origin": "given",
    }


def test_every_rig_file_is_a_camera_that_frames_may_be_from() -> None:
    for name in rig_names():
        sensor = load_sensor(name).camera
        camera = frame_camera((sensor.rows, sensor.columns), "a.png", rig=name)
        assert (camera.origin, camera.assumed) == (f"rig {name}", False)


SIZES = {"kinect_v1": (480, 640), "kinect_v2": (424, 512), "paper": (640, 329)}


def test_the_assumed_sensors_have_a_size_of_their_own() -> None:
    assert {sensor.name: (sensor.camera.rows, sensor.camera.columns) for sensor in assumed_sensors()} == SIZES
    pose = (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)
    assert {sensor.title: sensor.camera for sensor in other_sensors()} == {
        "Kinect v1": Camera(480, 640, 525.0, (320.0, 240.0), *pose),
        "Kinect v2": Camera(424, 512, 365.0, (256.0, 212.0), *pose),
    }


@pytest.mark.parametrize(
    ("shape", "options", "message"),
    [
        ((1, 1), {}, r"frames of 1 rows of 1 pixels: give --focal or --rig \(a.png\)$"),
        ("kinect_v1", {}, r"^shape must be \(rows, columns\), found 'kinect_v1': "),
        (525.0, {}, r"^shape must be \(rows, columns\), found 525.0: "),
        ((30, 40), {"rig": "paper"}, "the rig's camera, 640 x 329, found 30 x 40: a.png"),
        ((640, 329), {"rig": "paper", "focal_px": 5.0}, "^give either --rig or --focal and --centre$"),
        ((640, 329), {"rig": "papr"}, "no rig is called 'papr'"),
        ((30, 40), {"focal_px": 5.0, "centre_px": (1.0,)}, "^--centre takes two numbers, x and y, found 1$"),
        ((30, 40), {"centre_px": (1.0, 2.0)}, "^--centre needs --focal$"),
        ((30, 40), {"focal_px": -5.0}, "focal_px must be above 0"),
        ((30, 40), {"focal_px": float("nan")}, "focal_px must be above 0"),
    ],
)
def test_a_camera_that_cannot_be(shape: Any, options: dict[str, Any], message: str) -> None:
    with pytest.raises(BadConfig, match=message):
        frame_camera(shape, "a.png", **options)
