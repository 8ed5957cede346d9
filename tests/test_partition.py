"""Geodesic parts: exact on surfaces whose distances are known, and calm on surfaces that are broken."""

from __future__ import annotations

import math
import sys
from typing import Any

import numpy as np
import pytest
from shapes import ball, figure

from bodyseg_data.errors import BadLandmarks, BadMesh, MissingLibrary
from bodyseg_data.mesh import Mesh
from bodyseg_data.partition import _nearest_corner, part_areas, partition
from bodyseg_data.parts import PART_COUNT


def spread(mesh: Mesh, seed: int = 0) -> Any:
    """33 different vertices of the surface."""
    return np.random.default_rng(seed).choice(np.unique(mesh.faces), PART_COUNT, replace=False).astype(np.int64)


def box_mesh(steps: int = 12, side: float = 1.0, depth: float = 0.1) -> Mesh:
    """A flat box, `side` square and `depth` thick, every face a square grid; its front is the plane z = depth."""
    points: dict[tuple[float, float, float], int] = {}
    faces: list[list[int]] = []

    def index(point: Any) -> int:
        key = tuple(round(float(value), 9) for value in point)
        return points.setdefault((key[0], key[1], key[2]), len(points))

    size = np.array([side, side, depth])
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        nu, nv = (1 if extent == 2 else steps for extent in (u, v))
        for outer in (0, 1):
            for i in range(nu):
                for j in range(nv):
                    corners = []
                    for du, dv in ((0, 0), (1, 0), (1, 1), (0, 1)):
                        point = np.zeros(3)
                        point[axis], point[u], point[v] = outer, (i + du) / nu, (j + dv) / nv
                        corners.append(index(point * size))
                    a, b, c, d = corners if outer else corners[::-1]
                    faces += [[a, b, c], [a, c, d]]
    return Mesh("box", np.array(list(points)), np.array(faces))


def test_distances_on_a_flat_grid_are_straight_lines_not_paths_along_edges() -> None:
    mesh = box_mesh()
    front = np.flatnonzero(mesh.vertices[:, 2] == 0.1)
    middle = front[np.linalg.norm(mesh.vertices[front, :2] - 0.5, axis=1).argsort()]
    landmarks = middle[:PART_COUNT]  # a patch in the middle, so that nothing on the front is nearer over an edge
    result = partition(mesh, landmarks)
    straight = np.linalg.norm(mesh.vertices[front, None] - mesh.vertices[landmarks], axis=2)
    np.testing.assert_allclose(result.distance[front], straight.min(axis=1), atol=1e-9)
    sure = np.diff(np.sort(straight, axis=1)[:, :2], axis=1)[:, 0] > 1e-9
    np.testing.assert_array_equal(result.labels[front][sure], straight.argmin(axis=1)[sure])


def test_distances_on_a_ball_are_great_circles() -> None:
    mesh = ball(radius_m=0.5, subdivisions=4)
    landmarks = spread(mesh)
    result = partition(mesh, landmarks)
    ways = (mesh.vertices - mesh.centre) / 0.5
    circles = 0.5 * np.arccos(np.clip(ways @ ways[landmarks].T, -1, 1))
    # The facets lie inside the ball, so a way along them is a little shorter: 0.2 % at this fineness.
    np.testing.assert_allclose(result.distance, circles.min(axis=1), rtol=3e-3, atol=1e-6)
    ordered = np.sort(circles, axis=1)
    sure = ordered[:, 1] - ordered[:, 0] > 2e-3
    assert sure.mean() > 0.9
    np.testing.assert_array_equal(result.labels[sure], circles.argmin(axis=1)[sure])


def test_labels_equal_33_runs_from_one_landmark_each() -> None:
    from pygeodesic.geodesic import PyGeodesicAlgorithmExact

    rng = np.random.default_rng(5)
    smooth = ball(subdivisions=3)
    rough = smooth.vertices + rng.normal(0, 0.01, smooth.vertices.shape)
    mesh = Mesh("potato", rough * (0.6, 1.6, 0.4), smooth.faces)
    landmarks = spread(mesh, 3)
    solver = PyGeodesicAlgorithmExact(mesh.vertices, mesh.faces)
    alone = np.stack([solver.geodesicDistances(np.array([vertex]))[0] for vertex in landmarks], axis=1)
    result = partition(mesh, landmarks)
    np.testing.assert_allclose(result.distance, alone.min(axis=1), atol=1e-9)
    np.testing.assert_array_equal(result.labels, alone.argmin(axis=1))
    assert len(np.unique(result.labels)) == PART_COUNT


def test_every_landmark_lies_in_its_own_part() -> None:
    mesh = figure()
    landmarks = spread(mesh)
    result = partition(mesh, landmarks)
    np.testing.assert_array_equal(result.labels[landmarks], np.arange(PART_COUNT))
    np.testing.assert_array_equal(result.distance[landmarks], 0)
    assert (result.labels.dtype, result.distance.dtype) == (np.uint8, np.float64)
    assert not result.labels.flags.writeable and not result.distance.flags.writeable


def test_a_piece_without_landmarks_takes_the_label_of_the_nearest_surface() -> None:
    whole = ball(subdivisions=4)
    eye = ball(subdivisions=1)
    small = (eye.vertices - eye.centre) * 0.04 + (0.0, 0.9, 0.53)  # hovers 1 cm before the front of the ball
    vertices = np.concatenate([whole.vertices, small])
    mesh = Mesh("ball with eye", vertices, np.concatenate([whole.faces, eye.faces + len(whole.vertices)]))
    landmarks = spread(whole)
    front = int(np.linalg.norm(whole.vertices - (0.0, 0.9, 0.5), axis=1).argmin())
    landmarks[7] = front
    result = partition(mesh, landmarks)
    count = len(whole.vertices)
    assert set(result.labels[count:]) == {7}
    assert np.isinf(result.distance[count:]).all()
    alone = partition(whole, landmarks)  # the eye changes nothing elsewhere
    np.testing.assert_array_equal(result.labels[:count], alone.labels)
    np.testing.assert_array_equal(result.distance[:count], alone.distance)


def test_the_nearest_surface_counts_not_the_nearest_vertex() -> None:
    """A speck hovers over the middle of a long triangle, whose corners are farther than those of a small patch."""
    mesh = box_mesh(steps=12)
    # One big triangle above the box, all of whose corners get label 0, and far from every other vertex but the speck.
    top = np.array([[-0.4, -0.4, 0.2], [1.4, -0.4, 0.2], [0.5, 1.2, 0.2]])
    speck = np.array([[0.5, 0.2, 0.18], [0.51, 0.2, 0.18], [0.5, 0.21, 0.18]])
    count = len(mesh.vertices)
    vertices = np.concatenate([mesh.vertices, top, speck])
    faces = np.concatenate([mesh.faces, [[count, count + 1, count + 2], [count + 3, count + 4, count + 5]]])
    landmarks = np.concatenate([[count], spread(mesh)[1:]])
    result = partition(Mesh("roofed", vertices, faces), landmarks)
    assert set(result.labels[count : count + 3]) == {0}
    assert set(result.labels[count + 3 :]) == {0}
    nearest = np.linalg.norm(vertices[: count + 3] - speck[0], axis=1).argmin()
    assert result.labels[nearest] != 0  # by nearest vertex the answer would have been another


def test_vertices_without_faces_do_no_harm() -> None:
    whole = figure()
    landmarks = spread(whole)
    shift = 3
    loose = np.array([[0.0, 1.0, 0.2], [0.1, 0.5, 0.0], [0.0, 1.7, 0.0]])
    mesh = Mesh("loose", np.concatenate([loose, whole.vertices]), whole.faces + shift)
    result = partition(mesh, landmarks + shift)
    np.testing.assert_array_equal(result.labels[shift:], partition(whole, landmarks).labels)
    assert np.isinf(result.distance[:shift]).all()
    assert result.labels[:shift].max() < PART_COUNT


def test_pieces_that_meet_in_one_point_only_are_all_labelled() -> None:
    one = ball(radius_m=0.4, subdivisions=3)
    top, bottom = (int(pick(one.vertices[:, 1])) for pick in (np.argmax, np.argmin))
    other = one.vertices.copy()
    other[:, 1] += one.vertices[top, 1] - one.vertices[bottom, 1]
    count = len(one.vertices)
    faces = np.concatenate([one.faces, np.where(one.faces == bottom, top - count, one.faces) + count])
    mesh = Mesh("hourglass", np.concatenate([one.vertices, other]), faces)
    result = partition(mesh, spread(one))
    assert np.isfinite(result.distance[:count]).all()
    assert np.isinf(result.distance[count:]).all()  # a point lets no way along the surface through
    touching = np.unique(faces[(faces == top).any(axis=1)])
    assert set(result.labels[touching[touching >= count]]) == {result.labels[top]}


def test_areas_are_shares_of_the_surface() -> None:
    mesh = box_mesh(steps=12, side=1.0, depth=0.1)
    labels = np.where(mesh.vertices[:, 2] == 0.1, 3, 8).astype(np.uint8)
    shares = part_areas(mesh, labels)
    # Front and back are a square metre each, the rim 0.4 m2, half of whose corners lie on the front.
    assert shares.shape == (PART_COUNT,)
    assert shares[3] == pytest.approx(0.5)
    assert shares[8] == pytest.approx(0.5)
    assert shares.sum() == pytest.approx(1.0)
    half = ball(subdivisions=4)
    below = (half.vertices[:, 1] < 0.9 - 0.25).astype(np.uint8)  # a cap has area 2 pi r h: a quarter of the ball
    assert part_areas(half, below)[1] == pytest.approx(0.25, abs=0.01)


def changed(landmarks: Any, position: int, vertex: int) -> Any:
    landmarks = landmarks.copy()
    landmarks[position] = vertex
    return landmarks


def test_bad_landmarks_are_refused_by_name() -> None:
    whole = figure()
    good = spread(whole)
    mesh = Mesh("m", np.concatenate([whole.vertices, [[0.0, 1.0, 0.0]]]), whole.faces)
    last = len(whole.vertices)
    for landmarks, message in (
        (good[:32], r"mesh m: landmarks must be 33 whole numbers, found int64 \(32,\)"),
        (good[None], r"33 whole numbers, found int64 \(1, 33\)"),
        (good.astype(float), r"33 whole numbers, found float64 \(33,\)"),
        (changed(good, 2, -1), f"must be vertices 0 to {last}, found Supramenton at -1"),
        (changed(good, 2, last + 1), f"must be vertices 0 to {last}, found Supramenton at {last + 1}"),
        (changed(good, 2, last), f"must lie on the surface, found Supramenton at {last}"),
        (changed(good, 2, good[1]), f"must be different vertices, found Nuchale and Supramenton at {good[1]}"),
    ):
        with pytest.raises(BadLandmarks, match=message):
            partition(mesh, landmarks)


def test_landmarks_that_share_one_place_are_refused() -> None:
    whole = ball(subdivisions=3)
    a, b = whole.faces[0, :2]
    vertices = whole.vertices.copy()
    vertices[b] = vertices[a]
    rest = np.setdiff1d(np.arange(len(vertices)), whole.faces[0])[:31]
    with pytest.raises(BadLandmarks, match="landmarks must lie in different places, found .*Sellion"):
        partition(Mesh("m", vertices, whole.faces), np.concatenate([[a, b], rest]))


def test_surfaces_that_would_crash_the_solver_are_refused() -> None:
    whole = ball(subdivisions=3)
    landmarks = spread(whole)
    a, b, _ = whole.faces[0]
    far = int(np.linalg.norm(whole.vertices - whole.vertices[a], axis=1).argmax())
    with pytest.raises(BadMesh, match=r"mesh fin: an edge may have two faces at most, found 3 .*repair it first"):
        partition(Mesh("fin", whole.vertices, np.concatenate([whole.faces, [[a, b, far]]])), landmarks)
    with pytest.raises(BadMesh, match=r"an edge may have two faces at most, found 4"):
        partition(Mesh("twice", whole.vertices, np.concatenate([whole.faces, whole.faces])), landmarks)
    with pytest.raises(BadMesh, match=rf"three different vertices, found \[{a}, {a}, {b}\] at face 1280"):
        partition(Mesh("line", whole.vertices, np.concatenate([whole.faces, [[a, a, b]]])), landmarks)


def test_a_surface_with_a_hole_and_with_slivers_is_labelled() -> None:
    whole = ball(subdivisions=3)
    vertices = whole.vertices.copy()
    a, b, c = whole.faces[200]
    vertices[c] = (vertices[a] + vertices[b]) / 2  # no area
    mesh = Mesh("m", vertices, np.delete(whole.faces, slice(0, 40), axis=0))
    result = partition(mesh, spread(mesh))
    used = np.unique(mesh.faces)
    assert np.isfinite(result.distance[used]).all()
    assert result.distance.max(initial=0, where=np.isfinite(result.distance)) < math.pi / 2


@pytest.mark.parametrize("package", ["pygeodesic.geodesic", "scipy.sparse"])
def test_a_missing_package_says_how_to_install_it(package: str, monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = ball(subdivisions=3)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MissingLibrary, match=r"pip install 'bodyseg\[render\]'"):
        partition(mesh, spread(mesh))


def test_a_missing_package_for_separate_pieces_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rtree", None)
    whole = figure()
    head = spread(ball(subdivisions=3)) + 642  # on the second of five pieces only
    with pytest.raises(MissingLibrary, match=r"pip install 'bodyseg\[render\]'"):
        partition(whole, head)


def test_looking_only_at_nearby_triangles_gives_the_answer_of_looking_at_all(monkeypatch: pytest.MonkeyPatch) -> None:
    import trimesh

    mesh = ball(subdivisions=3)
    points = np.random.default_rng(2).normal((0.1, 1.2, 0.3), 0.12, (60, 3))
    asked: list[int] = []
    whole = trimesh.proximity.closest_point

    def counted(surface: Any, points: Any) -> Any:
        asked.append(len(surface.faces))
        return whole(surface, points)

    monkeypatch.setattr(trimesh.proximity, "closest_point", counted)
    found = _nearest_corner(mesh.vertices, mesh.faces, points)
    everything = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    closest, away, _ = whole(everything, points)
    assert asked[0] < len(mesh.faces)
    # The vertex found is a corner of a triangle that holds the closest point.
    corners = mesh.vertices[mesh.faces]
    for point, place, distance, vertex in zip(points, closest, away, found, strict=True):
        held = np.flatnonzero((mesh.faces == vertex).any(axis=1))
        small = trimesh.triangles.closest_point(corners[held], np.broadcast_to(point, (len(held), 3)))
        assert np.linalg.norm(small - point, axis=1).min() == pytest.approx(distance, abs=1e-9), place
