"""Ways to measure distance along a surface: how near they come to the exact answer, and what they refuse."""

from __future__ import annotations

import re
import sys
from typing import Any, get_args

import numpy as np
import pytest
import warm
from shapes import ball, figure

from bodyseg_data.core import BadConfig, MissingLibrary
from bodyseg_data.meshes import GeodesicMethod
from bodyseg_data.meshes.geodesics import Unanswerable, nearest_sources

METHODS: tuple[GeodesicMethod, ...] = get_args(GeodesicMethod)


def surface(subdivisions: int = 4, seed: int = 0) -> Any:
    """Vertices, faces and 20 sources of a dented ball."""
    mesh = ball(subdivisions=subdivisions)
    vertices = mesh.vertices.copy()
    vertices[:, 2] *= 1 + 0.3 * np.sin(9 * mesh.vertices[:, 1])
    sources = np.random.default_rng(seed).choice(len(vertices), 20, replace=False)
    return vertices, mesh.faces.astype(np.int64), sources


@pytest.mark.parametrize(
    ("method", "error_m", "wrong"),
    [("unfolded", 5e-3, 0.02), ("edges", 25e-3, 0.08)],
)
def test_approximate_methods_come_near_the_exact_answer(method: GeodesicMethod, error_m: float, wrong: float) -> None:
    vertices, faces, sources = surface()
    exact, answer = (nearest_sources(name, vertices, faces, sources) for name in ("exact", method))
    np.testing.assert_array_equal(exact.source[sources], np.arange(20))
    np.testing.assert_array_equal(answer.source[sources], np.arange(20))
    np.testing.assert_allclose(answer.distance[sources], 0, atol=1e-12)
    assert 0 < np.abs(answer.distance - exact.distance).mean() < error_m
    assert 0 < (answer.source != exact.source).mean() < wrong
    assert (answer.distance >= exact.distance - 1e-9).all()


def test_edges_are_shortest_paths_of_a_graph() -> None:
    vertices, faces, sources = surface(1)
    away = np.full((len(vertices), len(vertices)), np.inf)  # Floyd and Warshall: slow, but plain
    np.fill_diagonal(away, 0)
    for face in faces:
        for a, b in ((0, 1), (1, 2), (2, 0)):
            length = np.linalg.norm(vertices[face[a]] - vertices[face[b]])
            away[face[a], face[b]] = away[face[b], face[a]] = length
    for middle in range(len(vertices)):
        away = np.minimum(away, away[:, [middle]] + away[[middle]])
    answer = nearest_sources("edges", vertices, faces, sources)
    np.testing.assert_allclose(answer.distance, away[sources].min(axis=0), atol=1e-12)
    np.testing.assert_allclose(away[sources[answer.source], np.arange(len(vertices))], answer.distance, atol=1e-12)


def test_lines_across_an_edge_are_straight_and_stay_on_the_surface() -> None:
    """Two triangles of a square, folded: the far corners see each other over the fold, or only round a dent."""
    folded = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0.7, 0.7, 0.6]])
    faces = np.array([[0, 1, 2], [2, 1, 3]])
    answer = nearest_sources("unfolded", folded, faces, np.array([0]))
    exact = nearest_sources("exact", folded, faces, np.array([0]))
    assert answer.distance[3] == pytest.approx(exact.distance[3], abs=1e-12)
    assert answer.distance[3] < nearest_sources("edges", folded, faces, np.array([0])).distance[3] - 0.1
    boomerang = np.array([[0.0, 0, 0], [1, 0, 0], [0.2, 0.2, 0], [0, 1, 0]])  # a line from 1 to 3 would leave it
    dented = nearest_sources("unfolded", boomerang, np.array([[0, 1, 2], [0, 2, 3]]), np.array([1]))
    assert dented.distance[3] == pytest.approx(2 * np.hypot(0.8, 0.2), abs=1e-12)


def test_pieces_without_a_way_between_them_keep_to_their_own_sources() -> None:
    mesh = figure()
    vertices, faces = mesh.vertices, mesh.faces.astype(np.int64)
    sources = np.arange(0, len(vertices), len(vertices) // 5)[:5] + 7  # one on each part
    piece = mesh.pieces()
    for method in METHODS:
        answer = nearest_sources(method, vertices, faces, sources)
        np.testing.assert_array_equal(piece[sources][answer.source], piece)
        assert np.isfinite(answer.distance).all()


def test_the_exact_answer_passes_a_vertex_that_alone_holds_sheets_together() -> None:
    """Two triangles that meet in vertex 2: from 0 to 4 the way leads through it."""
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0.5, 1, 0], [0, 2, 0], [1, 2, 0]])
    answer = nearest_sources("exact", vertices, np.array([[0, 1, 2], [2, 4, 3]]), np.array([0]))
    np.testing.assert_allclose(answer.distance, [0, 1, 1.25**0.5, 2 * 1.25**0.5, 2 * 1.25**0.5])
    assert answer.note == "2 distances by the method 'unfolded', through 1 vertices that alone hold sheets together"


def test_refusals_name_the_place() -> None:
    vertices, faces, sources = surface(2)
    a, b, _ = faces[0]
    far = np.append(vertices, [[0.0, 5, 0]], axis=0)
    short = vertices.copy()
    short[b] = short[a] + np.array([1e-9, 0, 0])
    fin = np.append(faces, [[a, b, len(vertices)]], axis=0)
    line = np.append(faces, [[a, a, b]], axis=0)
    low, high = sorted((int(a), int(b)))
    for surface_, reason in (
        ((far, fin), f"an edge may have two faces at most, found 3 at that of vertices {low} and {high}"),
        ((vertices, line), f"a face needs three different vertices, found {[int(a), int(a), int(b)]}"),
        ((short, faces), "an edge must be 1e-06 m long at least, found 1e-09 m"),
    ):
        with pytest.raises(Unanswerable, match=re.escape(f"the method 'exact' cannot answer: {reason}")):
            nearest_sources("exact", *surface_, sources)
    for method in ("edges", "unfolded"):
        assert np.isfinite(nearest_sources(method, short, line, sources).distance).all()
        assert np.isfinite(nearest_sources(method, far, fin, sources).distance).all()


HOSTILE = """
import numpy as np, os, signal, sys
from bodyseg_data.meshes.geodesics import Unanswerable
from bodyseg_data.meshes.geodesics import nearest_sources
from bodyseg_data.meshes.mending import mend
import pygeodesic.geodesic, scipy.sparse.csgraph, trimesh

def ask(method, seed):
    rng = np.random.default_rng(seed)
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
    V, F = np.array(ball.vertices), np.array(ball.faces, np.int64)
    V = V + rng.normal(0, 10 ** rng.uniform(-6, -1), V.shape)
    for f in rng.choice(len(F), 60, replace=False):
        V[F[f, 0]] = V[F[f, 1]] + 10 ** rng.uniform(-13, -5) * rng.normal(size=3)
    F = np.delete(F, rng.choice(len(F), 200, replace=False), axis=0)
    F = np.concatenate([F, rng.integers(0, len(V), (50, 3)), F[:40], F[:20, ::-1], F[:9, [0, 0, 1]]])
    merged = np.arange(len(V)); merged[rng.integers(0, len(V), 30)] = rng.integers(0, len(V), 30); F = merged[F]
    mended = mend(V, F)
    for faces in (F, mended.faces):
        used, corners = np.unique(faces, return_inverse=True)
        sources = rng.choice(len(used), 33, replace=False)
        try:
            answer = nearest_sources(method, V[used], corners.reshape(-1, 3), np.sort(sources))
            assert not np.isnan(answer.distance).any() and answer.distance.min() >= 0
            assert answer.source.min() >= 0 and answer.source.max() < 33
        except Unanswerable as error:
            assert "cannot answer: " in str(error) and method not in ("edges", "unfolded")

for method in sys.argv[1:]:
    for seed in (0, 1):
        asked = os.fork()  # a crash ends this one alone, a hang is ended by the alarm
        if not asked:
            signal.alarm(60)
            ask(method, seed)
            sys.exit(0)
        print(method, os.waitstatus_to_exitcode(os.waitpid(asked, 0)[1]), flush=True)
"""


def test_no_method_crashes_or_hangs_on_hostile_surfaces() -> None:
    done = warm.run(["-c", HOSTILE, *METHODS], timeout=200)
    assert done.stdout.splitlines() == [f"{method} 0" for method in METHODS for _ in (0, 1)], done.stderr


def test_a_missing_package_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    vertices, faces, sources = surface(2)
    monkeypatch.setitem(sys.modules, "pygeodesic.geodesic", None)
    with pytest.raises(MissingLibrary, match=r"pip install 'bodyseg\[render\]'"):
        nearest_sources("exact", vertices, faces, sources)


def test_an_unknown_method_is_refused() -> None:
    unknown: Any = "hot"
    with pytest.raises(BadConfig, match="the method for distances must be one of exact, unfolded, edges, found 'hot'"):
        nearest_sources(unknown, np.eye(3), np.array([[0, 1, 2]]), np.array([0]))
