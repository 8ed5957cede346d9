"""Distances along a surface to the nearest of many sources, by an exact method and four approximate ones.

Surfaces on which a method's library would crash, hang or give wrong results are refused beforehand.
`docs/explanation/partition.md` compares the methods.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadConfig, Unanswerable
from bodyseg_data.core.system.libraries import missing_library
from bodyseg_data.meshes.mending import find_fans
from bodyseg_data.meshes.repair import SAME_POINT_M
from bodyseg_data.meshes.topology import Edges, components, face_components, find_edges

GeodesicMethod = Literal["exact", "unfolded", "edges", "marching", "heat"]

FALLBACK_METHOD: Final[GeodesicMethod] = "unfolded"
"""The most accurate of the methods that work on any surface."""

_FEATURE: Final = "partitioning a body"

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True)
class NearestSources:
    """The nearest source of every vertex. distance: float64 [V], metres. source: int64 [V], its index, 0 to S - 1.
    note: distances that another method gave, in words, or None.
    """

    distance: Floats
    source: Indices
    note: str | None = None


def check_method(name: str) -> None:
    """Raise BadConfig unless there is a method of this name."""
    if name not in _METHODS:
        raise BadConfig(f"the method for distances must be one of {', '.join(_METHODS)}, found {name!r}")


def nearest_sources(method: GeodesicMethod, vertices: Floats, faces: Indices, sources: Indices) -> NearestSources:
    """Find the nearest of `sources` along the surface from every vertex.

    vertices: [V, 3], metres, each used by a face. faces: [F, 3]. sources: [S], distinct vertices, at least one on each
    connected piece. Where no path leads, the distance is infinite and the source is arbitrary.

    - exact: window propagation (Mitchell, Mount and Papadimitriou, The discrete geodesic problem, SIAM J. Comput. 16,
      1987), by Kirsanov's pygeodesic; `unfolded` where the path leads through a vertex that alone connects two
      sheets of the surface.
    - unfolded: shortest paths along edges and along the straight lines between the far corners of two neighbouring
      triangles, unfolded into a plane (Lanthier, Maheshwari and Sack, Algorithmica 30, 2001, add points instead).
    - edges: shortest paths along edges (Dijkstra).
    - marching: fast marching (Kimmel and Sethian, PNAS 95, 1998), by potpourri3d.
    - heat: the heat method (Crane, Weischedel and Wardetzky, ACM Trans. Graph. 32, 2013) on an intrinsic Delaunay
      triangulation of the tufted cover (Sharp and Crane 2020), by potpourri3d, one source at a time.

    `unfolded` and `edges` never underestimate a distance and work on any surface. The others raise Unanswerable, with
    the reason, on surfaces they cannot handle. Raises MissingLibrary without the library of the method.
    """
    reason = unsupported_reason(method, vertices, faces)
    if reason is not None:
        raise Unanswerable(f"the method {method!r} cannot answer: {reason}")
    return _METHODS[method](vertices, faces, sources)


def unsupported_reason(method: GeodesicMethod, vertices: Floats, faces: Indices) -> str | None:
    """Reason in one line why `method` cannot handle this surface, as far as faces and edges show it; else None."""
    if method in ("edges", "unfolded"):
        return None
    flat = np.flatnonzero((faces == np.roll(faces, 1, axis=1)).any(axis=1))
    if len(flat):
        return f"a face needs three different vertices, found {faces[flat[0]].tolist()}"
    edges = find_edges(faces)
    crowded = np.flatnonzero(edges.faces > 2)
    if len(crowded) and method != "heat":
        low, high = edges.ends[crowded[0]]
        return (
            f"an edge may have two faces at most, found {edges.faces[crowded[0]]} at that of vertices {low} and {high}"
        )
    lengths = edges.lengths(vertices)
    if lengths.min() < SAME_POINT_M:
        low, high = edges.ends[lengths.argmin()]
        return f"an edge must be {SAME_POINT_M} m long at least, found {lengths.min():.2g} m between {low} and {high}"
    return None


def _exact(vertices: Floats, faces: Indices, sources: Indices) -> NearestSources:
    fans = find_fans(faces, _FEATURE)
    pinches = int(fans.max()) + 1 - len(vertices)
    if not pinches:
        return NearestSources(*_window_propagation(vertices, faces, sources))
    # Windows do not pass a vertex that alone connects sheets: it is split, and paths through it are added afterwards.
    vertex = np.zeros(len(vertices) + pinches, np.int64)
    vertex[fans.ravel()] = faces.ravel()
    starts = np.flatnonzero(np.isin(vertex, sources))
    sheet = face_components(len(vertex), fans, _FEATURE)
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
    try:
        from pygeodesic.geodesic import PyGeodesicAlgorithmExact
    except ImportError as error:
        raise missing_library(_FEATURE, error) from error
    try:
        distance, source = PyGeodesicAlgorithmExact(vertices, faces.astype(np.int32)).geodesicDistances(sources)
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
    try:
        from scipy.sparse import csr_array
        from scipy.sparse.csgraph import dijkstra
    except ImportError as error:
        raise missing_library(_FEATURE, error) from error
    lengths = np.maximum(lengths, np.finfo(np.float64).tiny)  # a zero entry would mean no edge
    graph = csr_array((lengths, (ends[:, 0], ends[:, 1])), shape=(count, count))
    distance, _, root = dijkstra(graph, directed=False, indices=sources, min_only=True, return_predecessors=True)
    return NearestSources(distance, _source_indices(sources, count)[root])


def _marching(vertices: Floats, faces: Indices, sources: Indices) -> NearestSources:
    solver = _potpourri_solver("marching", "MeshFastMarchingDistanceSolver", vertices, faces)
    # A curve of one vertex for each source; the empty list means initial distances of zero.
    distance = _call("marching", solver.compute_distance, [[(int(source), [])] for source in sources])
    return NearestSources(distance, _source_of_wave(vertices, faces, sources, distance))


def _source_of_wave(vertices: Floats, faces: Indices, sources: Indices, distance: Floats) -> Indices:
    """Index in `sources` of the source whose wave arrived first at each vertex, int64 [V]; fast marching gives none.

    distance: [V], metres. A wave arrives at a vertex across an edge of a triangle. The vertex gets a mean of the
    sources' shares at the ends of that edge, weighted by where the wave's normal through the vertex crosses it. The
    source with the largest share is chosen.
    """
    from scipy.sparse import csc_array
    from scipy.sparse.linalg import splu

    count = len(vertices)
    tip, a, b = (np.roll(faces, -turn, axis=1).ravel() for turn in range(3))
    arrival, share = _plane_wave(vertices[a], vertices[b], vertices[tip], distance[a], distance[b])
    order = np.lexsort((arrival, tip))
    best = order[np.concatenate([[True], np.diff(tip[order]) != 0])]
    best = best[~np.isin(tip[best], sources)]
    tip, ends = tip[best], np.stack([a[best], b[best]], axis=1)
    weights = np.stack([1 - share[best], share[best]], axis=1)
    earlier = distance[ends] < distance[tip][:, None]  # a wave arrives from earlier vertices
    weights = np.where(earlier, np.maximum(weights, 1e-9), 0)
    total = weights.sum(axis=1)
    reached = np.isfinite(distance[tip])
    if (total[reached] == 0).any():
        position = vertices[tip[reached & (total == 0)][0]].tolist()
        raise Unanswerable(
            f"the method 'marching' cannot answer: its distances have a minimum of their own at {position}"
        )
    weights, tip, ends = (weights / total[:, None])[reached], tip[reached], ends[reached]
    # In the order of arrival every vertex depends on earlier ones only: a triangular system.
    rank = np.empty(count, np.int64)
    rank[np.argsort(distance, kind="stable")] = np.arange(count)
    rows = np.concatenate([np.arange(count), rank[tip], rank[tip]])
    columns = np.concatenate([np.arange(count), *rank[ends].T])
    system = csc_array((np.concatenate([np.ones(count), *-weights.T]), (rows, columns)), shape=(count, count))
    own = np.zeros((count, len(sources)))
    own[rank[sources], np.arange(len(sources))] = 1
    shares = splu(system, permc_spec="NATURAL", diag_pivot_thresh=0).solve(own)
    winner: Indices = shares.argmax(axis=1)[rank]
    return winner


def _plane_wave(a: Floats, b: Floats, tip: Floats, at_a: Floats, at_b: Floats) -> tuple[Floats, Floats]:
    """Distances [N] at which a plane wave reaches `tip` [N, 3] that reaches `a` and `b` [N, 3] at the distances `at_a`
    and `at_b` [N], and the points where its normal through the tip crosses the edge, 0 at a to 1 at b, [N].
    """
    length = np.maximum(np.linalg.norm(b - a, axis=1), np.finfo(np.float64).tiny)
    x = np.einsum("ni,ni->n", tip - a, b - a) / length
    y = np.sqrt(np.maximum(np.einsum("ni,ni->n", tip - a, tip - a) - x**2, 0))
    both = np.isfinite(at_a) & np.isfinite(at_b)
    slope = np.clip(np.where(both, np.where(both, at_b, 0) - np.where(both, at_a, 0), 0) / length, -1, 1)
    rise = np.maximum(np.sqrt(1 - slope**2), 1e-9)
    crossing = np.clip(x - y * slope / rise, 0, length)
    return at_a + slope * crossing + np.hypot(x - crossing, y), crossing / length


def _heat(vertices: Floats, faces: Indices, sources: Indices) -> NearestSources:
    solver = _potpourri_solver("heat", "MeshHeatMethodDistanceSolver", vertices, faces)
    # One field for all sources at once would not identify the nearest, and blurs the borders where they meet.
    fields = np.stack([_call("heat", solver.compute_distance, int(source)) for source in sources])
    if not np.isfinite(fields).all():
        raise Unanswerable("the method 'heat' cannot answer: its system of equations has no finite solution")
    fields = np.maximum(fields - fields[np.arange(len(sources)), sources][:, None], 0)
    piece = components(len(vertices), find_edges(faces).ends, _FEATURE)
    fields[piece[sources][:, None] != piece] = np.inf  # the library gives finite values there
    return NearestSources(fields.min(axis=0), fields.argmin(axis=0))


def _potpourri_solver(method: GeodesicMethod, solver: str, vertices: Floats, faces: Indices) -> Any:
    try:
        import potpourri3d
    except ImportError as error:
        raise missing_library(_FEATURE, error) from error
    return _call(method, getattr(potpourri3d, solver), vertices, faces.astype(np.int32))


def _call(method: GeodesicMethod, function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function of potpourri3d, whose RuntimeError for unsuitable surfaces becomes Unanswerable."""
    try:
        return function(*arguments)
    except RuntimeError as error:
        reason = " ".join(str(error).split())
        raise Unanswerable(f"the method {method!r} cannot answer: {reason}") from error


def _source_indices(sources: Indices, count: int) -> Indices:
    """Index in `sources` of each of `count` vertices, int64 [count]; that of the last source for any other vertex."""
    number = np.full(count, len(sources) - 1, np.int64)
    number[sources] = np.arange(len(sources))
    return number


_METHODS: Final[dict[GeodesicMethod, Callable[[Floats, Indices, Indices], NearestSources]]] = {
    "exact": _exact,
    "unfolded": _unfolded,
    "edges": _edges,
    "marching": _marching,
    "heat": _heat,
}
