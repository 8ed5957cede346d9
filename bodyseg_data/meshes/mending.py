"""What stops or misleads distances along a surface, taken out of their way: vertices keep their numbers.

`mesh_repair` makes a clean mesh of a scan and renumbers it; here a mesh stays as it is, with its landmarks by vertex,
and only the surface that distances are measured on is mended.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.system_libraries import missing_library
from bodyseg_data.meshes.repair import SAME_POINT_M
from bodyseg_data.meshes.topology import Edges, components, find_edges


@dataclass(frozen=True)
class Mended:
    """A surface fit for distances. faces: int64 [N, 3], those left, in their order. place: int64 [V], the vertex that
    stands for each vertex, mostly itself. notes: what was done, for people; empty for a sound mesh.
    """

    faces: NDArray[np.int64]
    place: NDArray[np.int64]
    notes: tuple[str, ...]


def mend(vertices: NDArray[np.float64], faces: NDArray[Any], feature: str) -> Mended:
    """The surface `faces` [F, 3] of `vertices` [V, 3] without what stops distances.

    Vertices in one place (nearer than `SAME_POINT_M`) become one where an edge joins them or where both lie on the
    surface's rim, as along a seam that was not welded; surfaces that touch stay two. Faces that have a vertex twice
    and all but one of doubled faces go. Of more than two faces at an edge the two best joined to the rest stay: first
    those with the fewest open edges, then the largest. feature: as for `Mesh.pieces`, for MissingLibrary.
    """
    edges = find_edges(faces)
    place = np.arange(len(vertices))
    joined = _same_place(vertices, edges, feature)
    if len(joined):
        component = components(len(vertices), joined, feature)
        _, first = np.unique(component, return_index=True)
        place = first[component]
    kept = place[faces]
    flat = (kept == np.roll(kept, 1, axis=1)).any(axis=1)
    kept = kept[~flat]
    if len(joined) or flat.any():
        edges = find_edges(kept)
    doubled = extra = 0
    if (edges.faces > 2).any():
        _, once = np.unique(np.sort(kept, axis=1), axis=0, return_index=True)
        doubled = len(kept) - len(once)
        kept = kept[np.sort(once)]
        needed = _needed(vertices, kept)
        extra = int((~needed).sum())
        kept = kept[needed]
    done = (
        (int((place != np.arange(len(place))).sum()), "vertices joined to others in the same place"),
        (int(flat.sum()), "faces with no more than two places left out"),
        (doubled, "doubled faces left out"),
        (extra, "faces left out at edges of more than two"),
    )
    return Mended(kept, place, tuple(f"{count} {what}" for count, what in done if count))


def find_fans(faces: NDArray[np.int64], feature: str) -> NDArray[np.int64]:
    """Which fan the corner of each face belongs to, [F, 3]: faces around a vertex that hang together by edges.

    Numbered from 0. There are as many as vertices, unless sheets of the surface hang together by single vertices.
    """
    sides = find_edges(faces).two_sides()
    # Two faces with a common edge hang together at both its ends: corner k of each, and corner k + 1.
    first, second = sides.T
    ahead = [side - side % 3 + (side + 1) % 3 for side in (first, second)]
    same = faces.ravel()[first] == faces.ravel()[second]
    pairs = [
        np.stack([first, np.where(same, second, ahead[1])], axis=1),
        np.stack([ahead[0], np.where(same, ahead[1], second)], axis=1),
    ]
    fans: NDArray[np.int64] = components(faces.size, np.concatenate(pairs), feature).astype(np.int64)
    return fans.reshape(-1, 3)


def _same_place(vertices: NDArray[np.float64], edges: Edges, feature: str) -> NDArray[np.int64]:
    """Pairs of vertices [N, 2] that are one place of the surface."""
    short = edges.ends[edges.lengths(vertices) < SAME_POINT_M]
    rim = np.unique(edges.ends[edges.faces == 1])
    if not len(rim):
        return short
    try:
        from scipy.spatial import KDTree
    except ImportError as error:
        raise missing_library(feature, error) from error
    pairs = rim[KDTree(vertices[rim]).query_pairs(SAME_POINT_M, output_type="ndarray")]
    return np.concatenate([short, pairs])


def _needed(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.bool_]:
    """The faces, bool [F], that are not too many at any of their edges."""
    edges = find_edges(faces)
    needed = np.ones(len(faces), np.bool_)
    sides = np.flatnonzero(edges.faces[edges.of_side.ravel()] > 2)
    edge, face = edges.of_side.ravel()[sides], sides // 3
    open_edges = (edges.faces[edges.of_side] == 1).sum(axis=1)[face]
    a, b, c = np.moveaxis(vertices[faces[face]], 1, 0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    order = np.lexsort((face, -area, open_edges, edge))
    edge, face = edge[order], face[order]
    needed[face[np.arange(len(edge)) - np.searchsorted(edge, edge) >= 2]] = False
    return needed
