"""Makes bodyseg_data/bodies/template.npz from Anny and the open landmarks: python tests/golden/make_template.py.

Sets that were packed before name the template that they were packed with: another surface, or other points, must get
another `NAME`, and `PACKING_VERSION` must go up.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

import bodyseg_data
from bodyseg_data.bodies.anny_model import AnnyModel, standing
from bodyseg_data.bodies.anny_people import SUBJECT_A
from bodyseg_data.bodies.skeleton import Pose
from bodyseg_data.bodies.template import Template
from bodyseg_data.meshes import Mesh, load_landmarks, partition

NAME = "anny 11 mm 1"
APART_M = 0.011
STEP_M = 0.004
SLAB_M = 0.01
FILE = Path(bodyseg_data.__file__).parent / "bodies" / "template.npz"


def candidates(vertices: NDArray[Any], faces: NDArray[Any]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Triangles [N] and barycentric coordinates [N, 3] of points all over a surface, `STEP_M` apart at most."""
    corners = vertices[faces]
    steps = np.ceil(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1) / STEP_M).astype(np.int64)
    found, weights = [], []
    for count in np.unique(steps):
        own = np.flatnonzero(steps == count)
        i, j = np.nonzero(np.add.outer(np.arange(count), np.arange(count)) < count)
        first, second = (i + 1 / 3) / count, (j + 1 / 3) / count
        found.append(np.repeat(own, len(i)))
        weights.append(np.tile(np.stack([1 - first - second, first, second], axis=1), (len(own), 1)))
    return np.concatenate(found), np.concatenate(weights)


def spread(points: NDArray[np.float64]) -> NDArray[np.int64]:
    """Points at least `APART_M` from each other and at most that from any other, by height, back, front and left."""
    tree, free, chosen = cKDTree(points), np.ones(len(points), np.bool_), []
    for point in np.random.default_rng(0).permutation(len(points)):
        if free[point]:
            chosen.append(point)
            free[tree.query_ball_point(points[point], APART_M)] = False
    found = np.sort(np.array(chosen))
    x, y, z = points[found].T
    return np.asarray(found[np.lexsort((x, z > 0, np.floor(y / SLAB_M)))], np.int64)


def made(vertices: NDArray[np.float32], faces: NDArray[np.uint16], bones: NDArray[Any], names: Any) -> dict[str, Any]:
    """What the file holds. bones: of the vertices, [V]."""
    surface = vertices.astype(np.float64), faces.astype(np.int32)
    triangles, weights = candidates(*surface)
    kept = spread(np.einsum("nc,nci->ni", weights, surface[0][surface[1][triangles]]))
    triangles, weights = triangles[kept], weights[kept].astype(np.float32)
    none = np.empty(0, np.uint8)
    template = Template(NAME, *surface, triangles.astype(np.int32), weights.astype(np.float64), none, none, ())
    mesh = Mesh(NAME, *surface)
    parts = partition(mesh, np.array(load_landmarks("open").vertices))
    return {
        "name": NAME,
        "vertices": vertices,
        "faces": faces,
        "point_faces": triangles.astype(np.uint16),
        "weights": weights,
        "parts": parts.labels_at(mesh, template.point_faces, template.points),
        "bones": bones[template.corners].astype(np.uint8),
        "bone_names": names,
    }


if __name__ == "__main__":
    model = AnnyModel()
    person = model.posable(SUBJECT_A)
    vertices = standing(model._posed(SUBJECT_A, Pose())).astype(np.float32)
    np.savez_compressed(FILE, **made(vertices, person.faces.astype(np.uint16), person.owner, np.array(person.bones)))
