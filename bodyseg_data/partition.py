"""Body parts as territories: every point of the surface belongs to the landmark that is nearest along the surface."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.borders import Borders, find_borders
from bodyseg_data.errors import BadLandmarks, BadMesh
from bodyseg_data.mesh import Mesh
from bodyseg_data.parts import LANDMARKS, PART_COUNT
from bodyseg_data.system_libraries import missing_library

_FEATURE: Final = "partitioning a body"


@dataclass(frozen=True)
class Partition:
    """The part of every vertex of one mesh, and of every point of its triangles.

    labels: uint8 [V], 0 to 32, position in `parts.PARTS`. distance: float64 [V], metres along the surface to the
    landmark of that part; infinite where no landmark can be reached (another piece of the surface, or a vertex that
    no face uses), where the label is that of the nearest reached place through the air. borders: the triangles that
    parts share.
    """

    labels: NDArray[np.uint8]
    distance: NDArray[np.float64]
    borders: Borders

    def labels_at(self, mesh: Mesh, faces: NDArray[np.int32], points: NDArray[np.float64]) -> NDArray[np.uint8]:
        """The part of each of `points` [N, 3], which lie in the triangles `faces` [N] of `mesh`, uint8 [N].

        Within a triangle that parts share, a point belongs to the landmark that is nearest to *it*: borders run
        through triangles as smoothly as distances do, instead of along their edges.
        """
        corners = self.labels[mesh.faces[faces]]
        chosen: NDArray[np.uint8] = corners[:, 0].copy()
        shared = np.flatnonzero((corners != corners[:, :1]).any(axis=1))
        nearest = self.borders.nearest_corner(faces[shared], mesh.barycentric(faces[shared], points[shared]))
        chosen[shared] = corners[shared, nearest]
        return chosen


def partition(mesh: Mesh, landmarks: NDArray[np.int64]) -> Partition:
    """Label every vertex of `mesh` with its nearest landmark, by exact geodesic distance from all of them at once.

    landmarks: int64 [33], one vertex for each of `parts.PARTS`, in that order.

    Distances are exact for the triangle mesh: the algorithm of Mitchell, Mount and Papadimitriou (The discrete
    geodesic problem, SIAM J. Comput. 16, 1987) as implemented by Kirsanov (pygeodesic). A body made of several
    pieces, like a head with separate eyes, may have landmarks on some of them only: a vertex of any other piece takes
    the label of the nearest labelled triangle, of that triangle's corner nearest to it.

    Raises BadLandmarks for landmarks that are not 33 different vertices in different places of the surface, BadMesh
    for surfaces on which distance along the surface means nothing (an edge with three faces, a face with one vertex
    twice), MissingLibrary without pygeodesic, scipy, trimesh or rtree.
    """
    landmarks = _checked_landmarks(mesh, landmarks)
    _check_edges(mesh)
    labels = np.zeros(len(mesh.vertices), np.uint8)
    distance = np.full(len(mesh.vertices), np.inf)

    faces = mesh.faces[_near_landmarks(mesh, landmarks)]
    # Numbered afresh: pygeodesic cannot take vertices without faces, and pieces without landmarks only cost time.
    used, corners = np.unique(faces, return_inverse=True)
    sources = np.searchsorted(used, landmarks)
    distance[used], labels[used] = _nearest_source(mesh.vertices[used], corners.reshape(-1, 3), sources)

    lost = np.flatnonzero(labels[landmarks] != np.arange(PART_COUNT))
    if len(lost):
        first, second = lost[0], labels[landmarks[lost[0]]]
        raise BadLandmarks(
            f"mesh {mesh.name}: landmarks must lie in different places, found {LANDMARKS[first]} and "
            f"{LANDMARKS[second]} at {mesh.vertices[landmarks[first]].tolist()}"
        )
    unreached = np.flatnonzero(~np.isfinite(distance))
    if len(unreached):
        reached_faces = mesh.faces[np.isfinite(distance[mesh.faces]).all(axis=1)]
        labels[unreached] = labels[_nearest_corner(mesh.vertices, reached_faces, mesh.vertices[unreached])]
    for array in (labels, distance):
        array.flags.writeable = False
    return Partition(labels, distance, find_borders(mesh, labels, distance))


def part_areas(mesh: Mesh, labels: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Share of the mesh's surface that each part has, float64 [33], sum 1.

    labels: uint8 [V], 0 to 32. The area of a triangle is shared equally by its corners.
    """
    areas = np.linalg.norm(mesh.normals, axis=1) / 2
    shares = np.zeros(PART_COUNT)
    for corner in range(3):
        np.add.at(shares, labels[mesh.faces[:, corner]], areas / (3 * areas.sum()))
    return shares


def _checked_landmarks(mesh: Mesh, landmarks: NDArray[Any]) -> NDArray[np.int64]:
    where = f"mesh {mesh.name}"
    landmarks = np.asarray(landmarks)
    if landmarks.shape != (PART_COUNT,) or not np.issubdtype(landmarks.dtype, np.integer):
        raise BadLandmarks(
            f"{where}: landmarks must be {PART_COUNT} whole numbers, found {landmarks.dtype} {landmarks.shape}"
        )
    surface = np.zeros(len(mesh.vertices), np.bool_)
    surface[mesh.faces] = True
    holders: dict[int, str] = {}
    for name, vertex in zip(LANDMARKS, landmarks.tolist(), strict=True):
        if not 0 <= vertex < len(surface):
            raise BadLandmarks(f"{where}: landmarks must be vertices 0 to {len(surface) - 1}, found {name} at {vertex}")
        if not surface[vertex]:
            raise BadLandmarks(f"{where}: landmarks must lie on the surface, found {name} at {vertex}, in no face")
        if vertex in holders:
            raise BadLandmarks(
                f"{where}: landmarks must be different vertices, found {holders[vertex]} and {name} at {vertex}"
            )
        holders[vertex] = name
    return landmarks.astype(np.int64)


def _check_edges(mesh: Mesh) -> None:
    """Refuse what pygeodesic answers with a crash of the whole process."""
    remedy = "repair it first (bodyseg_data.mesh_repair)"
    faces = mesh.faces.astype(np.int64)
    pairs = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    bad = np.flatnonzero(pairs[:, 0] == pairs[:, 1])
    if len(bad):
        face = int(bad[0]) % len(faces)
        raise BadMesh(
            f"mesh {mesh.name}: a face needs three different vertices, found {faces[face].tolist()} at face {face}: "
            f"{remedy}"
        )
    keys, counts = np.unique(pairs[:, 0] * len(mesh.vertices) + pairs[:, 1], return_counts=True)
    bad = np.flatnonzero(counts > 2)
    if len(bad):
        low, high = divmod(int(keys[bad[0]]), len(mesh.vertices))
        raise BadMesh(
            f"mesh {mesh.name}: an edge may have two faces at most, found {counts[bad[0]]} at the edge of vertices "
            f"{low} and {high}: {remedy}"
        )


def _near_landmarks(mesh: Mesh, landmarks: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which faces belong to pieces of the surface that hold a landmark, bool [F]."""
    piece = mesh.pieces(_FEATURE)
    inside: NDArray[np.bool_] = np.isin(piece[mesh.faces[:, 0]], piece[landmarks])
    return inside


def _nearest_source(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], sources: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Geodesic distance [V] to the nearest of `sources` [S], and which one it is, 0 to S - 1, [V]."""
    try:
        from pygeodesic.geodesic import PyGeodesicAlgorithmExact
    except ImportError as error:
        raise missing_library(_FEATURE, error) from error
    distance, source = PyGeodesicAlgorithmExact(vertices, faces).geodesicDistances(sources)
    return distance, source


def _nearest_corner(
    vertices: NDArray[np.float64], faces: NDArray[np.int32], points: NDArray[np.float64]
) -> NDArray[np.int32]:
    """For each of `points` [P, 3] the nearest corner of the triangle nearest to it: vertex indices [P]."""
    try:
        import rtree  # noqa: F401  trimesh asks for it late and with a message of its own
        import trimesh
        from scipy.spatial import KDTree
    except ImportError as error:
        raise missing_library(_FEATURE, error) from error
    # No point is farther from the surface than from its nearest vertex, so only triangles within that reach of the
    # points' common box can be the answer: for eyes in a head a few hundred instead of all.
    reach = KDTree(vertices[np.unique(faces)]).query(points)[0].max() + 1e-9  # rounding must not lose the nearest
    corners = vertices[faces]
    low, high = points.min(axis=0) - reach, points.max(axis=0) + reach
    faces = faces[((corners.max(axis=1) >= low) & (corners.min(axis=1) <= high)).all(axis=1)]
    surface = trimesh.Trimesh(vertices, faces, process=False)
    _, _, triangle = trimesh.proximity.closest_point(surface, points)
    candidates = faces[triangle]
    away = np.linalg.norm(vertices[candidates] - points[:, None], axis=2)
    nearest: NDArray[np.int32] = candidates[np.arange(len(points)), away.argmin(axis=1)]
    return nearest
