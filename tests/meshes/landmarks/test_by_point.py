"""Landmarks by coordinate: put onto the surface, the distance reported, and what does not fit refused by name."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from shapes import ball

from bodyseg_data.core import BadLandmarks
from bodyseg_data.labels import LANDMARKS
from bodyseg_data.meshes import LandmarkSet, Mesh, PointLandmarks, load_landmark_file
from bodyseg_data.meshes.landmarks import FARTHEST_M, nearest_corner, parse_landmarks

BALL = ball(subdivisions=3)
SPREAD = np.arange(33) * 19
"""33 vertices of the ball far from each other."""


def on_ball(away_m: float = 0.0) -> NDArray[np.float64]:
    """Points `away_m` outside 33 vertices of the ball."""
    ways = (BALL.vertices[SPREAD] - BALL.centre) / 0.5
    points: NDArray[np.float64] = BALL.vertices[SPREAD] + away_m * ways
    return points


def with_small_ball() -> Mesh:
    """The ball and a small one beside it, as a second piece of the surface."""
    small = ball(subdivisions=2)
    vertices = np.concatenate([BALL.vertices, 0.1 * small.vertices + (0.8, 0.9, 0.0)])
    return Mesh("two balls", vertices, np.concatenate([BALL.faces, small.faces + len(BALL.vertices)]))


@pytest.mark.parametrize("away_m", [0.0, 0.01, -0.02])
def test_points_come_to_their_vertices_and_report_their_distance(away_m: float) -> None:
    snapped = PointLandmarks("here", on_ball(away_m)).for_mesh(BALL)
    assert snapped.vertices.dtype == np.int64
    np.testing.assert_array_equal(snapped.vertices, SPREAD)
    # Inwards the faces round the vertex are a little nearer than the vertex.
    np.testing.assert_allclose(snapped.distance_m, abs(away_m), rtol=0.02, atol=1e-9)


def test_the_distance_is_to_the_surface_and_the_vertex_a_corner_there() -> None:
    rng = np.random.default_rng(0)
    faces = rng.choice(len(BALL.faces), 40, replace=False)
    weights = rng.dirichlet((1, 1, 1), 40)
    points = np.einsum("nk,nkd->nd", weights, BALL.vertices[BALL.faces[faces]])
    vertices, distance = nearest_corner(BALL.vertices, BALL.faces, points)
    np.testing.assert_allclose(distance, 0, atol=1e-9)
    away = np.linalg.norm(BALL.vertices[BALL.faces[faces]] - points[:, None], axis=2)
    np.testing.assert_array_equal(vertices, BALL.faces[faces, away.argmin(axis=1)])


def test_a_triangle_without_area_attracts_nothing() -> None:
    mesh = Mesh("flat", BALL.vertices, np.concatenate([[[0, 0, 1]], BALL.faces]))
    snapped = PointLandmarks("here", on_ball(0.01)).for_mesh(mesh)
    np.testing.assert_array_equal(snapped.vertices, SPREAD)


def test_landmarks_move_as_their_mesh_does() -> None:
    turn = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
    moved = PointLandmarks("here", on_ball()).transformed(0.5, turn)
    np.testing.assert_allclose(moved.points, 0.5 * np.array([turn @ point for point in on_ball()]))
    assert moved.source == "here"


def test_a_landmark_off_the_surface_is_named_with_its_distance() -> None:
    points = on_ball()
    points[9] += (0.0, 0.0, 0.2)
    off = nearest_corner(BALL.vertices, BALL.faces, points)[1][9]
    message = rf"here on mesh ball: .* within 3 cm .*, found 'Cervicale' {100 * off:.1f} cm off it"
    with pytest.raises(BadLandmarks, match=message) as caught:
        PointLandmarks("here", points).for_mesh(BALL)
    assert "\n" not in str(caught.value)


def test_the_limit_is_what_it_says() -> None:
    for away_m, fine in ((0.98 * FARTHEST_M, True), (1.02 * FARTHEST_M, False)):
        landmarks = PointLandmarks("here", on_ball(away_m))
        if fine:
            landmarks.for_mesh(BALL)
        else:
            with pytest.raises(BadLandmarks, match="'.*' 3.1 cm off"):
                landmarks.for_mesh(BALL)


def test_of_two_landmarks_on_one_vertex_one_moves_and_three_are_named() -> None:
    points = on_ball()
    points[20] = points[3] + 0.001
    snapped = PointLandmarks("here", points).for_mesh(BALL)
    assert snapped.vertices[3] == SPREAD[3] and len(set(snapped.vertices.tolist())) == 33
    (note,) = snapped.notes
    assert note.startswith(f"{LANDMARKS[20]} moved by ") and note.endswith("in one place with Suprasternale")
    points[30] = points[3]
    with pytest.raises(BadLandmarks, match=f"'Suprasternale', {LANDMARKS[20]!r}, {LANDMARKS[30]!r} at {SPREAD[3]}"):
        PointLandmarks("here", points).for_mesh(BALL)


def test_a_landmark_on_another_piece_is_named() -> None:
    mesh = with_small_ball()
    points = on_ball()
    points[17] = mesh.vertices[len(BALL.vertices) + 5]
    with pytest.raises(BadLandmarks, match=r"must lie on one piece, found 'Rt\. Olecranon' on another"):
        PointLandmarks("here", points).for_mesh(mesh)


def test_points_on_one_mesh_serve_all_of_its_topology() -> None:
    snapped = PointLandmarks("here", on_ball(0.005)).for_mesh(BALL)
    landmarks = LandmarkSet("here", "balls", 642, 1280, tuple(snapped.vertices.tolist()))
    np.testing.assert_allclose(snapped.distance_m, 0.005)
    assert landmarks == LandmarkSet("here", "balls", 642, 1280, tuple(SPREAD.tolist()))
    other = Mesh("flat ball", BALL.vertices * (1, 0.7, 1), BALL.faces)
    np.testing.assert_array_equal(landmarks.for_mesh(other), SPREAD)
    again = parse_landmarks(landmarks.to_json(), "here")
    assert again == landmarks


def tree(units: str = "m", scale: float = 1.0, **changes: Any) -> dict[str, Any]:
    points = {name: point.tolist() for name, point in zip(LANDMARKS, on_ball() * scale, strict=True)}
    return {"format": "bodyseg landmarks 1", "units": units, "points": points, **changes}


@pytest.mark.parametrize(("units", "scale"), [("m", 1), ("cm", 100), ("mm", 1000), ("in", 1 / 0.0254)])
def test_a_file_of_points_is_read_in_its_unit(tmp_path: Path, units: str, scale: float) -> None:
    path = tmp_path / "points.json"
    path.write_text(json.dumps(tree(units, scale)))
    landmarks = load_landmark_file(path)
    assert isinstance(landmarks, PointLandmarks)
    assert landmarks.source == str(path)
    np.testing.assert_allclose(landmarks.points, on_ball(), rtol=1e-12)


def test_a_file_by_vertex_is_told_from_one_by_coordinate(tmp_path: Path) -> None:
    path = tmp_path / "vertices.json"
    path.write_text(LandmarkSet("x", "balls", 642, 1280, tuple(SPREAD.tolist())).to_json())
    landmarks = load_landmark_file(path)
    assert isinstance(landmarks, LandmarkSet)
    assert landmarks.vertices == tuple(SPREAD)


POINTS = tree()["points"]
BROKEN = {
    "unit": (tree(units="feet"), "'units' must be one of m, cm, mm, in, found 'feet'"),
    "unit of another type": (tree(units=["m"]), r"'units' must be text, found \['m'\]"),
    "key": (tree(topology="x"), "unknown 'topology'"),
    "both kinds": (tree(landmarks={}), "unknown 'landmarks'"),
    "no units": ({key: value for key, value in tree().items() if key != "units"}, "text 'units' is missing"),
    "no table": (tree(points=[1]), r"'points' must be a table, found \[1\]"),
    "missing": (tree(points={n: p for n, p in POINTS.items() if n != "Sellion"}), "landmark 'Sellion' is missing"),
    "misspelt": (
        tree(points={n.replace("Lt. Acromion", "Lt. Akromion"): p for n, p in POINTS.items()} | {"Crotch": [1, 2, 3]}),
        r"landmark 'Lt\. Acromion' \(misspelt as 'Lt\. Akromion'\?\) is missing",
    ),
    "short": (tree(points={**POINTS, "Nuchale": [1, 2]}), r"'Nuchale' must be 3 finite numbers, found \[1, 2\]"),
    "text": (tree(points={**POINTS, "Nuchale": [1, 2, "3"]}), "'Nuchale' must be 3 finite numbers"),
    "truth": (tree(points={**POINTS, "Nuchale": [1, 2, True]}), "'Nuchale' must be 3 finite numbers"),
    "not finite": (tree(points={**POINTS, "Nuchale": [1, 2, float("nan")]}), "'Nuchale' must be 3 finite numbers"),
    "huge": (tree(points={**POINTS, "Nuchale": [1, 2, 10**400]}), "'Nuchale' must be 3 finite numbers"),
    "format": (tree(format="x"), "'format' must be"),
}


@pytest.mark.parametrize(("broken", "message"), BROKEN.values(), ids=BROKEN)
def test_a_broken_file_of_points_is_refused(tmp_path: Path, broken: Any, message: str) -> None:
    path = tmp_path / "broken.json"
    path.write_text(json.dumps(broken))
    with pytest.raises(BadLandmarks, match=message) as caught:
        load_landmark_file(path)
    assert str(path) in str(caught.value)


def test_another_kind_of_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadLandmarks, match=r"must be .json, .lnd or .lnd.gz, found .*landmarks\.txt"):
        load_landmark_file(tmp_path / "landmarks.txt")
    with pytest.raises(BadLandmarks, match=r"cannot read .*absent\.json"):
        load_landmark_file(tmp_path / "absent.json")


def test_a_file_may_hold_more_than_the_33(tmp_path: Path) -> None:
    path = tmp_path / "landmarks.json"
    path.write_text(json.dumps(tree(points={"Crotch": "anything", **POINTS, "Lt. Elbow": [1, 2, 3]})))
    found = load_landmark_file(path)
    assert isinstance(found, PointLandmarks) and found.ignored == ("Crotch", "Lt. Elbow")
    path.write_text(json.dumps(tree()))
    np.testing.assert_array_equal(found.points, load_landmark_file(path).points)  # type: ignore[union-attr]
