"""Closed surfaces of simple things, and pieces of a mesh that lie over a body: skirts, coats, hair, shoes, held things.

Distances along the surface do not reach such a piece, and a piece that joins both legs has no distances of its own. A
point of it gets the label of the body beneath: of the nearest vertex that belongs to one of the parts that the piece
may cover, so that a skirt takes no label from the hand that hangs beside it. A held thing gets none.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadLandmarks
from bodyseg_data.labels import BACKGROUND, PART_COUNT
from bodyseg_data.meshes.mesh import Floats, Indices, Mesh, face_normals, signed_volumes

_CORNERS: Final = np.array([[x, y, z] for z in (-0.5, 0.5) for y in (-0.5, 0.5) for x in (-0.5, 0.5)])
_SIDES: Final = np.array([[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]])
_FACES: Final = np.concatenate([_SIDES[:, [0, 1, 2]], _SIDES[:, [0, 2, 3]]]).astype(np.int32)
_SEGMENTS: Final = 24  # of a turned solid


@dataclass(frozen=True)
class Solid:
    """The surface of things. vertices: float64 [V, 3], metres. faces: int32 [F, 3], normals outwards."""

    vertices: Floats = field(repr=False)
    faces: NDArray[np.int32] = field(repr=False)

    @property
    def normals(self) -> Floats:
        """Outward normals of all faces, float64 [F, 3]; length twice the face's area."""
        return face_normals(self.vertices, self.faces)

    @property
    def volume(self) -> float:
        """Enclosed volume, m3; negative if normals point inwards."""
        corners = self.vertices[self.faces] - self.vertices.mean(axis=0)
        return float(signed_volumes(corners).sum())

    def turned(self, angle_rad: float) -> Solid:
        """The same, rotated about the vertical axis y."""
        cos, sin = math.cos(angle_rad), math.sin(angle_rad)
        return Solid(self.vertices @ np.array([[cos, 0.0, -sin], [0.0, 1.0, 0.0], [sin, 0.0, cos]]), self.faces)

    def moved(self, by_m: tuple[float, float, float]) -> Solid:
        """The same, moved by [3], metres."""
        return Solid(self.vertices + np.asarray(by_m), self.faces)

    def placed(self, axes: Floats, origin: Floats) -> Solid:
        """The same in another frame: `axes` [3, 3] (rows: x, y, z of this frame there, orthonormal), `origin` [3].

        A mirroring would turn normals inwards, so faces are then traversed the other way round.
        """
        mirrored = float(np.linalg.det(axes)) < 0
        return Solid(self.vertices @ axes + origin, self.faces[:, ::-1] if mirrored else self.faces)


def together(solids: list[Solid]) -> Solid:
    """Join solids into one, in their order; the empty list gives one without faces."""
    starts = np.cumsum([0, *(len(solid.vertices) for solid in solids)])
    vertices = [solid.vertices for solid in solids]
    faces = [solid.faces + np.int32(start) for solid, start in zip(solids, starts[:-1], strict=True)]
    none = np.empty((0, 3))
    return Solid(np.concatenate([none, *vertices]), np.concatenate([none.astype(np.int32), *faces]))


def cuboid(size_m: tuple[float, float, float], centre_m: tuple[float, float, float]) -> Solid:
    """A cuboid of 12 triangles with faces along the axes. size_m, centre_m: [3], metres."""
    return Solid(_CORNERS * np.asarray(size_m) + np.asarray(centre_m), _FACES)


def turned_solid(profile_m: list[tuple[float, float]]) -> Solid:
    """A closed solid of revolution about y. profile_m: (radius, height) from the bottom up, metres."""
    angles = np.arange(_SEGMENTS) * (2 * math.pi / _SEGMENTS)
    around = np.stack([np.cos(angles), np.zeros(_SEGMENTS), np.sin(angles)], axis=1)
    rings = [around * radius + (0.0, height, 0.0) for radius, height in profile_m]
    ends = np.array([[0.0, profile_m[0][1], 0.0], [0.0, profile_m[-1][1], 0.0]])
    here = np.arange(_SEGMENTS)
    after, last = (here + 1) % _SEGMENTS, len(rings) * _SEGMENTS
    faces = [np.stack([np.full(_SEGMENTS, last), here, after], axis=1)]
    for ring in range(len(rings) - 1):
        low, high = ring * _SEGMENTS, (ring + 1) * _SEGMENTS
        faces += [
            np.stack([low + here, high + here, high + after], axis=1),
            np.stack([low + here, high + after, low + after], axis=1),
        ]
    top = last - _SEGMENTS
    faces.append(np.stack([top + here, np.full(_SEGMENTS, last + 1), top + after], axis=1))
    return Solid(np.concatenate([*rings, ends]), np.concatenate(faces).astype(np.int32))


@dataclass(frozen=True)
class SurfacePiece:
    """A connected piece of a mesh over the body. vertex: index of any of its vertices.

    parts: labels, 0 to 32, of which a point gets the nearest; none for a thing (255). Raises BadLandmarks for others.
    """

    vertex: int
    parts: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if not all(0 <= part < PART_COUNT for part in self.parts):
            raise BadLandmarks(f"a piece over the body must cover parts 0 to {PART_COUNT - 1}, found {self.parts}")


def label_pieces(
    mesh: Mesh,
    pieces: Sequence[SurfacePiece],
    piece_of_vertex: NDArray[np.int32],
    labels: NDArray[np.uint8],
    distance: Floats,
) -> Indices:
    """Label the vertices of `pieces` in place, and return `Partition.below`, int64 [V].

    piece_of_vertex: int32 [V], index of the connected piece of each vertex. labels: uint8 [V], right wherever
    `distance` [V], metres, is finite. Raises BadLandmarks for a piece that holds a landmark or lies outside the mesh.
    """
    from scipy.spatial import cKDTree

    below = np.arange(len(labels))
    for piece in pieces:
        if not 0 <= piece.vertex < len(labels):
            raise BadLandmarks(f"mesh {mesh.name}: a piece over the body must be a vertex, found {piece.vertex}")
        own = piece_of_vertex == piece_of_vertex[piece.vertex]
        if np.isfinite(distance[own]).any():
            raise BadLandmarks(f"mesh {mesh.name}: the piece at vertex {piece.vertex} is the body, not over it")
        if piece.parts:
            covered = np.flatnonzero(np.isfinite(distance) & np.isin(labels, piece.parts))
            below[own] = covered[cKDTree(mesh.vertices[covered]).query(mesh.vertices[own])[1]]
            labels[own] = labels[below[own]]
        else:
            labels[own], below[own] = BACKGROUND, -1
    return below
