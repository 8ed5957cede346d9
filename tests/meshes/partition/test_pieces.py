"""Pieces over a body: which labels they take, and what they leave alone."""

from __future__ import annotations

import numpy as np
import pytest
from shapes import ball, evenly_drawn
from spheres import icosphere

from bodyseg_data.bodies import Body
from bodyseg_data.core import BadLandmarks
from bodyseg_data.labels import BACKGROUND
from bodyseg_data.meshes import Mesh, SurfacePiece, partition

WHOLE = ball(subdivisions=4)
LANDMARKS = evenly_drawn(WHOLE)
COUNT = len(WHOLE.vertices)


def with_a_ball_over(at: tuple[float, float, float], radius_m: float = 0.04) -> Mesh:
    points, faces = icosphere(2, radius_m)
    return Mesh(
        "two balls", np.concatenate([WHOLE.vertices, points + at]), np.concatenate([WHOLE.faces, faces + COUNT])
    )


def test_a_piece_takes_the_nearest_label_of_those_that_it_covers() -> None:
    mesh = with_a_ball_over((0.0, 0.9, 0.55), radius_m=0.3)  # large: it meets several parts, and goes into the body
    free = partition(mesh, LANDMARKS)
    found = set(np.unique(free.labels[COUNT:]))
    left_out = int(np.bincount(free.labels[COUNT:]).argmax())
    parts = tuple(sorted(set(range(33)) - {left_out}))
    result = partition(mesh, LANDMARKS, pieces=[SurfacePiece(COUNT + 5, parts)])
    assert left_out in found and left_out not in result.labels[COUNT:]
    assert np.isinf(result.distance[COUNT:]).all()
    np.testing.assert_array_equal(result.labels[:COUNT], free.labels[:COUNT])
    allowed = np.flatnonzero(result.labels[:COUNT] != left_out)
    for vertex in (COUNT, COUNT + 20):
        apart = np.linalg.norm(mesh.vertices[allowed] - mesh.vertices[vertex], axis=1)
        assert result.labels[vertex] == result.labels[allowed[apart.argmin()]]


def test_a_thing_gets_no_label_and_changes_none() -> None:
    mesh = with_a_ball_over((0.0, 0.9, 0.6))
    result = Body(mesh, LANDMARKS, pieces=(SurfacePiece(COUNT),)).partition()
    assert set(result.labels[COUNT:]) == {BACKGROUND}
    np.testing.assert_array_equal(result.labels[:COUNT], partition(WHOLE, LANDMARKS).labels)
    thing = np.flatnonzero((mesh.faces >= COUNT).all(axis=1)).astype(np.int32)
    points = mesh.vertices[mesh.faces[thing]].mean(axis=1)
    assert set(result.labels_at(mesh, thing, points)) == {BACKGROUND}


@pytest.mark.parametrize(
    ("vertex", "parts", "words"),
    [
        (0, (), "the piece at vertex 0 is the body, not over it"),
        (COUNT + 10_000, (), "must be a vertex, found"),
        (COUNT, (33,), "must cover parts 0 to 32, found"),
    ],
)
def test_what_is_no_piece_over_the_body_is_refused(vertex: int, parts: tuple[int, ...], words: str) -> None:
    mesh = with_a_ball_over((0.0, 0.9, 0.6))
    with pytest.raises(BadLandmarks, match=words):
        partition(mesh, LANDMARKS, pieces=[SurfacePiece(vertex, parts)])
