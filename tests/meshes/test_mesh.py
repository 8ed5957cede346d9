from __future__ import annotations

import copy
import pickle
import sys
from collections.abc import Callable

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from shapes import ball, figure
from spheres import icosphere

from bodyseg_data.core import BadMesh, MissingLibrary
from bodyseg_data.meshes import Mesh, cuboid

Arrays = tuple[NDArray[np.float64], NDArray[np.int64]]


def test_a_ball_has_its_volume_centre_and_outward_normals() -> None:
    mesh = ball(0.5)
    assert mesh.signed_volume() == pytest.approx(4 / 3 * np.pi * 0.5**3, rel=0.01)
    assert mesh.centre == pytest.approx([0, 0.9, 0], abs=1e-9)
    middles = mesh.vertices[mesh.faces].mean(axis=1) - mesh.centre
    assert (np.einsum("ij,ij->i", middles, mesh.normals) > 0).all()


def test_vertex_normals_are_means_by_area_and_zero_without_faces() -> None:
    mesh = ball(0.5)
    away = (mesh.vertices - mesh.centre) / 0.5
    np.testing.assert_allclose(mesh.vertex_normals, away, atol=0.01)
    # A corner of two large faces and one of a quarter of their area: the sum of cross products, made unit length.
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 0.25], [9, 9, 9]], np.float64)
    wedge = Mesh("wedge", corners, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]))
    expected = -np.array([0.25, 0.25, 1.0]) / np.sqrt(1 + 2 / 16)
    np.testing.assert_allclose(wedge.vertex_normals[0], expected, atol=1e-15)
    np.testing.assert_array_equal(wedge.vertex_normals[4], 0)


def test_a_mesh_cannot_be_changed() -> None:
    for mesh in (ball(), pickle.loads(pickle.dumps(ball())), copy.deepcopy(ball())):
        for array in (mesh.vertices, mesh.faces):
            with pytest.raises(ValueError, match="read-only"):
                array[0] = 0


def test_a_mesh_prints_its_name_and_size() -> None:
    assert repr(ball(subdivisions=0)) == "Mesh('ball', 12 vertices, 20 faces)"


def test_unused_vertices_do_not_move_the_centre() -> None:
    mesh = ball()
    assert Mesh("x", np.vstack([mesh.vertices, [50.0, 0, 0]]), mesh.faces).centre == pytest.approx(mesh.centre)


def _nan(v: NDArray[np.float64], f: NDArray[np.int64]) -> Arrays:
    v[7, 1] = np.nan
    return v, f


def _some_turned(f: NDArray[np.int64]) -> NDArray[np.int64]:
    turned = f.copy()
    turned[::10] = turned[::10, ::-1]
    return turned


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (_nan, r"coordinates must be finite, found \[.*nan.*\] at vertex 7"),
        (lambda v, f: (v[:0], f[:0]), "needs vertices and faces, found 0 and 0"),
        (lambda v, f: (v, f[:0]), "needs vertices and faces, found 2562 and 0"),
        (lambda v, f: (v, f + 1), "faces must use vertices 0 to 2561, found .* at face"),
        (lambda v, f: (v, f - 1), "faces must use vertices 0 to 2561"),
        (lambda v, f: (v * 1000, f), "must be 0.5 to 2.5 m at its largest, found 1e\\+03 m"),
        (lambda v, f: (v / 100, f), "must be 0.5 to 2.5 m at its largest, found 0.01 m"),
        (
            lambda v, f: (v, f[:, ::-1]),
            "found -0.522 m3",
        ),
        (
            lambda v, f: (v, _some_turned(f)),
            "found a clash at",
        ),
        (lambda v, f: (v[:, :2], f), "three columns"),
        (lambda v, f: (v, f.astype(float)), "faces must be whole numbers, found float64"),
    ],
)
def test_broken_meshes_are_refused_in_one_line_that_names_them(
    spoil: Callable[[NDArray[np.float64], NDArray[np.int64]], Arrays], message: str
) -> None:
    good = ball()
    vertices, faces = spoil(good.vertices.copy(), good.faces.astype(np.int64))
    with pytest.raises(BadMesh, match=f"mesh bad: .*{message}") as caught:
        Mesh("bad", vertices, faces)  # type: ignore[arg-type]  # on purpose
    assert "\n" not in str(caught.value)


def test_one_turned_piece_of_a_body_is_refused() -> None:
    body = figure()
    faces = body.faces.copy()
    faces[-1280:] = faces[-1280:, ::-1]
    with pytest.raises(BadMesh, match="mesh leg: faces must point outwards"):
        Mesh("leg", body.vertices, faces)


def test_only_closed_pieces_must_enclose_a_volume() -> None:
    """A cavity, like a mouth's, has its faces inside; cut off by a hole it is no piece turned inside out."""
    whole, inner = ball(), ball(radius_m=0.3, subdivisions=3)
    cavity = inner.faces[:, ::-1] + len(whole.vertices)
    vertices = np.concatenate([whole.vertices, inner.vertices])
    with pytest.raises(BadMesh, match=r"mesh closed: .* found -0.1"):
        Mesh("closed", vertices, np.concatenate([whole.faces, cavity]))
    mesh = Mesh("open", vertices, np.concatenate([whole.faces, cavity[:-5]]))
    assert mesh.signed_volume() == pytest.approx(whole.signed_volume() - inner.signed_volume(), rel=5e-3)


@pytest.mark.parametrize("side", range(6))
def test_a_body_with_a_hole_is_judged_about_itself(side: int) -> None:
    """About the origin, what the hole lacks would be more than all that is there."""
    box = cuboid((1.0, 1.0, 1.0), (20.0, 20.0, 20.0))
    faces = np.delete(box.faces, [side, side + 6], axis=0)
    Mesh("open", box.vertices, faces)
    with pytest.raises(BadMesh, match="faces must point outwards"):
        Mesh("open", box.vertices, faces[:, ::-1])


def test_triangles_with_vertices_of_their_own_have_the_volume_of_the_whole() -> None:
    whole = ball(subdivisions=3)
    corners = whole.vertices[whole.faces].reshape(-1, 3)
    loose = np.arange(len(corners)).reshape(-1, 3)
    assert Mesh("loose", corners, loose).signed_volume() == pytest.approx(whole.signed_volume())
    with pytest.raises(BadMesh, match="faces must point outwards"):
        Mesh("turned", corners, loose[:, ::-1])


def test_faces_with_a_vertex_twice_do_not_clash() -> None:
    whole = ball(subdivisions=3)
    a, b, c = whole.faces[0]
    mesh = Mesh("flat", whole.vertices, np.concatenate([whole.faces, [[a, a, b], [a, a, c]]]))
    assert mesh.signed_volume() == pytest.approx(whole.signed_volume())


def test_a_missing_package_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "scipy.sparse", None)
    with pytest.raises(MissingLibrary, match=r"checking a mesh needs .*: pip install 'bodyseg\[render\]'"):
        ball()


@pytest.mark.parametrize("subdivisions", [0, 1, 3, 5])
def test_the_spheres_of_these_tests_are_those_of_trimesh(subdivisions: int) -> None:
    expected = trimesh.creation.icosphere(subdivisions=subdivisions, radius=0.3)
    vertices, faces = icosphere(subdivisions, 0.3)
    np.testing.assert_array_equal(vertices, expected.vertices)
    np.testing.assert_array_equal(faces, expected.faces)
