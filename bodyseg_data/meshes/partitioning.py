"""Partition of a body's surface: every point gets the part of the landmark that is nearest along the surface.

A partition holds the exact distance of each vertex to its own landmark. A triangle that parts share also needs the
distance of each corner to the landmarks of the *other* corners. Those landmarks are near, so their distances are
extended across the border triangle by triangle: a wave that passes an edge goes on in a straight line in the unfolded
plane (the update of Kimmel and Sethian, Computing geodesic paths on manifolds, PNAS 1998, with the exact
distance to a point source in place of a plane wave).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadLandmarks
from bodyseg_data.labels import BACKGROUND, LANDMARKS
from bodyseg_data.meshes.geodesics import FALLBACK_METHOD, GeodesicMethod, Unanswerable, nearest_sources
from bodyseg_data.meshes.landmarks import nearest_corner
from bodyseg_data.meshes.mending import MendedSurface, mend
from bodyseg_data.meshes.mesh import Floats, Indices, Mesh, face_components
from bodyseg_data.meshes.solids import SurfacePiece, label_pieces

_ROUNDS: Final = 4  # triangles by which distances are extended across a border
_PARTS: Final = 256  # above the number of parts: encodes (vertex, part) as one number


@dataclass(frozen=True)
class Partition:
    """The part of every vertex of one mesh, and of every point of its triangles.

    labels: uint8 [V], 0 to 32, index in `parts.PARTS`; 255 on things. distance: float64 [V], metres along the surface
    to the landmark of that part; infinite where no landmark can be reached (another piece of the surface, or a vertex
    that no face uses), where the label is that of the nearest reached triangle in a straight line, or, on a
    `SurfacePiece`, of the nearest vertex of the parts that it covers. borders: the triangles that parts share. note:
    repairs and a change of method in words, or None. below: int64 [V], the vertex of the body under each vertex of a
    `SurfacePiece`, -1 on things; all others stand for themselves. None without pieces.
    """

    labels: NDArray[np.uint8]
    distance: Floats
    borders: Borders
    note: str | None = None
    below: Indices | None = None

    @property
    def holding(self) -> bool:
        """True for a body that holds or wears a thing."""
        return bool((self.labels == BACKGROUND).any())

    def corners(self, mesh: Mesh) -> NDArray[np.uint8]:
        """Labels at the corners of all triangles, uint8 [F, 3]."""
        return self.labels[mesh.faces]

    def labels_at(self, mesh: Mesh, faces: NDArray[np.int32], points: Floats) -> NDArray[np.uint8]:
        """Labels of `points` [N, 3], metres, which lie in the triangles `faces` [N] of `mesh`, uint8 [N].

        Within a triangle that parts share, a point gets the part of the landmark nearest to *it*: borders cross
        triangles smoothly instead of following their edges.
        """
        corners = self.labels[mesh.faces[faces]]
        chosen: NDArray[np.uint8] = corners[:, 0].copy()
        shared = np.flatnonzero((corners != corners[:, :1]).any(axis=1))
        nearest = self.borders.nearest_corner(faces[shared], mesh.barycentric(faces[shared], points[shared]))
        chosen[shared] = corners[shared, nearest]
        return chosen


def partition(
    mesh: Mesh,
    landmarks: Indices,
    method: GeodesicMethod = "exact",
    pieces: Sequence[SurfacePiece] = (),
    names: Sequence[str] = LANDMARKS,
) -> Partition:
    """Label every vertex of `mesh` with its nearest landmark along the surface.

    landmarks: vertex indices [33] of any integer dtype, one for each of `parts.PARTS`, in that order. method: of
    measuring distances (`geodesics.nearest_sources`). pieces: those that lie over the body (`Body.pieces`). names: of
    other landmarks, at most 254.

    Defects that prevent distances along the surface are mended first (`mending.mend`): seams that are not welded,
    duplicate and degenerate faces, edges with more than two faces. If `method` fails even so,
    `geodesics.FALLBACK_METHOD` is used. The partition's `note` reports both.

    A body of several pieces, like a head with separate eyes, may have landmarks on some of them only: a vertex of
    any other piece gets the label of the nearest labelled triangle, of that triangle's corner nearest to it.

    Raises BadLandmarks for landmarks that are not 33 vertices at distinct points of the surface or pieces that are not
    over the body, BadConfig for an unknown method, MissingLibrary without pygeodesic, scipy, trimesh or rtree.
    """
    landmarks = _checked_landmarks(mesh, landmarks, names)
    mended = mend(mesh.vertices, mesh.faces)
    _check_distinct_points(mesh, landmarks, mended, names)
    notes = list(mended.notes)
    try:
        labels, distance, note = _nearest_landmarks(mesh, landmarks, mended, method)
    except Unanswerable as error:
        notes.insert(0, str(error))
        method = FALLBACK_METHOD
        labels, distance, note = _nearest_landmarks(mesh, landmarks, mended, method)
    notes += [] if note is None else [note]
    line = f"distances by the method {method!r}: {', '.join(notes)}" if notes else None
    return _with_borders(mesh, mended, labels, distance, line, pieces)


def _nearest_landmarks(
    mesh: Mesh, landmarks: Indices, surface: MendedSurface, method: GeodesicMethod
) -> tuple[NDArray[np.uint8], Floats, str | None]:
    """Labels [V] and distances [V] from the landmarks along `surface`, and the method's note. Raises Unanswerable."""
    sources = surface.representative[landmarks]
    piece = face_components(len(mesh.vertices), surface.faces)
    faces = surface.faces[np.isin(piece[surface.faces[:, 0]], piece[sources])]
    # Renumbered: no method accepts vertices without faces, and pieces without landmarks only cost time.
    used, corners = np.unique(faces, return_inverse=True)
    labels = np.zeros(len(mesh.vertices), np.uint8)
    distance = np.full(len(mesh.vertices), np.inf)
    nearest = nearest_sources(method, mesh.vertices[used], corners.reshape(-1, 3), np.searchsorted(used, sources))
    distance[used], labels[used] = nearest.distance, nearest.source
    return labels[surface.representative], distance[surface.representative], nearest.note


def _with_borders(
    mesh: Mesh,
    surface: MendedSurface,
    labels: NDArray[np.uint8],
    distance: Floats,
    note: str | None,
    pieces: Sequence[SurfacePiece],
) -> Partition:
    reached, below = np.isfinite(distance), None
    if pieces:
        piece = face_components(len(mesh.vertices), surface.faces)
        below = label_pieces(mesh, pieces, piece, labels, distance)
        reached |= below != np.arange(len(below))
    unreached = np.flatnonzero(~reached)
    if len(unreached):
        reached_faces = surface.faces[np.isfinite(distance[surface.faces]).all(axis=1)].astype(np.int32)
        nearest, _ = nearest_corner(mesh.vertices, reached_faces, mesh.vertices[unreached])
        labels[unreached] = labels[nearest]
        labels = labels[surface.representative]
    for array in (labels, distance):
        array.flags.writeable = False
    return Partition(labels, distance, find_borders(mesh, labels, distance, surface.representative), note, below)


def _checked_landmarks(mesh: Mesh, landmarks: NDArray[Any], names: Sequence[str]) -> Indices:
    landmarks = np.asarray(landmarks)
    if landmarks.shape != (len(names),) or not np.issubdtype(landmarks.dtype, np.integer):
        found = f"{landmarks.dtype} {landmarks.shape}"
        raise BadLandmarks(f"mesh {mesh.name}: landmarks must be {len(names)} whole numbers, found {found}")
    for name, vertex, seen in zip(names, landmarks.tolist(), np.isin(landmarks, mesh.faces), strict=True):
        if not seen:
            raise BadLandmarks(f"mesh {mesh.name}: landmarks must lie on the surface, found {name} at {vertex}")
    return landmarks.astype(np.int64)


def _check_distinct_points(mesh: Mesh, landmarks: Indices, mended: MendedSurface, names: Sequence[str]) -> None:
    """Raise BadLandmarks unless the landmarks are distinct points of the mended surface."""
    first: dict[int, str] = {}
    for name, vertex in zip(names, mended.representative[landmarks].tolist(), strict=True):
        if vertex in first:
            both = f"{first[vertex]} and {name} at {mesh.vertices[vertex].tolist()}"
            raise BadLandmarks(f"mesh {mesh.name}: landmarks must lie in different places, found {both}")
        first[vertex] = name
    for vertex in np.setdiff1d([*first], mended.faces).tolist():
        raise BadLandmarks(f"mesh {mesh.name}: landmarks must lie on the surface, mended away at {first[vertex]}")


@dataclass(frozen=True)
class Borders:
    """The triangles that parts share. faces: int32 [B], ascending. distance: float64 [B, 3, 3], metres, from corner c
    of a triangle (last axis) to the landmark of its corner s (middle axis).
    """

    faces: NDArray[np.int32]
    distance: Floats

    def nearest_corner(self, faces: NDArray[np.int32], weights: Floats) -> NDArray[np.intp]:
        """Find the corner, 0 to 2, whose landmark is nearest to each point, [N].

        faces: [N], each one of `self.faces`. weights: [N, 3], barycentric. Distances are linear within a triangle.
        """
        distance = self.distance[np.searchsorted(self.faces, faces)]
        nearest: NDArray[np.intp] = np.einsum("nc,nsc->ns", weights, distance).argmin(axis=1)
        return nearest


def find_borders(
    mesh: Mesh, labels: NDArray[np.uint8], distance: Floats, representative: Indices | None = None
) -> Borders:
    """Find the borders of a labelled mesh. labels: uint8 [V]. distance: float64 [V], metres, to the landmark of that
    label. representative: int64 [V], as in `MendedSurface`; each vertex itself if None.

    In a triangle with a corner out of all landmarks' reach (infinite distance), points get the nearest corner's label.
    """
    joined = mesh.faces if representative is None else representative[mesh.faces]
    corner_labels = labels[joined]
    faces = np.flatnonzero((corner_labels != corner_labels[:, :1]).any(axis=1)).astype(np.int32)
    corners, parts = joined[faces].astype(np.int64), corner_labels[faces].astype(np.int64)
    # The distances needed: from vertex c of a border triangle to the landmark of part s of another of its corners.
    requested = (corners[:, None, :] * _PARTS + parts[:, :, None]).reshape(-1, 3, 3)
    wanted, position = np.unique(requested, return_inverse=True)
    found = _extended_distances(mesh.vertices, joined, labels, distance, wanted)[position].reshape(-1, 3, 3)
    found[~np.isfinite(found).all(axis=(1, 2))] = 1 - np.eye(3)
    return Borders(faces, found)


def _extended_distances(
    points: Floats, faces: NDArray[Any], labels: NDArray[np.uint8], distance: Floats, wanted: Indices
) -> Floats:
    """Distances [P], metres, of the pairs `wanted` [P], vertex * _PARTS + part, ascending."""
    vertices, parts = np.divmod(wanted, _PARTS)
    known = np.where(labels[vertices] == parts, distance[vertices], np.inf)
    missing = np.flatnonzero(~np.isfinite(known))
    # Every triangle around a vertex may give a missing distance, through the edge opposite the vertex.
    order = np.argsort(faces.ravel(), kind="stable")
    starts = np.searchsorted(faces.ravel()[order], np.arange(len(points) + 1))
    first, end = starts[vertices[missing]], starts[vertices[missing] + 1]
    pair = np.repeat(missing, end - first)
    along = np.arange(len(pair)) - np.repeat(np.cumsum(end - first) - (end - first), end - first)
    face, corner = np.divmod(order[np.repeat(first, end - first) + along], 3)
    tip = vertices[pair]
    ends = [faces[face, (corner + step) % 3].astype(np.int64) for step in (1, 2)]
    keys = [end * _PARTS + parts[pair] for end in ends]
    indices = [np.minimum(np.searchsorted(wanted, key), len(wanted) - 1) for key in keys]
    given = [np.where(labels[end] == parts[pair], distance[end], np.inf) for end in ends]
    sought = [
        (wanted[index] == key) & (labels[end] != parts[pair])
        for end, index, key in zip(ends, indices, keys, strict=True)
    ]
    corners = [points[index] for index in (*ends, tip)]
    for _ in range(_ROUNDS):
        at_ends = [np.where(asked, known[index], at) for at, asked, index in zip(given, sought, indices, strict=True)]
        np.minimum.at(known, pair, _beyond_edge(*corners, *at_ends))
    return known


def _beyond_edge(a: Floats, b: Floats, tip: Floats, at_a: Floats, at_b: Floats) -> Floats:
    """Distance [N] of `tip` [N, 3] from a source at the distances `at_a` and `at_b` [N] from the ends of the edge a b.

    In the plane, with a at the origin and b on the x axis, the source lies below the edge at those distances from its
    ends, and the tip above. If the straight line between them misses the edge, the path follows a side of the triangle.
    """
    edge = b - a
    length = np.maximum(np.linalg.norm(edge, axis=1), 1e-12)
    tip_x = np.einsum("ij,ij->i", tip - a, edge) / length
    tip_y = np.sqrt(np.maximum(np.einsum("ij,ij->i", tip - a, tip - a) - tip_x**2, 0))
    sides = np.minimum(at_a + np.hypot(tip_x, tip_y), at_b + np.hypot(tip_x - length, tip_y))
    both = np.isfinite(at_a) & np.isfinite(at_b)
    at_a, at_b = np.where(both, at_a, 0), np.where(both, at_b, 0)
    source_x = (at_a**2 - at_b**2 + length**2) / (2 * length)
    depth = at_a**2 - source_x**2
    source_y = np.sqrt(np.maximum(depth, 0))
    crossing = source_x + (tip_x - source_x) * source_y / np.maximum(source_y + tip_y, 1e-12)
    straight = both & (depth >= 0) & (crossing >= 0) & (crossing <= length)
    result: NDArray[np.float64] = np.where(straight, np.hypot(tip_x - source_x, tip_y + source_y), sides)
    return result
