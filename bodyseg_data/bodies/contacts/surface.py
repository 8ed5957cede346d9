"""The skin as an obstacle: distances of points from it, and how deep limbs go into the rest of the body."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.bodies.contacts.limbs import Limb

Floats = NDArray[np.float64]

_REACH_M: Final = 0.2  # beyond this, a point's distance is of no interest


class PosedSkin:
    """Part of a posed surface. Distances are those to the tangent plane at the nearest vertex."""

    def __init__(self, vertices: Floats, normals: Floats, of: NDArray[np.bool_]) -> None:
        """vertices, normals: [V, 3] of the whole body. of: bool [V], the part."""
        from scipy.spatial import cKDTree

        self._points, self._normals = vertices[of], normals[of]
        self._tree = cKDTree(self._points)

    def heights(self, points: Floats) -> Floats:
        """Return signed distances [N] of points [N, 3] above the skin, metres: below 0 inside, inf far away."""
        distance, nearest = self._tree.query(points, distance_upper_bound=_REACH_M)
        near = np.isfinite(distance)
        found = np.full(len(points), np.inf)
        offset = points[near] - self._points[nearest[near]]
        side = np.einsum("ij,ij->i", offset, self._normals[nearest[near]])
        # Beside the rim of the part, the plane goes on where the skin does not.
        found[near] = np.where(side < 0, side, distance[near])
        return found


def vertex_normals(vertices: Floats, faces: NDArray[np.int32]) -> Floats:
    """Return unit normals [V, 3], of adjoining faces weighted by area."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    across = np.cross(b - a, c - a)
    count = len(vertices)
    sums = [np.bincount(faces.ravel(), np.repeat(across[:, axis], 3), count) for axis in range(3)]
    normals = np.stack(sums, axis=1)
    return np.asarray(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-15), np.float64)


def deepest_m(vertices: Floats, normals: Floats, limbs: list[Limb], solid: NDArray[np.bool_]) -> float:
    """Return the depth in metres to which far ends of limbs go into the rest of the body, 0 if none does.

    vertices, normals: [V, 3]. solid: bool [V], vertices that can be gone into: not those of eyes and mouth.
    """
    deepest = 0.0
    for limb in limbs:
        heights = PosedSkin(vertices, normals, solid & ~limb.vertices).heights(vertices[limb.far])
        deepest = max(deepest, -float(heights.min()))
    return deepest
