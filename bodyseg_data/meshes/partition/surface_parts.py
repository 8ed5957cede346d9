"""Body parts as territories: every point of the surface belongs to the landmark that is nearest along the surface."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadLandmarks, Unanswerable
from bodyseg_data.core.parts import LANDMARKS, PART_COUNT
from bodyseg_data.meshes.mending import Mended, mend
from bodyseg_data.meshes.mesh import Mesh
from bodyseg_data.meshes.nearest import nearest_corner
from bodyseg_data.meshes.partition.borders import Borders, find_borders
from bodyseg_data.meshes.partition.geodesics import ALWAYS_ANSWERS, Geodesics, check_method, nearest_sources
from bodyseg_data.meshes.topology import components

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
    note: str | None = None

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


def partition(mesh: Mesh, landmarks: NDArray[np.int64], method: Geodesics = "exact") -> Partition:
    """Label every vertex of `mesh` with its nearest landmark along the surface, from all of them at once.

    landmarks: int64 [33], one vertex for each of `parts.PARTS`, in that order. method: how distances are measured
    (`geodesics.nearest_sources`).

    What stops distances along the surface is mended first (`mending.mend`): seams that are not welded, doubled faces,
    faces without three places, edges with more than two faces. If `method` cannot answer even so,
    `geodesics.ALWAYS_ANSWERS` does. Either is told in the partition's `note`.

    A body made of several pieces, like a head with separate eyes, may have landmarks on some of them only: a vertex of
    any other piece takes the label of the nearest labelled triangle, of that triangle's corner nearest to it.

    Raises BadLandmarks for landmarks that are not 33 different vertices in different places of the surface, BadConfig
    for a method that is none, MissingLibrary without pygeodesic (potpourri3d for `marching` and `heat`), scipy,
    trimesh or rtree.
    """
    check_method(method)
    landmarks = _checked_landmarks(mesh, landmarks)
    mended = mend(mesh.vertices, mesh.faces, _FEATURE)
    _check_places(mesh, landmarks, mended)
    told = list(mended.notes)
    try:
        labels, distance, note = _spread(mesh, landmarks, mended, method)
    except Unanswerable as error:
        told.insert(0, str(error))
        method = ALWAYS_ANSWERS
        labels, distance, note = _spread(mesh, landmarks, mended, method)
    told += [] if note is None else [note]
    line = f"distances by the method {method!r}: {', '.join(told)}" if told else None
    return _with_borders(mesh, mended, labels, distance, line)


def partition_unmended(mesh: Mesh, landmarks: NDArray[np.int64], method: Geodesics) -> Partition:
    """What `method` makes of `mesh` as it is, to measure what mending and falling back are worth.

    As `partition`, but raises Unanswerable where that answers with a note.
    """
    as_it_is = Mended(mesh.faces.astype(np.int64), np.arange(len(mesh.vertices)), ())
    return _with_borders(mesh, as_it_is, *_spread(mesh, _checked_landmarks(mesh, landmarks), as_it_is, method))


def _spread(
    mesh: Mesh, landmarks: NDArray[np.int64], surface: Mended, method: Geodesics
) -> tuple[NDArray[np.uint8], NDArray[np.float64], str | None]:
    """Labels [V] and distances [V] from the landmarks over `surface`, and the answer's note. Raises Unanswerable."""
    sources = surface.place[landmarks]
    piece = components(len(mesh.vertices), surface.faces[:, [0, 1, 1, 2]].reshape(-1, 2), _FEATURE)
    faces = surface.faces[np.isin(piece[surface.faces[:, 0]], piece[sources])]
    # Numbered afresh: no method wants vertices without faces, and pieces without landmarks only cost time.
    used, corners = np.unique(faces, return_inverse=True)
    labels = np.zeros(len(mesh.vertices), np.uint8)
    distance = np.full(len(mesh.vertices), np.inf)
    answer = nearest_sources(method, mesh.vertices[used], corners.reshape(-1, 3), np.searchsorted(used, sources))
    distance[used], labels[used] = answer.distance, answer.source
    return labels[surface.place], distance[surface.place], answer.note


def _with_borders(
    mesh: Mesh, surface: Mended, labels: NDArray[np.uint8], distance: NDArray[np.float64], note: str | None
) -> Partition:
    unreached = np.flatnonzero(~np.isfinite(distance))
    if len(unreached):
        reached_faces = surface.faces[np.isfinite(distance[surface.faces]).all(axis=1)].astype(np.int32)
        nearest, _ = nearest_corner(mesh.vertices, reached_faces, mesh.vertices[unreached], _FEATURE)
        labels[unreached] = labels[nearest]
        labels = labels[surface.place]
    for array in (labels, distance):
        array.flags.writeable = False
    return Partition(labels, distance, find_borders(mesh, labels, distance, surface.place), note)


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


def _check_places(mesh: Mesh, landmarks: NDArray[np.int64], mended: Mended) -> None:
    """Each landmark must be a place of its own on the mended surface."""
    sources = mended.place[landmarks]
    kept = np.isin(sources, mended.faces)
    if not kept.all():
        lost = int(np.flatnonzero(~kept)[0])
        raise BadLandmarks(
            f"mesh {mesh.name}: landmarks must lie on the surface, found {LANDMARKS[lost]} at {landmarks[lost]}, where "
            f"nothing is left of it: {', '.join(mended.notes)}"
        )
    first: dict[int, str] = {}
    for name, place in zip(LANDMARKS, sources.tolist(), strict=True):
        if place in first:
            raise BadLandmarks(
                f"mesh {mesh.name}: landmarks must lie in different places, found {first[place]} and {name} at "
                f"{mesh.vertices[place].tolist()}"
            )
        first[place] = name
