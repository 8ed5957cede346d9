"""The place of a surface nearest to a point."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.system_libraries import missing_library


def nearest_corner(
    vertices: NDArray[np.float64], faces: NDArray[np.int32], points: NDArray[np.float64], feature: str
) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """For points [P, 3] the nearest corner of the triangle nearest to each, [P], and the distance to that triangle [P].

    vertices: [V, 3]; faces: [F, 3], each with an area. feature: what they are wanted for, for the message of the
    MissingLibrary that is raised without trimesh, rtree or scipy.
    """
    try:
        import rtree  # noqa: F401  trimesh asks for it late and with a message of its own
        import trimesh
        from scipy.spatial import KDTree
    except ImportError as error:
        raise missing_library(feature, error) from error
    # No point is farther from the surface than from its nearest vertex, so only triangles within that reach of the
    # points' common box can be the answer: for eyes in a head a few hundred instead of all.
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
