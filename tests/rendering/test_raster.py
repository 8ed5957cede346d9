"""Filling triangles against casting rays, and the compiled loops against the same loops in plain Python."""

from __future__ import annotations

from dataclasses import replace
from importlib.util import find_spec, module_from_spec

import numpy as np
import pytest
from plain_views import check_filled
from shapes import figure
from small_rig import SMALL

from bodyseg_data.machine import kernels
from bodyseg_data.meshes import Mesh, Solid
from bodyseg_data.rendering import RasterRenderer, raster
from bodyseg_data.rigs import PlacedCamera, load_rig
from bodyseg_data.samples import View

RIG = load_rig()


@pytest.mark.parametrize(("place", "sees"), [((0.1, 1.3, 0.28), True), ((0.0, 1.3, 0.6), False)])
def test_a_camera_with_the_body_on_both_sides_of_its_plane(place: tuple[float, float, float], sees: bool) -> None:
    across = np.array([[0.0, 0.0, -1.0], [0.0, -1.0, 0.0], [-1.0, 0.0, 0.0]])
    assert (check_filled(figure(), PlacedCamera(RIG.camera, across, np.array(place))) > 1000) == sees


def test_a_body_behind_the_camera_is_not_seen() -> None:
    axes = np.diag([1.0, -1.0, -1.0])  # looks along -z, away from a body in front of z = 0.5
    mesh = figure()
    behind = RasterRenderer(mesh).render(PlacedCamera(RIG.camera, axes, np.array([0.0, 1.2, -0.5])))
    assert not behind.range.any() and (behind.face == -1).all()
    assert check_filled(mesh, PlacedCamera(RIG.camera, axes, np.array([0.0, 1.2, 0.2]))) > 1000, "the arm is behind it"


def test_a_triangle_that_passes_the_cameras_plane_is_seen_up_to_the_frame() -> None:
    """A floor of two triangles, from half a metre behind the camera to two in front of it."""
    floor = np.array([[-1, 0, -2], [1, 0, -2], [1, 0, 0.5], [-1, 0, 0.5], [0, -0.6, -1]], np.float64)
    faces = np.array([[0, 2, 1], [0, 3, 2], [0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    camera = PlacedCamera(RIG.camera, np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.3, 0.0]))
    seen = RasterRenderer(Mesh("floor", floor, faces)).render(camera)
    rows = np.arange(RIG.camera.rows) + 0.5 - RIG.camera.centre_px[1]
    with np.errstate(divide="ignore"):
        away = 0.3 * RIG.camera.focal_px / rows  # where the ray of a row in the middle column meets the floor
    middle = seen.range[:, RIG.camera.columns // 2]
    clear = (rows > 0) & (np.abs(away - 2) > 0.02)
    np.testing.assert_allclose(middle[clear], np.where(away < 2, away, 0)[clear], rtol=1e-6)
    assert (middle > 0).sum() > 100


def test_a_triangle_with_a_level_edge_marks_no_row_beyond_it() -> None:
    """It passes the camera's plane, so its rows begin at the frame's side; its far edge is level."""
    corners = np.array([[-1, 0.4, -1], [3, 0.4, -1], [-1, 0.5, 0.5]], np.float64)
    camera = PlacedCamera(RIG.camera, np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    for face in ([2, 1, 0], [2, 0, 1], [0, 1, 2]):
        seen = RasterRenderer(Solid(corners, np.array([face], np.int32))).render(camera)
        rows = np.arange(RIG.camera.rows) + 0.5 - RIG.camera.centre_px[1]
        beyond = rows > -0.4 * RIG.camera.focal_px
        assert not (seen.face[beyond] >= 0).any() and (seen.face[~beyond] >= 0).any()


def test_triangles_without_area_are_not_seen() -> None:
    plain = figure()
    point = plain.vertices[[0, 0, 0]]
    line = np.array([[0.0, 1.0, 0.5], [0.0, 1.1, 0.5], [0.0, 1.2, 0.5]])
    count = len(plain.vertices)
    faces = np.concatenate([plain.faces, count + np.arange(6).reshape(2, 3)])
    mesh = Mesh("figure", np.concatenate([plain.vertices, point, line]), faces)
    camera = RIG.placed(plain.centre, View(215, 0))[0]
    with np.errstate(all="raise"):
        seen, whole = RasterRenderer(mesh).render(camera), RasterRenderer(plain).render(camera)
    assert np.isfinite(seen.range).all()
    assert np.array_equal(seen.face, whole.face) and np.array_equal(seen.range, whole.range)


def test_ranges_are_those_of_the_image() -> None:
    mesh = figure()
    camera = RIG.placed(mesh.centre, View(215, 0))[1]
    seen = RasterRenderer(mesh).render(camera)
    some = np.flatnonzero(np.random.default_rng(3).random(seen.range.size) < 0.2)
    np.testing.assert_array_equal(RasterRenderer(mesh).ranges(camera, some), seen.range.take(some))


def test_arrays_that_may_be_written_and_others_have_one_machine_code() -> None:
    """Meshes of files may be written, bodies of a model may not; compiling takes seconds."""
    mesh = figure()
    camera = SMALL.placed(mesh.centre, View(255, 0))[0]
    for writeable in (True, False):
        solid = Solid(mesh.vertices.copy(), mesh.faces.copy())
        solid.vertices.flags.writeable = solid.faces.flags.writeable = writeable
        assert RasterRenderer(solid).render(camera).face.max() > 0
        assert solid.vertices.flags.writeable == solid.faces.flags.writeable == writeable
    for loops, place in ((raster._project, 0), (raster._fill, 2)):
        assert not any(kinds[place].mutable for kinds in loops.signatures)


@pytest.mark.filterwarnings("ignore:invalid value encountered:RuntimeWarning")
def test_the_compiled_loops_give_the_bits_of_plain_python(monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = figure()
    placed = RIG.placed(mesh.centre, View(215, 30))[0]
    device = replace(placed.camera, rows=64, columns=32, focal_px=75.0, centre_px=(16.2, 31.7))
    cameras = [replace(placed, camera=device), PlacedCamera(device, placed.axes, np.array([0.1, 1.2, 0.5]))]
    compiled = [RasterRenderer(mesh).render(camera) for camera in cameras]
    monkeypatch.setattr(kernels, "compiled", lambda loops, feature: loops)
    spec = find_spec(RasterRenderer.__module__)
    assert spec is not None and spec.loader is not None
    uncompiled = module_from_spec(spec)
    spec.loader.exec_module(uncompiled)
    plain = uncompiled.RasterRenderer(Mesh("part", mesh.vertices, mesh.faces))
    for camera, expected in zip(cameras, compiled, strict=True):
        seen = plain.render(camera)
        assert (seen.face >= 0).sum() > 50
        np.testing.assert_array_equal(seen.face, expected.face)
        np.testing.assert_array_equal(seen.range, expected.range)


@pytest.mark.parametrize("seed", range(20))
def test_the_spans_of_large_triangles_are_the_pixels_whose_products_have_one_sign(seed: int) -> None:
    """Triangles large, small, narrow, flat and through the camera's plane: here each pixel is tested by itself."""
    rng, camera = np.random.default_rng(seed), SMALL.camera
    corners = rng.normal(0, 1, (9, 3, 3)) * rng.choice([0.05, 0.5, 2.0], (9, 1, 1))
    corners = corners + rng.normal(0, 1, (9, 1, 3)) * (0.5, 0.9, 1.0) + (0, 0, 3)
    corners[0, 2] = corners[0, 1]  # degenerate
    corners[1, :, 1] = 0.3  # level
    corners[2:6, 2, 1:] = corners[2:6, 1, 1:]  # an edge along rows, whose product does not depend on the column
    corners[3:6, 0] = rng.normal(0, 1, (3, 3)) - (0, 0, 1.5)
    seen = RasterRenderer(Solid(corners.reshape(-1, 3), np.arange(27, dtype=np.int32).reshape(-1, 3))).render(
        PlacedCamera(camera, np.eye(3), np.zeros(3))
    )
    x, y = camera.slopes[0], camera.slopes[1][:, None]
    depth, face = np.full(seen.face.shape, np.inf), np.full(seen.face.shape, -1)
    for number, (a, b, c) in enumerate(corners):
        edges = np.array([np.cross(b, c), np.cross(c, a), np.cross(a, b)])
        volume = a[0] * edges[0, 0] + a[1] * edges[0, 1] + a[2] * edges[0, 2]
        edges, volume = (-edges, -volume) if volume < 0 else (edges, volume)
        u, v, w = (edge[0] * x + (edge[1] * y + edge[2]) for edge in edges)
        with np.errstate(invalid="ignore", divide="ignore"):
            z = volume / (u + v + w)
            nearer = (np.minimum(u, np.minimum(v, w)) >= 0) & (z < depth) & (max(a[2], b[2], c[2]) > 0)
        depth[nearer], face[nearer] = z[nearer], number
    assert len(np.unique(face)) > 1
    np.testing.assert_array_equal(seen.face, face)
    np.testing.assert_array_equal(seen.range, np.where(face < 0, 0, depth).astype(np.float32))
