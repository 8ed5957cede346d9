"""Surfaces mended without renumbering: what goes, what stays, and what is told."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from shapes import ball, figure

from bodyseg_data.meshes import find_edges
from bodyseg_data.meshes.mending import find_fans, mend

SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
HALVES = np.array([[0, 1, 2], [0, 2, 3]])


def mended(vertices: Any, faces: Any) -> Any:
    return mend(np.asarray(vertices, float), np.asarray(faces))


def test_edges_are_each_there_once_with_their_faces() -> None:
    edges = find_edges(HALVES)
    np.testing.assert_array_equal(edges.ends, [[0, 1], [0, 2], [0, 3], [1, 2], [2, 3]])
    np.testing.assert_array_equal(edges.faces, [1, 2, 1, 1, 1])
    np.testing.assert_array_equal(edges.of_side, [[0, 3, 1], [1, 4, 2]])
    np.testing.assert_array_equal(edges.two_sides(), [[2, 3]])
    np.testing.assert_allclose(edges.lengths(SQUARE), [1, 2**0.5, 1, 1, 1])


def test_a_sound_mesh_stays_as_it_is() -> None:
    for mesh in (ball(subdivisions=3), figure()):
        same = mended(mesh.vertices, mesh.faces)
        np.testing.assert_array_equal(same.faces, mesh.faces)
        np.testing.assert_array_equal(same.representative, np.arange(len(mesh.vertices)))
        assert same.notes == ()


def test_a_seam_is_welded_to_the_lower_vertex() -> None:
    vertices = np.concatenate([SQUARE, SQUARE[[0, 2]] + [0, 0, 4e-7]])
    result = mended(vertices, [[0, 1, 2], [4, 5, 3]])
    np.testing.assert_array_equal(result.representative, [0, 1, 2, 3, 0, 2])
    np.testing.assert_array_equal(result.faces, [[0, 1, 2], [0, 2, 3]])
    assert result.notes == ("2 vertices joined to others in the same place",)
    apart = mended(vertices + np.arange(6)[:, None] * [0, 0, 2e-6], [[0, 1, 2], [4, 5, 3]])
    assert apart.notes == ()


def test_closed_surfaces_that_touch_stay_two() -> None:
    one = ball(subdivisions=2)
    top, bottom = one.vertices[one.vertices[:, 1].argmax()], one.vertices[one.vertices[:, 1].argmin()]
    vertices = np.concatenate([one.vertices, one.vertices + top - bottom])
    assert mended(vertices, np.concatenate([one.faces, one.faces + len(one.vertices)])).notes == ()


@pytest.mark.parametrize(
    ("more", "kept", "note"),
    [
        ([[0, 0, 1]], [0, 1], "1 faces with no more than two places left out"),
        ([[1, 2, 0], [2, 1, 0]], [0, 1], "2 doubled faces left out"),
        ([[0, 2, 4]], [0, 1], "1 faces left out at edges of more than two"),
    ],
)
def test_what_is_too_much_goes(more: Any, kept: Any, note: str) -> None:
    tetrahedron = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [-9, -9, 0]])
    result = mended(vertices, np.concatenate([tetrahedron, more]))
    np.testing.assert_array_equal(result.faces, tetrahedron)
    assert result.notes == (note,)


def test_at_a_crowded_edge_faces_joined_to_others_stay_before_large_ones() -> None:
    """The extra face of 40 m2 has two open edges, so it goes; among equals the smallest goes."""
    fin = np.array([[0.0, 0, 0], [1, 0, 0], [0.5, 1, 0], [0.5, -1, 0], [0.5, 0, 0.5]])
    faces = np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]])
    np.testing.assert_array_equal(mended(fin, faces).faces, faces[:2])
    loose = mended(fin[faces].reshape(-1, 3), np.arange(9).reshape(-1, 3))
    np.testing.assert_array_equal(loose.faces, [[0, 1, 2], [1, 0, 5]], "also where the edge is there only once welded")


def test_a_needle_collapses_and_the_faces_around_it_close() -> None:
    vertices = np.concatenate([SQUARE, [[0, 0, 5e-7]]])
    result = mended(vertices, [[4, 1, 2], [0, 1, 4], [0, 4, 3], [4, 2, 3]])
    np.testing.assert_array_equal(result.faces, [[0, 1, 2], [0, 2, 3]])
    assert result.notes == (
        "1 vertices joined to others in the same place",
        "2 faces with no more than two places left out",
    )


def test_fans_count_the_sheets_at_every_vertex() -> None:
    assert find_fans(ball(subdivisions=1).faces.astype(np.int64)).max() + 1 == 42
    pinched = np.array([[0, 1, 2], [2, 3, 4], [2, 4, 5]])
    fans = find_fans(pinched)
    assert fans.max() + 1 == 7  # vertex 2 has two
    assert fans[0, 2] != fans[1, 0] == fans[2, 0]
    turned = np.array([[0, 1, 2], [0, 1, 3]])  # neighbours that disagree on their outside still hang together
    assert find_fans(turned).max() + 1 == 4
