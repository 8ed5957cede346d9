"""Poses: views from above, below and turned, and rig files whose devices are turned."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from importlib import resources
from typing import Any

import numpy as np
import pytest

from bodyseg_data.core import BadConfig
from bodyseg_data.rigs import Camera, PlacedCamera, load_rig, rig_from_json
from bodyseg_data.rigs.rig import parse_sensor
from bodyseg_data.samples import View

PAPER = (resources.files("bodyseg_data.rigs") / "paper.toml").read_text()
RIG = load_rig()
CENTRE = np.array([0.1, 0.9, -0.2])
MIDDLE = np.array(RIG.camera.centre_px)

TURNED = replace(
    RIG,
    camera=replace(RIG.camera, roll_deg=30.0),
    projector=replace(RIG.projector, roll_deg=-12.5),
)
ASIDE = replace(RIG, camera=replace(RIG.camera, position_m=(0.3, -0.2, 0.1)))


def camera_of(view: View) -> PlacedCamera:
    return RIG.placed(CENTRE, view)[0]


def pixel_of(view: View, *offset: float) -> Any:
    """The pixel that shows a point beside the body's centre, from the middle of the image."""
    return camera_of(view).project(CENTRE + offset)[0] - MIDDLE


@pytest.mark.parametrize("pitch", [-90, -35, 0, 20, 90])
@pytest.mark.parametrize("azimuth", [0, 70, 200])
def test_a_pitched_camera_keeps_its_distance_and_its_aim(pitch: int, azimuth: int) -> None:
    camera = camera_of(View(255, azimuth, pitch))
    assert camera.to_local(CENTRE) == pytest.approx([0, 0, 2.55])
    assert camera.position[1] - CENTRE[1] == pytest.approx(2.55 * math.sin(math.radians(-pitch)))
    level = camera_of(View(255, azimuth))
    assert camera.axes[0] == pytest.approx(level.axes[0]), "it stays upright"
    assert camera.axes @ camera.axes.T == pytest.approx(np.eye(3)) and np.linalg.det(camera.axes) == pytest.approx(1)
    assert math.degrees(math.asin(camera.axes[2, 1])) == pytest.approx(pitch)


def test_negative_pitch_looks_down_from_above() -> None:
    above = camera_of(View(255, 0, -40))
    assert above.position[1] > CENTRE[1] + 1.5 and above.axes[2, 1] < 0
    head, feet = (above.project(np.add(CENTRE, (0, y, 0)))[1] for y in (0.8, -0.8))
    assert head < 2.1 and feet > 3, "the head is nearer than the feet"
    assert pixel_of(View(255, 0, -90), 0, 0, 0.3)[1] > 50, "from straight above, the body's front is at the bottom"


def test_roll_turns_the_camera_clockwise_and_the_image_the_other_way() -> None:
    assert pixel_of(View(250, 0), 0, 0.5, 0) == pytest.approx([0, -151.5], abs=0.1)
    right = pixel_of(View(250, 0, roll_deg=90), 0, 0.5, 0)
    assert right == pytest.approx([-151.5, 0], abs=0.1), "a camera on its right side shows the head at the left"
    little = pixel_of(View(250, 0, roll_deg=10), 0, 0.5, 0)
    assert math.degrees(math.atan2(-little[0], -little[1])) == pytest.approx(10)
    pitched = View(250, 130, -20, 33)
    assert camera_of(pitched).axes[2] == pytest.approx(camera_of(replace(pitched, roll_deg=0)).axes[2])
    assert camera_of(pitched).position == pytest.approx(camera_of(replace(pitched, roll_deg=0)).position)


@pytest.mark.parametrize("view", [View(255, 0), View(255, 70, -30), View(215, 20, 10, 45)])
def test_height_raises_the_camera_without_turning_it(view: View) -> None:
    low, high = camera_of(view), camera_of(replace(view, height_cm=40))
    assert high.position - low.position == pytest.approx([0, 0.4, 0])
    assert high.axes == pytest.approx(low.axes)
    assert high.to_local(np.add(CENTRE, (0, 0.4, 0))) == pytest.approx([0, 0, view.distance_cm / 100])
    if not view.roll_deg:
        assert pixel_of(replace(view, height_cm=40), 0, 0, 0)[1] > 50, "the body moves down"


@pytest.mark.parametrize("rig", [RIG, TURNED, ASIDE], ids=["paper", "turned", "aside"])
@pytest.mark.parametrize("view", [View(255, 0), View(255, 70, -30, 20, 15), View(215, 200, -90, 180, -40)])
def test_the_projector_keeps_its_place_beside_the_camera(rig: Any, view: View) -> None:
    camera, projector = rig.placed(CENTRE, view)
    rotation, offset = rig.camera_to_projector()
    points = np.random.default_rng(0).normal(size=(20, 3))
    assert camera.to_local(points) @ rotation.T + offset == pytest.approx(projector.to_local(points))
    assert np.linalg.det(projector.axes) == pytest.approx(1)


def test_a_cameras_own_roll_adds_to_the_views_and_turns_nothing_else() -> None:
    rolled = replace(RIG, camera=replace(RIG.camera, roll_deg=30.0))
    camera, projector = rolled.placed(CENTRE, View(255, 40, -10, 5))
    plain, light = RIG.placed(CENTRE, View(255, 40, -10, 5))
    assert camera.axes == pytest.approx(RIG.placed(CENTRE, View(255, 40, -10, 35))[0].axes)
    assert camera.position == pytest.approx(plain.position)
    # The rig, which carries the projector, is rolled by the view only.
    assert projector.axes == pytest.approx(light.axes) and projector.position == pytest.approx(light.position)


def test_a_projectors_roll_turns_its_image_only() -> None:
    rig = replace(RIG, projector=replace(RIG.projector, roll_deg=90.0))
    (_, turned), (_, plain) = (each.placed(CENTRE, View(255, 40)) for each in (rig, RIG))
    assert turned.position == pytest.approx(plain.position) and turned.axes[2] == pytest.approx(plain.axes[2])
    assert turned.axes[0] == pytest.approx(plain.axes[1]) and turned.axes[1] == pytest.approx(-plain.axes[0])


def test_a_rig_file_may_roll_its_devices() -> None:
    text = PAPER.replace("[projector]", "roll_deg = -7\n[projector]\nroll_deg = 90")
    rig = parse_sensor(text, "x").rig
    assert (rig.camera.roll_deg, rig.projector.roll_deg) == (-7.0, 90.0)
    assert rig_from_json(json.loads(json.dumps(rig.to_json()))) == rig
    assert rig.to_json() != RIG.to_json()


def test_a_rig_without_roll_is_stored_as_before_there_was_any() -> None:
    assert set(RIG.to_json()["camera"]) == {"rows", "columns", "focal_px", "centre_px", "position_m", "aims_at_m"}
    assert set(RIG.to_json()["projector"]) == set(RIG.to_json()["camera"])


def test_a_device_may_look_straight_down_if_it_says_what_is_up_in_its_image() -> None:
    text = PAPER.replace("[0.0, 0.0, 2.5]  # assumed: the", "[0.0, 2.5, 0.0]\nup = [0, 0, 2]  #", 1)
    text = text.replace("[0.0, 0.0, 2.5]     # assumed: toed", "[0.0, 2.5, 0.0]  #", 1)
    rig = parse_sensor(text, "x").rig
    assert rig.camera.axes == pytest.approx(np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]))
    assert rig_from_json(json.loads(json.dumps(rig.to_json()))) == rig
    camera, _ = rig.placed(CENTRE, View(255, 40))
    assert camera.axes == pytest.approx(RIG.placed(CENTRE, View(255, 40))[0].axes)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ("roll_deg = 181", "Camera: roll_deg must be from -180 to 180, found 181"),
        ("roll_deg = nan", "'roll_deg' must be a finite number"),
        ("up = [0, 0, 1]", r"must not look straight up or down, along its 'up', found \[0.0, 0.0, 2.5\]"),
        ("up = [0, 0, 0]", "along its 'up', found"),
        ("up = [0, 1]", "'up' must be 3 finite numbers"),
        ("up = [0, 1e200, 0]", "Camera: up must be from -100 to 100, found"),
    ],
)
def test_a_pose_that_is_none_is_refused_in_one_line(lines: str, message: str) -> None:
    with pytest.raises(BadConfig, match=rf"^rig x, \[camera\]: .*{message}") as caught:
        parse_sensor(PAPER.replace("[projector]", f"{lines}\n[projector]"), "x")
    assert "\n" not in str(caught.value)


def test_refining_an_image_keeps_its_roll() -> None:
    camera = Camera(480, 640, 525.0, (320.0, 240.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), roll_deg=20.0)
    assert camera.scaled(2).axes == pytest.approx(camera.axes)
