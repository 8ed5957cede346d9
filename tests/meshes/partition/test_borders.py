"""Borders between parts run where distances say, not along the edges of triangles."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from benches.data.surface import borders as benches
from fakes import Figures
from numpy.typing import NDArray
from people_on_disk import PERSON, VERTICES
from pygeodesic.geodesic import PyGeodesicAlgorithmExact
from shapes import ball, box_mesh, evenly_drawn, figure

from bodyseg_data.bodies import SOURCES, Body, BodyRef
from bodyseg_data.meshes import Mesh, Partition, partition
from bodyseg_data.meshes.partitioning import find_borders


def points_in(mesh: Mesh, faces: NDArray[np.int32], seed: int = 0) -> tuple[NDArray[Any], NDArray[Any]]:
    """A random point of each face [N, 3], and its weights [N, 3]."""
    weights = np.random.default_rng(seed).dirichlet([1, 1, 1], len(faces))
    return np.einsum("nc,ncd->nd", weights, mesh.vertices[mesh.faces[faces]]), weights


def test_barycentric_weights_rebuild_the_point() -> None:
    mesh = ball()
    faces = np.arange(0, len(mesh.faces), 7, dtype=np.int32)
    points, weights = points_in(mesh, faces)
    np.testing.assert_allclose(mesh.barycentric(faces, points), weights, atol=1e-9)


def test_on_a_plane_parts_are_the_voronoi_cells_of_their_landmarks() -> None:
    mesh = box_mesh(steps=24)
    front = np.flatnonzero(mesh.vertices[:, 2] == 0.1)
    landmarks = np.random.default_rng(3).choice(front, 33, replace=False)
    parts = partition(mesh, landmarks)
    faces = np.flatnonzero((mesh.vertices[mesh.faces][..., 2] == 0.1).all(axis=1)).astype(np.int32)
    faces = np.repeat(faces, 20)
    points, weights = points_in(mesh, faces)
    distance = np.linalg.norm(points[:, None] - mesh.vertices[landmarks], axis=2)
    wrong = parts.labels_at(mesh, faces, points) != distance.argmin(axis=1)
    by_corner = parts.labels[mesh.faces[faces]][np.arange(len(faces)), weights.argmax(axis=1)]
    wrong_by_corner = by_corner != distance.argmin(axis=1)
    assert wrong.mean() < 0.02 < 0.05 < wrong_by_corner.mean()
    # What is left comes from distances taken as linear within a triangle, which they are not near a landmark.
    nearest, chosen = distance.min(axis=1), distance[np.arange(len(faces)), parts.labels_at(mesh, faces, points)]
    away = nearest > 2 / 24
    assert away.mean() > 0.3
    # In rare triangles the nearest landmark is that of no corner.
    assert np.mean((chosen - nearest)[away] > 0.1 / 24) < 0.005


def test_labels_agree_with_distances_to_every_landmark_computed_alone() -> None:
    mesh = ball(subdivisions=3)
    landmarks = evenly_drawn(mesh)
    parts = partition(mesh, landmarks)
    solver = PyGeodesicAlgorithmExact(mesh.vertices, mesh.faces)
    alone = np.stack([solver.geodesicDistances(np.array([landmark]))[0] for landmark in landmarks])
    faces = np.repeat(parts.borders.faces, 30)
    points, weights = points_in(mesh, faces)
    exact = np.einsum("nc,knc->kn", weights, alone[:, mesh.faces[faces]]).argmin(axis=0)
    wrong = parts.labels_at(mesh, faces, points) != exact
    by_corner = parts.labels[mesh.faces[faces]][np.arange(len(faces)), weights.argmax(axis=1)]
    assert wrong.mean() < 0.03
    assert (by_corner != exact).mean() > 0.15


def test_triangles_within_one_part_keep_its_label() -> None:
    mesh = figure()
    parts = partition(mesh, np.linspace(0, 600, 33).astype(np.int64))
    corner_labels = parts.labels[mesh.faces]
    inside = np.flatnonzero((corner_labels == corner_labels[:, :1]).all(axis=1)).astype(np.int32)
    assert not np.isin(inside, parts.borders.faces).any()
    points, _ = points_in(mesh, inside)
    np.testing.assert_array_equal(parts.labels_at(mesh, inside, points), corner_labels[inside, 0])


def test_where_no_landmark_reaches_the_nearest_corner_decides() -> None:
    mesh = ball(subdivisions=2)
    labels = (mesh.vertices[:, 0] > 0).astype(np.uint8)
    nowhere = np.full(len(labels), np.inf)
    parts = Partition(labels, nowhere, find_borders(mesh, labels, nowhere))
    assert len(parts.borders.faces)
    points, weights = points_in(mesh, parts.borders.faces)
    expected = labels[mesh.faces[parts.borders.faces]][np.arange(len(points)), weights.argmax(axis=1)]
    np.testing.assert_array_equal(parts.labels_at(mesh, parts.borders.faces, points), expected)


def test_a_body_of_one_part_has_no_borders() -> None:
    mesh = ball(subdivisions=2)
    borders = find_borders(mesh, np.zeros(len(mesh.vertices), np.uint8), np.zeros(len(mesh.vertices)))
    assert borders.faces.shape == (0,)
    assert borders.distance.shape == (0, 3, 3)


class Eggs(Figures):
    """A body of few triangles: exact distances from 33 landmarks of the open body take most of ten seconds."""

    def bodies(self) -> Sequence[BodyRef]:
        return [BodyRef("A", "A", "A-0", "a_pose", "train")]

    def build(self, body: BodyRef) -> Body:
        return Body(PERSON, np.array(VERTICES))


def test_the_bench_writes_what_it_promises(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(benches, "POSES", ("a_pose",))
    monkeypatch.setitem(SOURCES, "open", Eggs)
    steps: list[tuple[int, int]] = []
    figures = benches.bench_borders(1, lambda done, total: steps.append((done, total)))
    assert steps == [(1, 1)]
    methods = figures["methods"]
    assert set(methods) == set(benches.METHODS)
    assert all(set(row) == {"ms", "wrong_surface", "wrong_pixels"} for row in methods.values())
    for measure in ("wrong_surface", "wrong_pixels"):
        assert methods["inside the triangle"][measure] < 0.02 < 0.1 < methods["nearest corner"][measure]
