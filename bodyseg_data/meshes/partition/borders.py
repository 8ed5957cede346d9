"""Borders between parts: the landmark nearest to a point inside a triangle whose corners have different labels.

A partition holds the exact distance of each vertex to its own landmark. A triangle that parts share also needs the
distance of each corner to the landmarks of the *other* corners. Those landmarks are near, so their distances are
extended across the border triangle by triangle: a wave that passes an edge goes on in a straight line in the unfolded
plane (the update of Kimmel and Sethian, Computing geodesic paths on manifolds, PNAS 1998, with the exact
distance to a point source in place of a plane wave).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.meshes.mesh import Mesh

_ROUNDS: Final = 4  # triangles by which distances are extended across a border
_PARTS: Final = 64  # above the number of parts: encodes (vertex, part) as one number


@dataclass(frozen=True)
class Borders:
    """The triangles that parts share. faces: int32 [B], ascending. distance: float64 [B, 3, 3], metres, from corner c
    of a triangle (last axis) to the landmark of its corner s (middle axis).
    """

    faces: NDArray[np.int32]
    distance: NDArray[np.float64]

    def nearest_corner(self, faces: NDArray[np.int32], weights: NDArray[np.float64]) -> NDArray[np.intp]:
        """Find the corner, 0 to 2, whose landmark is nearest to each point, [N].

        faces: [N], each one of `self.faces`. weights: [N, 3], barycentric. Distances are linear within a triangle.
        """
        distance = self.distance[np.searchsorted(self.faces, faces)]
        nearest: NDArray[np.intp] = np.einsum("nc,nsc->ns", weights, distance).argmin(axis=1)
        return nearest


def find_borders(
    mesh: Mesh,
    labels: NDArray[np.uint8],
    distance: NDArray[np.float64],
    representative: NDArray[np.int64] | None = None,
) -> Borders:
    """Find the borders of a labelled mesh. labels: uint8 [V]. distance: float64 [V], metres, to the landmark of that
    label. representative: int64 [V], as in `MendedSurface`; each vertex itself if None.

    In a triangle with a corner out of reach of all landmarks (infinite distance), points get the label of the nearest
    corner.
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
    points: NDArray[np.float64],
    faces: NDArray[Any],
    labels: NDArray[np.uint8],
    distance: NDArray[np.float64],
    wanted: NDArray[np.int64],
) -> NDArray[np.float64]:
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
    indices = [np.searchsorted(wanted, end * _PARTS + parts[pair]) for end in ends]
    corners = [points[index] for index in (*ends, tip)]
    for _ in range(_ROUNDS):
        at_ends = [
            np.where(labels[end] == parts[pair], distance[end], _lookup(known, wanted, index, end, parts[pair]))
            for end, index in zip(ends, indices, strict=True)
        ]
        np.minimum.at(known, pair, _beyond_edge(*corners, *at_ends))
    return known


def _lookup(
    known: NDArray[np.float64],
    wanted: NDArray[np.int64],
    index: NDArray[np.intp],
    vertices: NDArray[np.int64],
    parts: NDArray[np.int64],
) -> NDArray[np.float64]:
    """Distances [N] found so far for pairs of `vertices` and `parts` [N]; infinite for pairs not in `wanted`."""
    index = np.minimum(index, len(wanted) - 1)
    return np.where(wanted[index] == vertices * _PARTS + parts, known[index], np.inf)


def _beyond_edge(
    a: NDArray[np.float64],
    b: NDArray[np.float64],
    tip: NDArray[np.float64],
    at_a: NDArray[np.float64],
    at_b: NDArray[np.float64],
) -> NDArray[np.float64]:
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
