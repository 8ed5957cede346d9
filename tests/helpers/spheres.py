"""Spheres of triangles by NumPy alone: importing trimesh takes longer than what most processes of tests do."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Vertices = NDArray[np.float64]
Faces = NDArray[np.int64]

_SHORT, _LONG = 0.5257311121191336, 0.85065080835204  # half the sides of a golden rectangle with a diagonal of 2
_FACES = "0b5 051 017 07a 0ab 159 5b4 ba2 a76 718 394 342 326 368 389 495 24b 62a 867 981"


def icosphere(subdivisions: int, radius: float) -> tuple[Vertices, Faces]:
    """Divide an icosahedron's triangles in four, several times; vertices [V, 3] and faces [F, 3], outwards.

    Both are those of trimesh.creation.icosphere to the bit.
    """
    ring = np.array([(-_SHORT, _LONG), (_SHORT, _LONG), (-_SHORT, -_LONG), (_SHORT, -_LONG)])
    vertices = np.concatenate([np.roll(np.insert(ring, 2, 0, axis=1), turns, axis=1) for turns in (0, 1, 2)])
    faces = np.array([[int(corner, 16) for corner in face] for face in _FACES.split()])
    if subdivisions == 0:
        return _pushed_out(vertices, radius), faces
    for _ in range(subdivisions):
        vertices, faces = _divided(vertices, faces)
        vertices = _pushed_out(vertices, radius)
    return vertices, faces


def _divided(vertices: Vertices, faces: Faces) -> tuple[Vertices, Faces]:
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, first, inverse = np.unique(edges @ [1, 1 << 32], return_index=True, return_inverse=True)
    corners = np.concatenate([faces, inverse.reshape(-1, 3) + len(vertices)], axis=1)
    middles = vertices[edges[first]].mean(axis=1)
    return np.concatenate([vertices, middles]), corners[:, [0, 3, 5, 3, 1, 4, 5, 4, 2, 3, 4, 5]].reshape(-1, 3)


def _pushed_out(vertices: Vertices, radius: float) -> Vertices:
    length = np.sqrt(vertices**2 @ [1, 1, 1])[:, None]
    return vertices + vertices / length * (radius - length)
