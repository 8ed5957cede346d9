"""Rays are cast only where the body can be: the image is the one of all rays, bit for bit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from plain_views import cast_whole_frame
from shapes import ball, figure

from bodyseg_data.bodies import open_source
from bodyseg_data.mesh import Mesh
from bodyseg_data.rendering.embree import EmbreeRenderer
from bodyseg_data.rendering.outline import Outline
from bodyseg_data.rig import PlacedCamera, load_rig
from bodyseg_data.views import View

RIG = load_rig()


def check(mesh: Mesh, camera: PlacedCamera) -> int:
    """How many pixels see the body, once they are known to be the right ones."""
    renderer, whole = EmbreeRenderer(mesh), cast_whole_frame(mesh, camera)
    seen = renderer.see(camera)
    assert (seen.face.dtype, seen.range.dtype) == (np.int32, np.float32)
    np.testing.assert_array_equal(seen.face, whole.face)
    np.testing.assert_array_equal(seen.range, whole.range)
    some = np.flatnonzero(np.random.default_rng(1).random(whole.range.size) < 0.3)
    ranges = renderer.ranges(camera, some)
    assert ranges.dtype == np.float32
    np.testing.assert_array_equal(ranges, whole.range.take(some))
    return int((whole.face >= 0).sum())


@pytest.mark.parametrize("azimuth", [0, 40, 90, 215])
@pytest.mark.parametrize("distance", [150, 215, 295])
def test_shapes_from_all_round(azimuth: int, distance: int) -> None:
    for mesh in (ball(subdivisions=1), figure()):
        for camera in RIG.placed(mesh.centre, View(distance, azimuth)):
            assert check(mesh, camera) > 5000


@pytest.mark.parametrize("index", [0, 30, 300])
def test_open_bodies(index: int) -> None:
    source = open_source("open")
    mesh = source.build(source.bodies()[index]).mesh
    for view in (View(215, 0), View(295, 130)):
        for camera in RIG.placed(mesh.centre, view):
            assert check(mesh, camera) > 10_000


def test_a_real_frame(mit_folder: Path) -> None:
    source = open_source("mit", mit_folder)
    mesh = source.build(source.bodies()[0]).mesh
    for camera in RIG.placed(mesh.centre, View(255, 70)):
        assert check(mesh, camera) > 10_000


def test_bodies_cut_by_every_side_of_frames_of_any_size() -> None:
    mesh = figure()
    placed = RIG.placed(mesh.centre, View(215, 20))[0]
    draw = np.random.default_rng(7)
    seen = 0
    for _ in range(60):
        rows, columns = draw.integers(1, 200, 2)
        x, y = draw.uniform(-200, 400, 2)
        device = replace(placed.camera, rows=int(rows), columns=int(columns), centre_px=(float(x), float(y)))
        seen += check(mesh, replace(placed, camera=device)) > 0
    assert 15 < seen < 60, "some frames hold a part of the body, some nothing"


def test_a_camera_with_the_body_on_both_sides_of_its_plane() -> None:
    mesh = figure()
    across = np.array([[0.0, 0.0, -1.0], [0.0, -1.0, 0.0], [-1.0, 0.0, 0.0]])
    assert check(mesh, PlacedCamera(RIG.camera, across, np.array([0.1, 1.3, 0.28]))) > 1000


@pytest.mark.parametrize("block", [1, 2, 3, 8, 64])
def test_an_outline_holds_every_pixel_that_is_seen_and_few_more(block: int) -> None:
    mesh = figure()
    for view in (View(215, 0), View(255, 100)):
        for camera in RIG.placed(mesh.centre, view):
            seen = cast_whole_frame(mesh, camera).face >= 0
            covered = Outline(mesh, block).covered(camera)
            assert covered.shape == seen.shape
            assert not (seen & ~covered).any()
            if block <= 3:
                assert covered.sum() < 1.25 * seen.sum()


def test_no_pixels_have_no_ranges() -> None:
    camera = RIG.placed(ball().centre, View(215, 0))[0]
    assert EmbreeRenderer(ball()).ranges(camera, np.zeros(0, np.intp)).shape == (0,)
