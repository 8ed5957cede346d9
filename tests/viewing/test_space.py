"""Points, devices and viewpoints of a page, against the geometry that rendered the samples."""

from __future__ import annotations

import numpy as np
import pytest
from small_rig import SMALL

from bodyseg_data.rigs import Camera, PlacedCamera, load_rig
from bodyseg_data.samples import View
from bodyseg_model.viewing.pictures import (
    VIEWPOINTS,
    Viewpoint,
    camera_alone,
    name_heights,
    points_at,
    rig_before,
    viewpoint,
)

CAMERA = Camera(3, 4, 2.0, (2.0, 1.5), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))


def test_points_of_a_frame_lie_where_its_pixels_look() -> None:
    range_m = np.zeros((3, 4), np.float32)
    range_m[0, 0], range_m[2, 3] = 2.0, 4.0
    # Half a pixel from the corners: 1.5 left and 1 up of the middle, at 2 pixels a unit.
    expected = [[-1.5, 1.0, -2.0], [3.0, -2.0, -4.0]]
    np.testing.assert_allclose(points_at(range_m, camera_alone(CAMERA)), expected, atol=1e-6)


@pytest.mark.parametrize("azimuth", [0, 130])
def test_the_rig_of_every_view_stands_before_the_body(azimuth: int) -> None:
    camera, projector = rig_before(SMALL, View(255, azimuth, -10))
    np.testing.assert_allclose(camera.position, [0, 2.55 * np.sin(np.radians(10)), 2.55 * np.cos(np.radians(10))])
    np.testing.assert_allclose(np.linalg.norm(camera.position - projector.position), SMALL.baseline_m)
    # Both see the body's middle in the middle of their images.
    assert np.allclose(camera.project(np.zeros((1, 3)))[0], camera.camera.centre_px)


def test_a_rig_of_two_projectors_has_three_devices() -> None:
    rig = load_rig("realsense_d435")
    assert len(rig_before(rig, View(200, 0))) == 1 + len(rig.projectors)


@pytest.mark.parametrize("kind", VIEWPOINTS)
@pytest.mark.parametrize("aspect", [0.5, 2.0])
def test_viewpoints_take_in_what_they_name(kind: Viewpoint, aspect: float) -> None:
    devices = [rig_before(SMALL, View(255, 0))[0]]
    xyz = np.random.default_rng(0).uniform((-0.3, -0.9, -0.2), (0.3, 0.9, 0.2), (200, 3)).astype(np.float32)
    place, at = viewpoint(xyz, devices, kind, 0.85, aspect)
    if kind == "camera":
        np.testing.assert_allclose(place, devices[0].position)
    forward = (at - place) / np.linalg.norm(at - place)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    seen = np.concatenate([xyz, np.array([devices[0].position])]) if kind == "sensor" else xyz
    away = (seen - place) @ forward
    down, across = ((seen - place) @ axis / away / np.tan(0.85 / 2) for axis in (np.cross(forward, right), right))
    assert (away > 0).all()
    assert (np.abs(down) < 1).all() and (np.abs(across) < aspect).all()


@pytest.mark.parametrize("window", [(121, 480), (352, 700), (480, 320), (1100, 700)])
def test_a_body_is_seen_whole_and_from_the_front(window: tuple[int, int]) -> None:
    aspect, half = window[0] / window[1], np.tan(0.35)
    random = np.random.default_rng(0)
    xyz = random.uniform((-0.4, -0.9, -0.2), (0.4, 0.9, 0.2), (2000, 3)).astype(np.float32)
    xyz[:10] += random.normal(0, 2, (10, 3)).astype(np.float32)  # noise
    place, at = viewpoint(xyz, [], "points", 0.7, aspect)
    towards = (place - at) / np.linalg.norm(place - at)
    assert towards[2] > np.cos(np.radians(15))
    right = np.cross([0.0, 1.0, 0.0], towards)
    right /= np.linalg.norm(right)
    body = xyz[10:] - place
    across, up = (np.abs(body @ axis / -(body @ towards)) for axis in (right, np.cross(towards, right)))
    filled = max(across.max() / aspect, up.max()) / half
    assert 0.75 < filled <= 1, "all of it, and as large as may be"


def test_viewpoints_of_nothing_look_at_the_middle() -> None:
    place, at = viewpoint(np.zeros((0, 3), np.float32), [], "camera", 0.7, 1.0)
    np.testing.assert_allclose(at, 0)
    assert place[2] > 1


def test_names_of_devices_lie_apart() -> None:
    def at(x: float, y: float) -> PlacedCamera:
        return PlacedCamera(CAMERA, np.eye(3), np.array([x, y, 2.0]))

    camera, beside, above = at(0.0, 0.0), at(0.05, 0.001), at(0.0, 0.5)
    assert name_heights([camera]) == [0.13]
    assert name_heights([camera, beside]) == [0.13, -0.13]
    assert name_heights([camera, beside, above]) == [-0.13, -0.26, 0.13]
