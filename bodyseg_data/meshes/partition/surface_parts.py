"""Partition of a body's surface: every point gets the part of the landmark that is nearest along the surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadLandmarks, Unanswerable
from bodyseg_data.core.parts import LANDMARKS, PART_COUNT
from bodyseg_data.meshes.mending import MendedSurface, mend
from bodyseg_data.meshes.mesh import Mesh
from bodyseg_data.meshes.nearest import nearest_corner
from bodyseg_data.meshes.partition.borders import Borders, find_borders
from bodyseg_data.meshes.partition.geodesics import FALLBACK_METHOD, GeodesicMethod, check_method, nearest_sources
from bodyseg_data.meshes.partition.pieces import SurfacePiece, label_pieces
from bodyseg_data.meshes.topology import face_components

_FEATURE: Final = "partitioning a body"


@dataclass(frozen=True)
class Partition:
    """The part of every vertex of one mesh, and of every point of its triangles.

    labels: uint8 [V], 0 to 32, index in `parts.PARTS`; 255 on things. distance: float64 [V], metres along the surface
    to the landmark of that part; infinite where no landmark can be reached (another piece of the surface, or a vertex
    that no face uses), where the label is that of the nearest reached triangle in a straight line, or, on a
    `SurfacePiece`, of the nearest vertex of the parts that it covers. borders: the triangles that parts share. note:
    repairs and a change of method in words, or None.
    """

    labels: NDArray[np.uint8]
    distance: NDArray[np.float64]
    borders: Borders
    note: str | None = None

    def labels_at(self, mesh: Mesh, faces: NDArray[np.int32], points: NDArray[np.float64]) -> NDArray[np.uint8]:
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
    mesh: Mesh, landmarks: NDArray[np.int64], method: GeodesicMethod = "exact", pieces: Sequence[SurfacePiece] = ()
) -> Partition:
    """Label every vertex of `mesh` with its nearest landmark along the surface.

    landmarks: vertex indices [33] of any integer dtype, one for each of `parts.PARTS`, in that order. method: of
    measuring distances (`geodesics.nearest_sources`). pieces: those that lie over the body (`Body.pieces`).

    Defects that prevent distances along the surface are mended first (`mending.mend`): seams that are not welded,
    duplicate and degenerate faces, edges with more than two faces. If `method` fails even so,
    `geodesics.FALLBACK_METHOD` is used. The partition's `note` reports both.

    A body of several pieces, like a head with separate eyes, may have landmarks on some of them only: a vertex of
    any other piece gets the label of the nearest labelled triangle, of that triangle's corner nearest to it.

    Raises BadLandmarks for landmarks that are not 33 vertices at distinct points of the surface or pieces that are not
    over the body, BadConfig for an unknown method, MissingLibrary without pygeodesic, scipy, trimesh or
    rtree.
    """
    check_method(method)
    landmarks = _checked_landmarks(mesh, landmarks)
    mended = mend(mesh.vertices, mesh.faces, _FEATURE)
    _check_distinct_points(mesh, landmarks, mended)
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


def partition_unmended(mesh: Mesh, landmarks: NDArray[np.int64], method: GeodesicMethod) -> Partition:
    """Partition `mesh` by `method` without mending or a fallback method, to measure the effect of both.

    As `partition`, but raises Unanswerable if `method` fails.
    """
    unmended = MendedSurface(mesh.faces.astype(np.int64), np.arange(len(mesh.vertices)), ())
    return _with_borders(
        mesh, unmended, *_nearest_landmarks(mesh, _checked_landmarks(mesh, landmarks), unmended, method)
    )


def _nearest_landmarks(
    mesh: Mesh, landmarks: NDArray[np.int64], surface: MendedSurface, method: GeodesicMethod
) -> tuple[NDArray[np.uint8], NDArray[np.float64], str | None]:
    """Labels [V] and distances [V] from the landmarks along `surface`, and the method's note. Raises Unanswerable."""
    sources = surface.representative[landmarks]
    piece = face_components(len(mesh.vertices), surface.faces, _FEATURE)
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
    distance: NDArray[np.float64],
    note: str | None,
    pieces: Sequence[SurfacePiece] = (),
) -> Partition:
    reached = np.isfinite(distance)
    if pieces:
        piece = face_components(len(mesh.vertices), surface.faces, _FEATURE)
        reached |= label_pieces(mesh, pieces, piece, labels, distance)
    unreached = np.flatnonzero(~reached)
    if len(unreached):
        reached_faces = surface.faces[np.isfinite(distance[surface.faces]).all(axis=1)].astype(np.int32)
        nearest, _ = nearest_corner(mesh.vertices, reached_faces, mesh.vertices[unreached], _FEATURE)
        labels[unreached] = labels[nearest]
        labels = labels[surface.representative]
    for array in (labels, distance):
        array.flags.writeable = False
    return Partition(labels, distance, find_borders(mesh, labels, distance, surface.representative), note)


def _checked_landmarks(mesh: Mesh, landmarks: NDArray[Any]) -> NDArray[np.int64]:
    where = f"mesh {mesh.name}"
    landmarks = np.asarray(landmarks)
    if landmarks.shape != (PART_COUNT,) or not np.issubdtype(landmarks.dtype, np.integer):
        raise BadLandmarks(
            f"{where}: landmarks must be {PART_COUNT} whole numbers, found {landmarks.dtype} {landmarks.shape}"
        )
    surface = np.zeros(len(mesh.vertices), np.bool_)
    surface[mesh.faces] = True
    for name, vertex in zip(LANDMARKS, landmarks.tolist(), strict=True):
        if not 0 <= vertex < len(surface):
            raise BadLandmarks(f"{where}: landmarks must be vertices 0 to {len(surface) - 1}, found {name} at {vertex}")
        if not surface[vertex]:
            raise BadLandmarks(f"{where}: landmarks must lie on the surface, found {name} at {vertex}, in no face")
    return landmarks.astype(np.int64)


def _check_distinct_points(mesh: Mesh, landmarks: NDArray[np.int64], mended: MendedSurface) -> None:
    """Raise BadLandmarks unless the landmarks are distinct points of the mended surface."""
    sources = mended.representative[landmarks]
    kept = np.isin(sources, mended.faces)
    if not kept.all():
        lost = int(np.flatnonzero(~kept)[0])
        raise BadLandmarks(
            f"mesh {mesh.name}: landmarks must lie on the surface, found {LANDMARKS[lost]} at {landmarks[lost]}, where "
            f"nothing is left of it: {', '.join(mended.notes)}"
        )
    first: dict[int, str] = {}
    for name, vertex in zip(LANDMARKS, sources.tolist(), strict=True):
        if vertex in first:
            raise BadLandmarks(
                f"mesh {mesh.name}: landmarks must lie in different places, found {first[vertex]} and {name} at "
                f"{mesh.vertices[vertex].tolist()}"
            )
        first[vertex] = name
