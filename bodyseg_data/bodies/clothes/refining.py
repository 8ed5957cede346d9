"""Subdivision of long edges where a mesh is too coarse for the folds of cloth."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadMesh
from bodyseg_data.meshes.topology import find_edges


class Refinement:
    """Splits long edges of one topology at their middles; faces stay on the surface and keep their orientation.

    faces: int32 [F', 3]. Old vertices keep their numbers and new ones follow, so landmarks by vertex stay valid.
    """

    def __init__(self, rest: NDArray[np.float64], faces: NDArray[np.int32], longest_m: float, rounds: int = 2) -> None:
        self._count = len(rest)
        self._ends: list[NDArray[np.int64]] = []
        points, self.faces = rest, faces
        for _ in range(rounds):
            ends, self.faces = _split(points, self.faces, longest_m)
            self._ends.append(ends)
            points = np.concatenate([points, points[ends].mean(axis=1)])

    def __call__(self, vertices: NDArray[np.float64]) -> NDArray[np.float64]:
        """Refine vertices [V, 3] of the coarse mesh in any pose to [V', 3]. Raises BadMesh for another number."""
        if vertices.shape != (self._count, 3):
            raise BadMesh(f"a refinement of {self._count} vertices was given vertices of shape {vertices.shape}")
        for ends in self._ends:
            vertices = np.concatenate([vertices, vertices[ends].mean(axis=1)])
        return vertices


def _split(
    points: NDArray[np.float64], faces: NDArray[np.int32], longest_m: float
) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Return the ends [N, 2] of split edges, whose middles are numbered after the last vertex, and the new faces."""
    edges = find_edges(faces)
    long = edges.lengths(points) > longest_m
    number = np.where(long, len(points) + np.cumsum(long) - 1, -1)
    middle = number[edges.of_side]
    count = (middle >= 0).sum(axis=1)
    new = [faces[count == 0]]
    for split, corner in ((1, 0), (1, 1), (1, 2), (2, 0), (2, 1), (2, 2), (3, 0)):
        # Turned so that the one split edge is the first, or the one whole edge the last.
        turn = (corner, (corner + 1) % 3, (corner + 2) % 3)
        fit = (count == split) & ((middle[:, corner] >= 0) if split == 1 else (middle[:, turn[2]] < 0) | (split == 3))
        (a, b, c), (ab, bc, ca) = faces[fit][:, turn].T, middle[fit][:, turn].T
        parts = {
            1: ((a, ab, c), (ab, b, c)),
            2: ((ab, b, bc), (a, ab, c), (ab, bc, c)),
            3: ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)),
        }[split]
        new += [np.stack(part, axis=1) for part in parts]
    return edges.ends[long], np.concatenate(new).astype(np.int32)
