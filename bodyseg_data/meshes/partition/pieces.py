"""Pieces of a mesh that lie over a body without being its surface: skirts, coats, hair, shoes, and held things.

Distances along the surface do not reach such a piece, and a piece that joins both legs has no distances of its own. A
point of it gets the label of the body beneath: of the nearest vertex that belongs to one of the parts that the piece
may cover, so that a skirt takes no label from the hand that hangs beside it. A held thing gets none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadLandmarks
from bodyseg_data.core.parts import BACKGROUND, PART_COUNT
from bodyseg_data.meshes.mesh import Mesh


@dataclass(frozen=True)
class SurfacePiece:
    """A connected piece of a mesh that lies over the body. vertex: index of any of its vertices.

    parts: labels, 0 to 32, of which each of its points gets the nearest; none for a thing, whose label is 255. Raises
    BadLandmarks for other labels.
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
    distance: NDArray[np.float64],
) -> NDArray[np.bool_]:
    """Label the vertices of `pieces` in place, and return which they are, bool [V].

    piece_of_vertex: int32 [V], index of the connected piece of each vertex. labels: uint8 [V], right wherever
    `distance` [V], metres, is finite. Raises BadLandmarks for a piece that holds a landmark or lies outside the mesh.
    """
    from scipy.spatial import cKDTree

    over = np.zeros(len(labels), np.bool_)
    for piece in pieces:
        if not 0 <= piece.vertex < len(labels):
            raise BadLandmarks(f"mesh {mesh.name}: a piece over the body must be a vertex, found {piece.vertex}")
        own = piece_of_vertex == piece_of_vertex[piece.vertex]
        if np.isfinite(distance[own]).any():
            raise BadLandmarks(f"mesh {mesh.name}: the piece at vertex {piece.vertex} is the body, not over it")
        if piece.parts:
            covered = np.flatnonzero(np.isfinite(distance) & np.isin(labels, piece.parts))
            labels[own] = labels[covered[cKDTree(mesh.vertices[covered]).query(mesh.vertices[own])[1]]]
        else:
            labels[own] = BACKGROUND
        over |= own
    return over
