"""Nearest points of a surface."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.system.libraries import missing_library


def nearest_corner(
    vertices: NDArray[np.float64], faces: NDArray[np.int32], points: NDArray[np.float64], feature: str
) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """Find the triangle nearest to each of `points` [P, 3]: its corner nearest to the point, int32 [P], and the
    distance from the point to the triangle, float64 [P], metres.

    vertices: [V, 3], metres. faces: [F, 3], none of zero area. feature: the feature that the message names.
    Raises MissingLibrary without trimesh, rtree or scipy.
    """
    try:
        import rtree  # noqa: F401  trimesh imports it late and reports its absence in other words
        import trimesh
        from scipy.spatial import KDTree
    except ImportError as error:
        raise missing_library(feature, error) from error
    # No point is farther from the surface than from its nearest vertex, so only triangles within that distance of the
    # points' bounding box can be nearest: for eyes in a head a few hundred instead of all.
    reach = KDTree(vertices[np.unique(faces)]).query(points)[0].max() + 1e-9  # rounding must not lose the nearest
    corners = vertices[faces]
    low, high = points.min(axis=0) - reach, points.max(axis=0) + reach
    faces = faces[((corners.max(axis=1) >= low) & (corners.min(axis=1) <= high)).all(axis=1)]
    surface = trimesh.Trimesh(vertices, faces, process=False)
    _, distance, triangle = trimesh.proximity.closest_point(surface, points)
    candidates = faces[triangle]
    away = np.linalg.norm(vertices[candidates] - points[:, None], axis=2)
    nearest: NDArray[np.int32] = candidates[np.arange(len(points)), away.argmin(axis=1)]
    return nearest, np.asarray(distance, np.float64)


def farthest_from(vertices: NDArray[np.float64], points: NDArray[np.float64], feature: str) -> float:
    """The largest distance of `points` [P, 3] to their nearest vertices [V, 3], metres: that to a surface of these
    vertices is no larger. feature: the feature that the message of MissingLibrary, raised without scipy, names.
    """
    try:
        from scipy.spatial import KDTree
    except ImportError as error:
        raise missing_library(feature, error) from error
    return float(KDTree(vertices).query(points)[0].max())
