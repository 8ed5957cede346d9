"""Deliberately broken meshes: after repair they are whole, outward and of the same volume."""

from __future__ import annotations

import sys
from collections import Counter
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from shapes import ball, figure

from bodyseg_data.core import BadMesh, MissingLibrary
from bodyseg_data.machine import libraries
from bodyseg_data.meshes import Mesh, repair
from bodyseg_data.meshes.repairing import SAME_POINT_M

Parts = tuple[NDArray[np.float64], NDArray[np.int32]]

pytestmark = pytest.mark.usefixtures("pymeshlab")


def is_closed(mesh: Mesh) -> bool:
    """Every edge is used once in each direction."""
    directed = Counter(
        map(tuple, np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]))
    )
    return all(count == 1 and directed[b, a] == 1 for (a, b), count in directed.items())


def inside_out(whole: Mesh) -> Parts:
    return whole.vertices, whole.faces[:, ::-1]


def loose_triangles(whole: Mesh) -> Parts:
    return whole.vertices[whole.faces].reshape(-1, 3), np.arange(3 * len(whole.faces), dtype=np.int32).reshape(-1, 3)


def loose_and_rounded(whole: Mesh) -> Parts:
    vertices, faces = loose_triangles(whole)
    return vertices + np.random.default_rng(0).uniform(-1e-7, 1e-7, vertices.shape), faces


def doubled_faces(whole: Mesh) -> Parts:
    again = whole.faces[::3]
    return whole.vertices, np.concatenate([whole.faces, again, again[::2, ::-1]])


def some_turned(whole: Mesh) -> Parts:
    faces = whole.faces.copy()
    some = np.random.default_rng(0).random(len(faces)) < 0.3
    faces[some] = faces[some][:, ::-1]
    return whole.vertices, faces


def without_area(whole: Mesh) -> Parts:
    thin = np.stack([whole.faces[:50, 0], whole.faces[:50, 1], whole.faces[:50, 1]], axis=1)
    return whole.vertices, np.concatenate([thin, whole.faces])


def stray_vertices(whole: Mesh) -> Parts:
    return np.concatenate([[[np.nan] * 3, [9.0, 9.0, 9.0]], whole.vertices]), whole.faces + 2


def with_a_fin(whole: Mesh) -> Parts:
    """A third, small face on one edge."""
    a, b = whole.faces[0, :2]
    tip = (whole.vertices[a] + whole.vertices[b]) / 2 + 1e-3
    return np.concatenate([whole.vertices, [tip]]), np.concatenate([whole.faces, [[a, b, len(whole.vertices)]]])


BREAKS = [
    inside_out,
    loose_triangles,
    loose_and_rounded,
    doubled_faces,
    some_turned,
    without_area,
    stray_vertices,
    with_a_fin,
]


@pytest.mark.parametrize("whole", [ball(subdivisions=3), figure()], ids=["ball", "figure"])
@pytest.mark.parametrize("broken", BREAKS)
def test_a_broken_mesh_becomes_the_whole_one_again(broken, whole: Mesh) -> None:
    vertices, faces = repair("broken", *broken(whole))
    mended = Mesh("mended", vertices, faces)
    assert vertices.dtype == np.float64 and faces.dtype == np.int32
    assert len(vertices) == len(whole.vertices) and len(faces) == len(whole.faces)
    assert is_closed(mended)
    assert mended.signed_volume() == pytest.approx(whole.signed_volume(), rel=1e-5)
    moved = [np.abs(whole.vertices - vertex).max(axis=1).min() for vertex in mended.vertices[::37]]
    assert max(moved) <= SAME_POINT_M


def test_the_checks_can_fail() -> None:
    whole = ball(subdivisions=3)
    assert is_closed(whole)
    assert not is_closed(Mesh("doubled", *doubled_faces(whole)))
    assert not is_closed(Mesh("loose", *loose_triangles(whole)))
    with pytest.raises(BadMesh, match="must point outwards"):
        Mesh("turned", *inside_out(whole))


def test_one_piece_of_many_inside_out() -> None:
    """The whole volume is positive, so only a piece-by-piece check finds the arm that is turned."""
    whole = figure()
    faces = whole.faces.copy()
    arm = slice(2 * 1280, 3 * 1280)
    faces[arm] = faces[arm, ::-1]
    with pytest.raises(BadMesh, match="faces must point outwards"):
        Mesh("arm turned", whole.vertices, faces)
    mended = Mesh("mended", *repair("arm turned", whole.vertices, faces))
    assert mended.signed_volume() == pytest.approx(whole.signed_volume(), rel=1e-9)


def test_a_hole_stays_a_hole_and_faces_stay_outward() -> None:
    whole = ball(subdivisions=3)
    vertices, faces = repair("holed", whole.vertices, whole.faces[20:, ::-1])
    mended = Mesh("mended", vertices, faces)
    assert len(faces) == len(whole.faces) - 20 and not is_closed(mended)
    outward = np.einsum("ij,ij->i", mended.normals, mended.vertices[mended.faces].mean(axis=1) - whole.centre)
    assert (outward > 0).all()


def test_pieces_that_touch_in_a_point_are_parted_and_both_turned_outward() -> None:
    upper, lower = ball(0.3, (0.0, 1.3, 0.0), 3), ball(0.3, (0.0, 0.7, 0.0), 3)
    bottom, top = upper.vertices[:, 1].argmin(), lower.vertices[:, 1].argmax()
    vertices = np.concatenate([upper.vertices, lower.vertices - lower.vertices[top] + upper.vertices[bottom]])
    faces = np.concatenate([upper.faces, lower.faces[:, ::-1] + len(upper.vertices)])
    mended = Mesh("mended", *repair("touching", vertices, faces))
    assert len(mended.vertices) == len(vertices) and is_closed(mended)
    assert mended.signed_volume() == pytest.approx(2 * upper.signed_volume(), rel=1e-5)


def test_what_cannot_be_repaired_is_a_bad_mesh() -> None:
    whole = ball(subdivisions=1)
    with pytest.raises(BadMesh, match="needs vertices and faces, found 42 and 0"):
        repair("empty", whole.vertices, np.zeros((0, 3), np.int32))
    with pytest.raises(BadMesh, match=r"vertices 0 to 41, found .0, 1, 42. at face 0"):
        repair("index", whole.vertices, np.array([[0, 1, 42]]))
    with pytest.raises(BadMesh, match="must be whole numbers, found float64"):
        repair("float", whole.vertices, np.array([[0.0, 1.0, 2.0]]))
    broken = whole.vertices.copy()
    broken[7] = np.inf
    with pytest.raises(BadMesh, match=r"finite.*at vertex 7"):
        repair("infinite", broken, whole.faces)
    with pytest.raises(BadMesh, match="no face has an area"):
        repair("flat", whole.vertices, np.array([[0, 0, 1], [2, 2, 2]]))


def test_a_surface_with_one_side_cannot_be_oriented() -> None:
    """A Moebius strip."""
    turn = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    along = np.stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)], axis=1)
    across = np.stack([np.cos(turn / 2) * np.cos(turn), np.cos(turn / 2) * np.sin(turn), np.sin(turn / 2)], axis=1)
    vertices = np.stack([along - 0.2 * across, along + 0.2 * across], axis=1).reshape(-1, 3)
    faces = []
    for i in range(24):
        a, b = 2 * i, 2 * i + 1
        c, d = (2 * i + 2, 2 * i + 3) if i < 23 else (1, 0)
        faces += [[a, b, c], [b, d, c]]
    with pytest.raises(BadMesh, match="mesh strip cannot be repaired: it has one side only"):
        repair("strip", vertices, np.array(faces))


def test_a_filter_that_fails_is_a_bad_mesh(pymeshlab: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise pymeshlab.PyMeshLabException("filter\nfailed")

    monkeypatch.setattr(pymeshlab.MeshSet, "meshing_remove_null_faces", fail)
    whole = ball(subdivisions=1)
    with pytest.raises(BadMesh, match="mesh ball cannot be repaired: filter failed"):
        repair("ball", whole.vertices, whole.faces)


def test_missing_library_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = ball(subdivisions=1)
    monkeypatch.setattr(libraries, "can_load", lambda name: name != "OpenGL")
    with pytest.raises(MissingLibrary, match=r"mesh repair needs libOpenGL: apt-get install libopengl0$"):
        repair("ball", whole.vertices, whole.faces)


def test_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = ball(subdivisions=1)
    monkeypatch.setitem(sys.modules, "pymeshlab", None)
    with pytest.raises(MissingLibrary, match=r"package 'pymeshlab': pip install 'bodyseg\[pymeshlab\]'"):
        repair("ball", whole.vertices, whole.faces)
