"""Removal of defects that prevent or distort distances along a surface; vertex indices do not change.

`repair` makes a clean mesh of a scan and renumbers its vertices. Here the mesh stays as it is, so landmarks by
vertex stay valid, and only the faces along which distances are measured are mended.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.meshes.mesh import Edges, components, face_normals, find_edges
from bodyseg_data.meshes.repairing import SAME_POINT_M


@dataclass(frozen=True)
class MendedSurface:
    """A surface along which distances can be measured.

    faces: int64 [N, 3], the faces kept, in their order. representative: int64 [V], for each vertex the one that
    replaces it, mostly itself. notes: the changes in words; empty for a sound mesh.
    """

    faces: NDArray[np.int64]
    representative: NDArray[np.int64]
    notes: tuple[str, ...]


def mend(vertices: NDArray[np.float64], faces: NDArray[Any]) -> MendedSurface:
    """Remove the defects of the surface `faces` [F, 3] of `vertices` [V, 3], metres.

    Vertices closer than `SAME_POINT_M` are joined if an edge connects them or both lie on the boundary of the surface,
    as along an unwelded seam; surfaces that only touch stay apart. Faces with a repeated vertex and duplicate faces are
    removed. Of more than two faces at an edge two are kept: those with the fewest open edges, then the largest.
    """
    edges = find_edges(faces)
    representative = np.arange(len(vertices))
    joined = _coincident_pairs(vertices, edges)
    if len(joined):
        component = components(len(vertices), joined)
        _, first = np.unique(component, return_index=True)
        representative = first[component]
    kept = representative[faces]
    flat = (kept == np.roll(kept, 1, axis=1)).any(axis=1)
    kept = kept[~flat]
    if len(joined) or flat.any():
        edges = find_edges(kept)
    doubled = extra = 0
    if (edges.faces > 2).any():
        _, once = np.unique(np.sort(kept, axis=1), axis=0, return_index=True)
        doubled = len(kept) - len(once)
        kept = kept[np.sort(once)]
        needed = _kept_at_edges(vertices, kept)
        extra = int((~needed).sum())
        kept = kept[needed]
    done = (
        (int((representative != np.arange(len(representative))).sum()), "vertices joined to others in the same place"),
        (int(flat.sum()), "faces with no more than two places left out"),
        (doubled, "doubled faces left out"),
        (extra, "faces left out at edges of more than two"),
    )
    return MendedSurface(kept, representative, tuple(f"{count} {what}" for count, what in done if count))


def welded(vertices: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Join vertices [V, 3] of equal coordinates, as files repeat them for each triangle or along a seam of textures.

    Returns the kept vertices, int64 [W], the first in each place, ascending; each vertex's index in them, int64 [V].
    """
    _, first, place = np.unique(vertices + 0.0, axis=0, return_index=True, return_inverse=True)  # -0.0 is 0.0
    order = np.argsort(first)
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    return first[order].astype(np.int64), rank[place.ravel()]


def find_fans(faces: NDArray[np.int64]) -> NDArray[np.int64]:
    """Index of the fan that each corner of `faces` [F, 3] belongs to, int64 [F, 3], from 0.

    A fan is the faces around one vertex that are connected through edges. There are as many fans as vertices, unless
    sheets of the surface are connected by single vertices only.
    """
    sides = find_edges(faces).two_sides()
    # Two faces with a common edge are connected at both its ends: corner k of each, and corner k + 1.
    first, second = sides.T
    ahead = [side - side % 3 + (side + 1) % 3 for side in (first, second)]
    same = faces.ravel()[first] == faces.ravel()[second]
    pairs = [
        np.stack([first, np.where(same, second, ahead[1])], axis=1),
        np.stack([ahead[0], np.where(same, ahead[1], second)], axis=1),
    ]
    fans: NDArray[np.int64] = components(faces.size, np.concatenate(pairs)).astype(np.int64)
    return fans.reshape(-1, 3)


def _coincident_pairs(vertices: NDArray[np.float64], edges: Edges) -> NDArray[np.int64]:
    """Pairs of vertices [N, 2] that are the same point of the surface."""
    from scipy.spatial import KDTree

    short = edges.ends[edges.lengths(vertices) < SAME_POINT_M]
    rim = np.unique(edges.ends[edges.faces == 1])
    if not len(rim):
        return short
    pairs = rim[KDTree(vertices[rim]).query_pairs(SAME_POINT_M, output_type="ndarray")]
    return np.concatenate([short, pairs])


def _kept_at_edges(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Mask of the faces that are among the two kept at each of their edges, bool [F]."""
    edges = find_edges(faces)
    needed = np.ones(len(faces), np.bool_)
    sides = np.flatnonzero(edges.faces[edges.of_side.ravel()] > 2)
    edge, face = edges.of_side.ravel()[sides], sides // 3
    open_edges = (edges.faces[edges.of_side] == 1).sum(axis=1)[face]
    area = np.linalg.norm(face_normals(vertices, faces[face]), axis=1)
    order = np.lexsort((face, -area, open_edges, edge))
    edge, face = edge[order], face[order]
    needed[face[np.arange(len(edge)) - np.searchsorted(edge, edge) >= 2]] = False
    return needed
