"""A reduced mesh shows the rig the same ranges to the tolerance, and keeps landmarks, box, pieces and open edges."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import warm
from benches.data.surface.broken_bodies import CASES, sound
from folders import HELPERS, ROOT
from numpy.typing import NDArray
from shapes import ball, figure

from bodyseg_data.bodies import Body
from bodyseg_data.core import BadConfig, BadMesh, MissingLibrary
from bodyseg_data.machine import libraries
from bodyseg_data.meshes import Mesh, SceneMesh, find_edges, partition
from bodyseg_data.packing import Packing, mesh_reduction
from bodyseg_data.packing.mesh_reduction import (
    Reduction,
    edges_collapsed,
    probe_cameras,
    range_error,
    reduce,
    reduced_body,
    seen_ranges,
)
from bodyseg_data.rigs import load_rig
from bodyseg_data.samples import View
from bodyseg_data.shards import read_manifest

RIG = load_rig()
BALL = ball(subdivisions=4)  # 5 120 triangles
MARKS = np.linspace(0, len(BALL.vertices) - 1, 33).astype(np.int64)


pytestmark = pytest.mark.usefixtures("pymeshlab")


@pytest.fixture(scope="module")
def reduction(pymeshlab: Any) -> Reduction:
    return reduce(BALL, MARKS, 2e-3, RIG)


def test_ranges_stay_within_the_tolerance_and_triangles_go(reduction: Reduction) -> None:
    assert len(reduction.mesh.faces) < len(BALL.faces) / 2
    assert 8e-4 < reduction.error_m <= 2e-3  # not far below: no more triangles than needed
    # By rays of all pixels and from between the probes, too.
    cameras = [RIG.placed(BALL.centre, View(255, azimuth))[0] for azimuth in (45, 200)]
    assert range_error(seen_ranges(reduction.mesh, cameras), seen_ranges(BALL, cameras)) <= 2.4e-3


def test_the_error_is_that_of_the_surface(reduction: Reduction) -> None:
    """Every point of the coarse ball seen from the front, by its distance from the true sphere."""
    camera = RIG.placed(BALL.centre, View(215, 0))[0]
    ranges = [seen_ranges(mesh, [camera])[0] for mesh in (reduction.mesh, BALL)]
    both = (ranges[0] > 0) & (ranges[1] > 0)
    rays = camera.camera.pixel_rays()[both]
    away = [np.linalg.norm(camera.to_body(rays * z[both][:, None]) - BALL.centre, axis=1) for z in ranges]
    assert np.percentile(np.abs(away[0] - away[1]), 95) <= reduction.error_m


def test_range_error_is_the_percentile_over_pixels_that_either_sees() -> None:
    wanted = np.zeros((10, 20), np.float32)
    wanted[:5] = 2
    ranges = wanted.copy()
    ranges[0, :4] += 0.25  # 4 of 100 pixels
    assert range_error([ranges], [wanted]) == 0
    ranges[0, :8] += 0.25
    assert range_error([ranges], [wanted]) == pytest.approx(0.25)
    assert range_error([wanted * 0], [wanted]) == 2  # a body that has gone is far off
    assert range_error([np.where(wanted > 0, 0, np.float32(3))], [wanted]) == 3


def test_landmarks_keep_their_places_exactly(reduction: Reduction) -> None:
    np.testing.assert_array_equal(reduction.mesh.vertices[reduction.landmarks], BALL.vertices[MARKS])
    assert np.isin(reduction.landmarks, reduction.mesh.faces).all()


def test_views_are_placed_as_before(reduction: Reduction) -> None:
    np.testing.assert_array_equal(reduction.mesh.centre, BALL.centre)


def test_labels_stay(reduction: Reduction) -> None:
    before, after = partition(BALL, MARKS), partition(reduction.mesh, reduction.landmarks)
    directions = np.random.default_rng(0).normal(size=(2000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    labels = []
    for mesh, parts in ((BALL, before), (reduction.mesh, after)):
        faces, points = _met(mesh, directions)
        labels.append(parts.labels_at(mesh, faces, points))
    assert np.mean(labels[0] != labels[1]) < 0.01


def _met(mesh: Mesh, directions: NDArray[np.float64]) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """Where rays from the ball's centre leave it."""
    import trimesh

    shape = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    middle = np.broadcast_to((0.0, 0.9, 0.0), directions.shape)
    faces, rays, points = shape.ray.intersects_id(middle, directions, return_locations=True, multiple_hits=False)
    order = np.argsort(rays)
    assert len(order) == len(directions)
    return faces[order].astype(np.int32), points[order]


def test_a_smaller_tolerance_keeps_more_triangles(reduction: Reduction) -> None:
    finer = reduce(BALL, MARKS, 8e-4, RIG)
    assert 1.5 * len(reduction.mesh.faces) < len(finer.mesh.faces) < len(BALL.faces)
    assert 0 < finer.error_m <= 8e-4


@pytest.mark.parametrize(("power", "misses"), [(1.2, 0), (1.6, 0), (1.95, 0), (3.0, 1)])
def test_the_search_neither_goes_too_far_nor_creeps(power: float, misses: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """With an error that is a power of the count: up to 2 no stage is made in vain, and each takes away enough."""
    tolerance_m, tried = 2e-3, list[float]()

    def collapsed(mesh: Mesh, landmarks: NDArray[np.int64], count: int) -> tuple[Mesh, NDArray[np.int64]]:
        tried.append(count / len(mesh.faces))
        return cast(Mesh, SimpleNamespace(faces=BALL.faces[:count])), landmarks

    errors: list[float] = []

    def modelled(mesh: Mesh, cameras: object) -> list[NDArray[np.float64]]:
        errors.append(0.0 if mesh is BALL else 3e-5 * (len(BALL.faces) / len(mesh.faces)) ** power)
        return [np.full((1, 1), 1 + errors[-1])]

    monkeypatch.setattr(mesh_reduction, "edges_collapsed", collapsed)
    monkeypatch.setattr(mesh_reduction, "seen_ranges", modelled)
    found = reduce(BALL, MARKS, tolerance_m, RIG)
    assert len(errors) == 1 + len(tried) > 2
    assert all(0.599 <= share <= 0.851 for share in tried), "but for whole triangles"
    assert sum(error > tolerance_m for error in errors) == misses
    assert 0.85**2 * 0.95 * tolerance_m <= found.error_m <= tolerance_m


def test_the_same_mesh_gives_the_same_bits_whatever_was_done_before(pymeshlab: Any, reduction: Reduction) -> None:
    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(BALL.vertices, BALL.faces))
    # pymeshlab takes what a call leaves out from the call before.
    meshes.meshing_decimation_quadric_edge_collapse(
        targetfacenum=5000, qualitythr=0.9, planarquadric=True, optimalplacement=False, boundaryweight=7.0
    )
    assert _digest(reduce(BALL, MARKS, 2e-3, RIG)) == _digest(reduction)


def test_another_process_gives_the_same_bits(reduction: Reduction) -> None:
    here = Path(__file__).parent
    script = (
        f"import sys; sys.path[:0] = [{str(HELPERS)!r}, {str(ROOT / 'tools')!r}, {str(here)!r}]\n"
        "from test_mesh_reduction import *; from test_mesh_reduction import _digest\n"
        "print(_digest(reduce(BALL, MARKS, 2e-3, RIG)))"
    )
    done = warm.run(["-c", script], cwd=here)
    assert done.stdout.strip() == _digest(reduction), done.stderr


def _digest(reduction: Reduction) -> str:
    mesh = reduction.mesh
    return hashlib.sha256(mesh.vertices.tobytes() + mesh.faces.tobytes() + reduction.landmarks.tobytes()).hexdigest()


def test_pieces_stay_apart_and_none_goes() -> None:
    mesh = figure()
    coarse, _ = edges_collapsed(mesh, np.linspace(0, 600, 33).astype(np.int64), 900)
    assert len(coarse.faces) < len(mesh.faces) / 2
    assert coarse.pieces().max() == mesh.pieces().max() == 4


@pytest.mark.parametrize("case", ["holes", "non-manifold edges"])
def test_open_edges_stay_as_they_are(case: str) -> None:
    broken = CASES[case](sound(Body(BALL, MARKS)), np.random.default_rng(0)).body("broken")
    coarse, _ = edges_collapsed(broken.mesh, broken.landmarks, len(broken.mesh.faces) * 2 // 3)
    assert len(coarse.faces) < 0.9 * len(broken.mesh.faces)
    assert _rim(broken.mesh) == _rim(coarse)


def test_labels_go_along_and_their_borders_stay(pymeshlab: Any) -> None:
    """Of each triangle that is left, and of every border of two labels, which no edge that collapses may move."""
    x = BALL.vertices[:, 0]
    by_vertex = np.where(x > 0.1, 7, np.where(x < -0.1, 3, 255)).astype(np.uint8)
    scene = SceneMesh("ball", BALL.vertices, BALL.faces, by_vertex[BALL.faces])
    coarse, _ = edges_collapsed(scene, np.zeros(0, np.int64), len(BALL.faces) // 2)
    assert isinstance(coarse, SceneMesh)
    assert len(coarse.faces) < 0.7 * len(BALL.faces)
    x = coarse.vertices[:, 0]
    assert np.array_equal(coarse.labels, np.where(x > 0.1, 7, np.where(x < -0.1, 3, 255))[coarse.faces])
    assert _borders(coarse) == _borders(scene)


def _borders(mesh: SceneMesh) -> set[bytes]:
    mixed = (mesh.labels != mesh.labels[:, :1]).any(axis=1)
    return {corners.tobytes() for corners in mesh.vertices[mesh.faces[mixed]]}


def test_seams_do_not_open() -> None:
    broken = CASES["doubled vertices: seams"](sound(Body(BALL, MARKS)), np.random.default_rng(0)).body("broken")
    coarse, _ = edges_collapsed(broken.mesh, broken.landmarks, len(broken.mesh.faces) * 2 // 3)
    assert len(coarse.faces) < 0.9 * len(broken.mesh.faces)
    assert _rim(broken.mesh) >= _rim(coarse)  # vertices in one place may become one, but none moves


def _rim(mesh: Mesh) -> set[bytes]:
    edges = find_edges(mesh.faces)
    return {ends.tobytes() for ends in np.sort(mesh.vertices[edges.ends[edges.faces != 2]], axis=1)}


@pytest.mark.usefixtures("quick_geodesics")
@pytest.mark.parametrize("case", list(CASES)[:-1])
def test_broken_bodies_are_reduced_or_left_whole(case: str) -> None:
    broken = CASES[case](sound(Body(BALL, MARKS)), np.random.default_rng(0)).body("broken")
    reduction = reduce(broken.mesh, broken.landmarks, 2e-3, RIG)
    assert reduction.error_m <= 2e-3
    np.testing.assert_array_equal(reduction.mesh.vertices[reduction.landmarks], broken.mesh.vertices[broken.landmarks])
    partition(reduction.mesh, reduction.landmarks)


def test_loose_triangles_are_left_whole() -> None:
    broken = CASES["doubled vertices: loose triangles"](sound(Body(BALL, MARKS)), np.random.default_rng(0)).body("b")
    assert reduce(broken.mesh, broken.landmarks, 1e-2, RIG).mesh is broken.mesh


def test_a_mesh_as_coarse_as_may_be_is_left_whole() -> None:
    mesh = ball(subdivisions=2)
    reduction = reduce(mesh, np.arange(33), 1e-6, RIG)
    assert reduction.mesh is mesh
    assert reduction.note is None
    assert reduction.error_m == 0


def test_a_body_the_rig_cannot_see_is_left_whole() -> None:
    away = replace(RIG, camera=replace(RIG.camera, centre_px=(RIG.camera.centre_px[0] + 5000, 0)))
    reduction = reduce(BALL, MARKS, 2e-3, away)
    assert reduction.mesh is BALL
    assert reduction.note == "left whole: the rig sees nothing of it at 215 cm"


def test_a_collapse_that_fails_leaves_the_mesh_whole(pymeshlab: Any, monkeypatch: pytest.MonkeyPatch) -> None:

    def fail(*_: object, **__: object) -> None:
        raise pymeshlab.PyMeshLabException("filter\nfailed")

    monkeypatch.setattr(pymeshlab.MeshSet, "meshing_decimation_quadric_edge_collapse", fail)
    reduction = reduce(BALL, MARKS, 2e-3, RIG)
    assert reduction.mesh is BALL
    assert reduction.error_m == 0
    assert reduction.note == "left whole: edges could not be collapsed: filter failed"


def test_a_collapse_that_makes_no_body_leaves_the_mesh_whole(pymeshlab: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    faces = pymeshlab.Mesh.face_matrix
    monkeypatch.setattr(pymeshlab.Mesh, "face_matrix", lambda mesh: faces(mesh)[:, ::-1])
    reduction = reduce(BALL, MARKS, 2e-3, RIG)
    assert reduction.mesh is BALL
    assert reduction.note is not None
    assert reduction.note.startswith("left whole: mesh ball: faces must point outwards")


def test_a_lost_landmark_is_an_error(pymeshlab: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    vertices = pymeshlab.Mesh.vertex_matrix
    monkeypatch.setattr(pymeshlab.Mesh, "vertex_matrix", lambda mesh: vertices(mesh) + 1e-9)
    with pytest.raises(BadMesh, match="collapsing edges moved a landmark"):
        edges_collapsed(BALL, MARKS, len(BALL.faces) // 2)


@pytest.mark.parametrize("tolerance_m", [0.0, -1e-3, np.nan, np.inf])
def test_the_tolerance_must_be_positive(tolerance_m: float) -> None:
    with pytest.raises(BadConfig, match="a mesh is reduced to a positive tolerance, found"):
        reduce(BALL, MARKS, tolerance_m, RIG)


@pytest.mark.parametrize("tolerance_mm", [-1.0, np.nan, np.inf])
def test_a_packing_takes_no_such_tolerance(tolerance_mm: float) -> None:
    with pytest.raises(BadConfig, match="tolerance_mm must be at least 0, found"):
        Packing("open", tolerance_mm=tolerance_mm)


def test_small_meshes_are_reduced_only_when_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = ball(subdivisions=5)
    body = Body(whole, MARKS, ("read from a file",))
    assert reduced_body(body, None, RIG, 215) is body
    assert reduced_body(body, 0, RIG, 215) is body
    asked = reduced_body(body, 0.5, RIG, 215)
    assert asked.notes[0] == "read from a file"
    assert asked.notes[1].startswith(
        f"reduced from 20480 to {len(asked.mesh.faces)} triangles, 95 % of pixels within 0."
    )
    monkeypatch.setattr(mesh_reduction, "PAYS_FROM", len(whole.faces))
    chosen = reduced_body(body, None, RIG, 215, pymeshlab=True)
    assert len(asked.mesh.faces) < len(chosen.mesh.faces) < len(whole.faces)
    by_default = reduced_body(body, None, RIG, 215)
    assert by_default.mesh is whole
    assert by_default.notes[1:] == ("whole, with 20480 triangles: --pymeshlab packs it faster",)


def test_a_packing_reduces_and_says_so(tmp_path: Path, pack_figures: Callable[..., Path]) -> None:
    reduced = pack_figures(tmp_path / "reduced", meshes=2, tolerance_mm=1.0)
    whole = pack_figures(tmp_path / "whole", meshes=2, tolerance_mm=0)
    notes = read_manifest(reduced).notes()
    assert [note.partition(" triangles")[0].partition(" to ")[0] for note in notes] == [
        "A-1: reduced from 6400",
        "people-1: reduced from 6400",
    ]
    assert not read_manifest(whole).notes()
    assert (reduced / "train-00000.tar").read_bytes() != (whole / "train-00000.tar").read_bytes()


def test_probes_see_the_body_from_all_sides() -> None:
    cameras = probe_cameras(BALL, RIG, 295, (0,))
    assert [np.linalg.norm(camera.position - BALL.centre) for camera in cameras] == pytest.approx([2.95] * 4)
    full = RIG.camera
    for camera in cameras:
        assert camera.camera.rows * 4 == full.rows
        assert camera.camera.focal_px * 4 == full.focal_px


def test_probes_see_the_body_from_all_sides_at_every_pitch() -> None:
    cameras = probe_cameras(BALL, RIG, 295, (0, -90))
    places = np.array([camera.position - BALL.centre for camera in cameras])
    assert np.linalg.norm(places, axis=1) == pytest.approx([2.95] * 8)
    assert places[:, 1] == pytest.approx([0.0] * 4 + [2.95] * 4)


def test_a_missing_library_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(libraries, "can_load", lambda name: name != "OpenGL")
    with pytest.raises(MissingLibrary, match="^reducing a mesh needs libOpenGL"):
        reduce(BALL, MARKS, 2e-3, RIG)
