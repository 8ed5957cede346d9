"""Geodesic parts: exact on surfaces whose distances are known, and calm on surfaces that are broken."""

from __future__ import annotations

import math
import sys
from typing import Any, get_args

import numpy as np
import pytest
from benches.data.surface.areas import part_areas
from benches.data.surface.partition import partition_unmended
from shapes import ball, box_mesh, evenly_drawn, figure

from bodyseg_data.core import BadConfig, BadLandmarks, MissingLibrary
from bodyseg_data.labels import PART_COUNT
from bodyseg_data.meshes import GeodesicMethod, Mesh, geodesics, partition
from bodyseg_data.meshes.geodesics import FALLBACK_METHOD, Unanswerable
from bodyseg_data.meshes.landmarks import nearest_corner


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
    landmarks = evenly_drawn(mesh)
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
    landmarks = evenly_drawn(mesh, 3)
    solver = PyGeodesicAlgorithmExact(mesh.vertices, mesh.faces)
    alone = np.stack([solver.geodesicDistances(np.array([vertex]))[0] for vertex in landmarks], axis=1)
    result = partition(mesh, landmarks)
    np.testing.assert_allclose(result.distance, alone.min(axis=1), atol=1e-9)
    np.testing.assert_array_equal(result.labels, alone.argmin(axis=1))
    assert len(np.unique(result.labels)) == PART_COUNT


def test_every_landmark_lies_in_its_own_part() -> None:
    mesh = figure()
    landmarks = evenly_drawn(mesh)
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
    landmarks = evenly_drawn(whole)
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
    landmarks = np.concatenate([[count], evenly_drawn(mesh)[1:]])
    result = partition(Mesh("roofed", vertices, faces), landmarks)
    assert set(result.labels[count : count + 3]) == {0}
    assert set(result.labels[count + 3 :]) == {0}
    nearest = np.linalg.norm(vertices[: count + 3] - speck[0], axis=1).argmin()
    assert result.labels[nearest] != 0  # by nearest vertex the answer would have been another


def test_vertices_without_faces_do_no_harm() -> None:
    whole = figure()
    landmarks = evenly_drawn(whole)
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
    result = partition(mesh, evenly_drawn(one))
    assert np.isfinite(result.distance[:count]).all()
    touching = np.unique(faces)[np.unique(faces) >= count]
    assert (result.distance[touching] > result.distance[top]).all()  # the only way leads through the point
    assert set(result.labels[touching]) == {result.labels[top]}
    assert result.note is not None and "through 1 vertices that alone hold sheets together" in result.note


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
    good = evenly_drawn(whole)
    mesh = Mesh("m", np.concatenate([whole.vertices, [[0.0, 1.0, 0.0]]]), whole.faces)
    last = len(whole.vertices)
    for landmarks, message in (
        (good[:32], r"mesh m: landmarks .* found int64 \(32,\)"),
        (good[None], r"33 whole numbers, found int64 \(1, 33\)"),
        (good.astype(float), r"33 whole numbers, found float64 \(33,\)"),
        (changed(good, 2, -1), "must lie on the surface, found Supramenton at -1"),
        (changed(good, 2, last + 1), f"must lie on the surface, found Supramenton at {last + 1}"),
        (changed(good, 2, last), f"must lie on the surface, found Supramenton at {last}"),
        (changed(good, 2, good[1]), "different places, found Nuchale and Supramenton at "),
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


def test_a_sound_body_has_no_note() -> None:
    mesh = ball(subdivisions=3)
    for method in get_args(GeodesicMethod):
        assert partition(mesh, evenly_drawn(mesh), method).note is None


def test_what_would_crash_the_solver_is_mended_and_the_rest_keeps_its_labels() -> None:
    whole = ball(subdivisions=3)
    landmarks = evenly_drawn(whole)
    sound = partition(whole, landmarks)
    a, b, _ = whole.faces[0]
    count = len(whole.vertices)
    tip = whole.vertices[a] * 1.02
    for name, vertices, faces, note in (
        ("fin", np.concatenate([whole.vertices, [tip]]), [[a, b, count]], "1 faces left out at edges of more than two"),
        ("twice", whole.vertices, whole.faces, "1280 doubled faces left out"),
        ("line", whole.vertices, [[a, a, b]], "1 faces with no more than two places left out"),
    ):
        mesh = Mesh(name, vertices, np.concatenate([whole.faces, faces]))
        with pytest.raises(Unanswerable, match="the method 'exact' cannot answer: "):
            partition_unmended(mesh, landmarks, "exact")
        result = partition(mesh, landmarks)
        assert result.note == f"distances by the method 'exact': {note}"
        np.testing.assert_array_equal(result.labels[:count], sound.labels)
        np.testing.assert_array_equal(result.distance[:count], sound.distance)


def test_seams_that_are_not_welded_change_nothing() -> None:
    """Every triangle has vertices of its own; borders run through them as through the welded ones."""
    whole = ball(subdivisions=3)
    landmarks = evenly_drawn(whole)
    corners = whole.faces.ravel()
    loose = Mesh("loose", whole.vertices[corners], np.arange(len(corners)).reshape(-1, 3))
    own = np.array([np.flatnonzero(corners == landmark)[-1] for landmark in landmarks])
    sound, result = partition(whole, landmarks), partition(loose, own)
    assert (
        result.note
        == f"distances by the method 'exact': {len(corners) - 642} vertices joined to others in the same place"
    )
    np.testing.assert_allclose(result.distance, sound.distance[corners], atol=1e-12)
    faces = np.arange(len(whole.faces)).repeat(8).astype(np.int32)
    weights = np.random.default_rng(1).dirichlet([1, 1, 1], len(faces))
    points = np.einsum("nc,ncd->nd", weights, whole.vertices[whole.faces[faces]])
    differs = result.labels_at(loose, faces, points) != sound.labels_at(whole, faces, points)
    assert differs.mean() < 1e-3  # points in the middle between two landmarks
    unmended = partition_unmended(loose, own, "exact")
    assert (unmended.labels_at(loose, faces, points) != sound.labels_at(whole, faces, points)).mean() > 0.05


def test_a_method_that_cannot_answer_is_replaced_and_the_note_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = ball(subdivisions=3)
    landmarks = evenly_drawn(mesh)
    wanted = partition(mesh, landmarks, FALLBACK_METHOD)

    def too_thin(*arguments: Any) -> Any:
        raise Unanswerable("the method 'exact' cannot answer: it is tired")

    monkeypatch.setitem(geodesics.METHODS, "exact", too_thin)
    result = partition(mesh, landmarks)
    assert result.note == "distances by the method 'unfolded': the method 'exact' cannot answer: it is tired"
    np.testing.assert_array_equal(result.labels, wanted.labels)
    np.testing.assert_array_equal(result.distance, wanted.distance)


def test_folds_without_any_area_fall_back() -> None:
    """Vertices moved onto the opposite edges: the arithmetic of the exact method loses its way in some of them."""
    whole = ball(subdivisions=5)
    vertices, chosen = whole.vertices.copy(), np.random.default_rng(0).choice(len(whole.faces), 2000, replace=False)
    for a, b, c in whole.faces[chosen]:
        vertices[c] = (vertices[a] + vertices[b]) / 2
    result = partition(Mesh("folded", vertices, whole.faces), evenly_drawn(whole))
    assert result.note is not None and "the method 'exact' cannot answer: some triangles are too thin" in result.note
    assert np.isfinite(result.distance).all()


def test_an_unknown_method_is_refused() -> None:
    mesh = ball(subdivisions=3)
    with pytest.raises(BadConfig, match="method .*found 'euclid'"):
        partition(mesh, evenly_drawn(mesh), "euclid")  # type: ignore[arg-type]  # on purpose


def test_a_landmark_on_a_face_that_is_left_out_is_named() -> None:
    whole = ball(subdivisions=3)
    a, b, _ = whole.faces[0]
    count = len(whole.vertices)
    fin = Mesh(
        "fin",
        np.concatenate([whole.vertices, [whole.vertices[a] * 1.02]]),
        np.concatenate([whole.faces, [[a, b, count]]]),
    )
    with pytest.raises(BadLandmarks, match="mended away at Supramenton"):
        partition(fin, changed(evenly_drawn(whole), 2, count))


def test_a_surface_with_a_hole_and_with_slivers_is_labelled() -> None:
    whole = ball(subdivisions=3)
    vertices = whole.vertices.copy()
    a, b, c = whole.faces[200]
    vertices[c] = (vertices[a] + vertices[b]) / 2  # no area
    mesh = Mesh("m", vertices, np.delete(whole.faces, slice(0, 40), axis=0))
    result = partition(mesh, evenly_drawn(mesh))
    used = np.unique(mesh.faces)
    assert np.isfinite(result.distance[used]).all()
    assert result.distance.max(initial=0, where=np.isfinite(result.distance)) < math.pi / 2


@pytest.mark.parametrize("package", ["pygeodesic.geodesic", "scipy.sparse"])
def test_a_missing_package_says_how_to_install_it(package: str, monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = ball(subdivisions=3)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MissingLibrary, match=r"pip install 'bodyseg\[render\]'"):
        partition(mesh, evenly_drawn(mesh))


def test_a_missing_package_for_separate_pieces_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rtree", None)
    whole = figure()
    head = evenly_drawn(ball(subdivisions=3)) + 642  # on the second of five pieces only
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
    found, distances = nearest_corner(mesh.vertices, mesh.faces, points)
    everything = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    closest, away, _ = whole(everything, points)
    assert asked[0] < len(mesh.faces)
    np.testing.assert_allclose(distances, away, rtol=0, atol=1e-12)
    # The vertex found is a corner of a triangle that holds the closest point.
    corners = mesh.vertices[mesh.faces]
    for point, place, distance, vertex in zip(points, closest, away, found, strict=True):
        held = np.flatnonzero((mesh.faces == vertex).any(axis=1))
        small = trimesh.triangles.closest_point(corners[held], np.broadcast_to(point, (len(held), 3)))
        assert np.linalg.norm(small - point, axis=1).min() == pytest.approx(distance, abs=1e-9), place
