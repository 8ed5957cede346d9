"""`bench borders`: three ways to label the points of a triangle that parts share, against exact distances.

Exact here means: 33 distance fields, one from each landmark alone, each exact at the vertices and linear within a
triangle; a point belongs to the smallest.
"""

from __future__ import annotations

import time
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.bodies import Body, open_source
from bodyseg_data.core import ProgressCallback, silent
from bodyseg_data.meshes import Partition
from bodyseg_data.meshes.partitioning import find_borders
from bodyseg_data.rendering.embree import EmbreeRenderer
from bodyseg_data.rigs import Rig, load_rig
from bodyseg_data.samples import View, ViewGrid

POSES: Final = ("a_pose", "deep_squat", "arms_crossed", "walk_contact")
METHODS: Final = ("whole triangles", "nearest corner", "inside the triangle")
"""As the paper draws annotated faces; each corner's third of a triangle; the default."""

_POINTS: Final = 20
"""Random points a shared triangle."""

Weights = NDArray[np.float64]


def bench_borders(views: int = 12, progress: ProgressCallback = silent) -> dict[str, Any]:
    """Wrong surface and wrong pixels of every method, over four postures of the open body and `views` views of each.

    wrong_surface: share of the body's surface labelled differently from the exact distances, by random points in
    shared triangles. wrong_pixels: share of foreground pixels. ms: to find the borders, a mesh. Raises BadConfig.
    """
    grid = list(ViewGrid(span_deg=360, count=views))
    rig, source = load_rig(), open_source("open")
    bodies = {body.pose: body for body in reversed(source.bodies()) if body.subset == "A"}
    surface = np.zeros(len(METHODS))
    wrong, pixels = np.zeros(len(METHODS), np.int64), 0
    seconds, shared = [], []
    for done, pose in enumerate(POSES, start=1):
        body = source.build(bodies[pose])
        parts = body.partition()
        start = time.perf_counter()
        find_borders(body.mesh, parts.labels, parts.distance)
        seconds.append(time.perf_counter() - start)
        fields = landmark_fields(body, parts)
        surface += _wrong_surface(body, parts, fields) / len(POSES)
        shared.append(len(parts.borders.faces) / len(body.mesh.faces))
        for view in grid:
            labels, exact = labelled_pixels(rig, body, parts, fields, view)
            wrong += [int((labels[name] != exact).sum()) for name in METHODS]
            pixels += len(exact)
        progress(done, len(POSES))
    milliseconds = {"inside the triangle": round(float(np.median(seconds)) * 1e3, 1)}
    return {
        "methods": {
            name: {
                "ms": milliseconds.get(name, 0.0),
                "wrong_surface": round(float(surface[index]), 6),
                "wrong_pixels": round(int(wrong[index]) / pixels, 6),
            }
            for index, name in enumerate(METHODS)
        },
        "default": METHODS[-1],
        "shared_triangles": round(float(np.mean(shared)), 4),
        "pixels": pixels,
        "bodies": list(POSES),
        "views": views,
    }


def landmark_fields(body: Body, parts: Partition) -> NDArray[np.float64]:
    """Exact distance from each landmark alone to every vertex, float64 [33, V], metres; infinite where none leads."""
    from pygeodesic.geodesic import PyGeodesicAlgorithmExact

    mesh = body.mesh
    # The landmarks' piece of the surface, numbered afresh: pygeodesic takes no vertices without faces.
    reached = np.isfinite(parts.distance)
    used, corners = np.unique(mesh.faces[reached[mesh.faces].all(axis=1)], return_inverse=True)
    solver = PyGeodesicAlgorithmExact(mesh.vertices[used], corners.reshape(-1, 3))
    fields = np.full((len(body.landmarks), len(mesh.vertices)), np.inf)
    for label, landmark in enumerate(np.searchsorted(used, body.landmarks)):
        fields[label, used] = solver.geodesicDistances(np.array([landmark]))[0]
    return fields


def _labels(body: Body, parts: Partition, faces: NDArray[np.int32], points: NDArray[np.float64]) -> dict[str, Any]:
    """Labels by each method of points [N, 3] in triangles [N]."""
    corners = parts.labels[body.mesh.faces[faces]]
    weights = body.mesh.barycentric(faces, points)
    # A triangle's label is the one that most of its corners have.
    majority = np.where(corners[:, 1] == corners[:, 2], corners[:, 1], corners[:, 0])
    return {
        "whole triangles": majority,
        "nearest corner": corners[np.arange(len(faces)), weights.argmax(axis=1)],
        "inside the triangle": parts.labels_at(body.mesh, faces, points),
    }


def _exact(body: Body, fields: NDArray[np.float64], faces: NDArray[np.int32], weights: Weights) -> NDArray[np.intp]:
    exact: NDArray[np.intp] = np.einsum("nc,knc->kn", weights, fields[:, body.mesh.faces[faces]]).argmin(axis=0)
    return exact


def _wrong_surface(body: Body, parts: Partition, fields: NDArray[np.float64]) -> NDArray[np.float64]:
    mesh = body.mesh
    areas = np.linalg.norm(mesh.normals, axis=1)
    reached = np.isfinite(fields[0][mesh.faces[parts.borders.faces]]).all(axis=1)
    faces = np.repeat(parts.borders.faces[reached], _POINTS)
    weights = np.random.default_rng(0).dirichlet([1, 1, 1], len(faces))
    labels = _labels(body, parts, faces, np.einsum("nc,ncd->nd", weights, mesh.vertices[mesh.faces[faces]]))
    exact = _exact(body, fields, faces, weights)
    shares = [((labels[name] != exact) * areas[faces]).sum() / _POINTS / areas.sum() for name in METHODS]
    return np.array(shares)


def labelled_pixels(
    rig: Rig, body: Body, parts: Partition, fields: NDArray[np.float64], view: View
) -> tuple[dict[str, Any], NDArray[np.intp]]:
    """The labels of one view's foreground pixels that landmarks reach, by each method and by exact distances."""
    camera, _ = rig.placed(body.mesh.centre, view)
    seen = EmbreeRenderer(body.mesh).render(camera)
    rows, columns = np.nonzero(seen.face >= 0)
    faces = seen.face[rows, columns]
    points = camera.points(seen.range, rows, columns)
    reached = np.isfinite(fields[0][body.mesh.faces[faces]]).all(axis=1)
    faces, points = faces[reached], points[reached]
    return _labels(body, parts, faces, points), _exact(body, fields, faces, body.mesh.barycentric(faces, points))
