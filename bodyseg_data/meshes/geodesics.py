"""Distances along a surface to the nearest of many sources, by an exact method and two approximate ones.

Surfaces on which the exact method's library would crash, hang or give wrong results are refused beforehand.
`docs/explanation/partition.md` compares the methods.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from bodyseg_data.core import BadMesh, check_choice
from bodyseg_data.machine import required
from bodyseg_data.meshes.mending import find_fans
from bodyseg_data.meshes.mesh import Edges, Floats, Indices, face_components, find_edges
from bodyseg_data.meshes.repairing import SAME_POINT_M


class Unanswerable(BadMesh):
    """One method of measuring distances fails on this surface; another may work."""


GeodesicMethod = Literal["exact", "unfolded", "edges"]

FALLBACK_METHOD: Final[GeodesicMethod] = "unfolded"
"""The most accurate of the methods that work on any surface."""


@dataclass(frozen=True)
class NearestSources:
    """The nearest source of every vertex. distance: float64 [V], metres. source: int64 [V], its index, 0 to S - 1.
    note: distances that another method gave, in words, or None.
    """

    distance: Floats
    source: Indices
    note: str | None = None


def nearest_sources(method: GeodesicMethod, vertices: Floats, faces: Indices, sources: Indices) -> NearestSources:
    """Find the nearest of `sources` along the surface from every vertex.

    vertices: [V, 3], metres, each used by a face. faces: [F, 3]. sources: [S], distinct vertices; for `exact` at least
    one on each connected piece. Where no path leads, the distance is infinite and the source is arbitrary.

    - exact: window propagation (Mitchell, Mount and Papadimitriou, The discrete geodesic problem, SIAM J. Comput. 16,
      1987), by Kirsanov's pygeodesic; `unfolded` where the path leads through a vertex that alone connects two
      sheets of the surface.
    - unfolded: shortest paths along edges and along the straight lines between the far corners of two neighbouring
      triangles, unfolded into a plane (Lanthier, Maheshwari and Sack, Algorithmica 30, 2001, add points instead).
    - edges: shortest paths along edges (Dijkstra).

    `unfolded` and `edges` never underestimate a distance and work on any surface. `exact` raises Unanswerable, with
    the reason, on surfaces it cannot handle, and MissingLibrary without pygeodesic.
    """
    return METHODS[check_choice("the method for distances", method, METHODS)](vertices, faces, sources)


def refuse_unsupported(method: str, vertices: Floats, faces: Indices) -> None:
    """Raise Unanswerable if `method` cannot handle this surface, as far as faces and edges show it."""
    wrong = f"the method {method!r} cannot answer: "
    flat = np.flatnonzero((faces == np.roll(faces, 1, axis=1)).any(axis=1))
    if len(flat):
        raise Unanswerable(f"{wrong}a face needs three different vertices, found {faces[flat[0]].tolist()}")
    edges = find_edges(faces)
    crowded = np.flatnonzero(edges.faces > 2)
    if len(crowded):
        low, high = edges.ends[crowded[0]]
        found = f"{edges.faces[crowded[0]]} at that of vertices {low} and {high}"
        raise Unanswerable(f"{wrong}an edge may have two faces at most, found {found}")
    lengths = edges.lengths(vertices)
    if lengths.min() < SAME_POINT_M:
        low, high = edges.ends[lengths.argmin()]
        found = f"{lengths.min():.2g} m between {low} and {high}"
        raise Unanswerable(f"{wrong}an edge must be {SAME_POINT_M} m long at least, found {found}")


def _exact(vertices: Floats, faces: Indices, sources: Indices) -> NearestSources:
    refuse_unsupported("exact", vertices, faces)
    fans = find_fans(faces)
    pinches = int(fans.max()) + 1 - len(vertices)
    if not pinches:
        return NearestSources(*_window_propagation(vertices, faces, sources))
    # Windows do not pass a vertex that alone connects sheets: it is split, and paths through it are added afterwards.
    vertex = np.zeros(len(vertices) + pinches, np.int64)
    vertex[fans.ravel()] = faces.ravel()
    starts = np.flatnonzero(np.isin(vertex, sources))
    sheet = face_components(len(vertex), fans)
    used, corners = np.unique(fans[np.isin(sheet[fans[:, 0]], sheet[starts])], return_inverse=True)
    within, nearest = _window_propagation(vertices[vertex[used]], corners.reshape(-1, 3), np.searchsorted(used, starts))
    order = np.argsort(-within, kind="stable")  # the shortest is written last
    distance, source = np.full(len(vertices), np.inf), np.zeros(len(vertices), np.int64)
    distance[vertex[used[order]]] = within[order]
    source[vertex[used[order]]] = _source_indices(sources, len(vertices))[vertex[starts]][nearest[order]]
    bound = _unfolded(vertices, faces, sources)
    through = ~(distance <= bound.distance * (1 + 1e-9))
    return NearestSources(
        np.where(through, bound.distance, distance),
        np.where(through, bound.source, source),
        f"{int(through.sum())} distances by the method 'unfolded', through {pinches} vertices that alone hold sheets "
        "together",
    )


def _window_propagation(vertices: Floats, faces: Indices, sources: Indices) -> tuple[Floats, Indices]:
    """Exact distances and sources, [V]. All vertices must be reachable: pygeodesic reads stray memory for others."""
    pygeodesic = required("pygeodesic.geodesic", "partitioning a body")
    try:
        distance, source = pygeodesic.PyGeodesicAlgorithmExact(vertices, faces.astype(np.int32)).geodesicDistances(
            sources
        )
    except OverflowError:  # what the stray memory held
        distance = source = np.array([np.inf])
    if not np.isfinite(distance).all():
        raise Unanswerable("the method 'exact' cannot answer: some triangles are too thin for its arithmetic")
    return distance, source.astype(np.int64)


def _edges(vertices: Floats, faces: Indices, sources: Indices) -> NearestSources:
    edges = find_edges(faces)
    return _shortest_paths(len(vertices), edges.ends, edges.lengths(vertices), sources)


def _unfolded(vertices: Floats, faces: Indices, sources: Indices) -> NearestSources:
    edges = find_edges(faces)
    lines, lengths = _lines_across_edges(vertices, faces, edges)
    ends = np.concatenate([edges.ends, np.sort(lines, axis=1)])
    lengths = np.concatenate([edges.lengths(vertices), lengths])
    keys = ends[:, 0] * len(vertices) + ends[:, 1]
    order = np.lexsort((lengths, keys))
    first = np.concatenate([[True], np.diff(keys[order]) != 0])
    order = order[first]  # of two paths between the same ends, the shorter
    return _shortest_paths(len(vertices), ends[order], lengths[order], sources)


def _lines_across_edges(vertices: Floats, faces: Indices, edges: Edges) -> tuple[Indices, Floats]:
    """Straight lines on the surface that cross one edge: their ends [N, 2] and lengths [N]."""
    side = edges.of_side.ravel()
    first, second = edges.two_sides().T
    tips = np.stack([np.roll(faces, -2, axis=1).ravel()[each] for each in (first, second)], axis=1)
    start, end = edges.ends[side[first]].T
    along = vertices[end] - vertices[start]
    length = np.linalg.norm(along, axis=1)
    safe = np.maximum(length, np.finfo(np.float64).tiny)
    offsets = vertices[tips] - vertices[start][:, None]
    x = np.einsum("nti,ni->nt", offsets, along) / safe[:, None]
    y = np.sqrt(np.maximum(np.einsum("nti,nti->nt", offsets, offsets) - x**2, 0))
    height = np.maximum(y.sum(axis=1), np.finfo(np.float64).tiny)
    crossing = x[:, 0] + (x[:, 1] - x[:, 0]) * y[:, 0] / height
    straight = (crossing >= 0) & (crossing <= length) & (tips[:, 0] != tips[:, 1])
    return tips[straight], np.hypot(x[:, 0] - x[:, 1], y.sum(axis=1))[straight]


def _shortest_paths(count: int, ends: Indices, lengths: Floats, sources: Indices) -> NearestSources:
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import dijkstra

    lengths = np.maximum(lengths, np.finfo(np.float64).tiny)  # a zero entry would mean no edge
    graph = csr_array((lengths, (ends[:, 0], ends[:, 1])), shape=(count, count))
    distance, _, root = dijkstra(graph, directed=False, indices=sources, min_only=True, return_predecessors=True)
    return NearestSources(distance, _source_indices(sources, count)[np.maximum(root, 0)])  # below 0: no path


def _source_indices(sources: Indices, count: int) -> Indices:
    """Index in `sources` of each of `count` vertices, int64 [count]; that of the last source for any other vertex."""
    number = np.full(count, len(sources) - 1, np.int64)
    number[sources] = np.arange(len(sources))
    return number


METHODS: Final[dict[GeodesicMethod, Callable[[Floats, Indices, Indices], NearestSources]]] = {
    "exact": _exact,
    "unfolded": _unfolded,
    "edges": _edges,
}
