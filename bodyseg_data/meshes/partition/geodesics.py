"""Distance along a surface from many sources at once, and which source is nearest: one exact method and its rivals.

Each method takes only surfaces that it can answer: what makes a library end the process, never end or answer nonsense
is checked first. `docs/partition.md` compares them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadConfig, Unanswerable
from bodyseg_data.core.system_libraries import missing_library
from bodyseg_data.meshes.mending import find_fans
from bodyseg_data.meshes.repair import SAME_POINT_M
from bodyseg_data.meshes.topology import Edges, components, find_edges

Geodesics = Literal["exact", "unfolded", "edges", "marching", "heat"]

ALWAYS_ANSWERS: Final[Geodesics] = "unfolded"
"""The most accurate of the methods that answer on any surface."""

_FEATURE: Final = "partitioning a body"

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True)
class Answer:
    """Distance to the nearest source, float64 [V], metres, and which one it is, int64 [V], 0 to S - 1. note: what was
    answered in another way than asked for, or None.
    """

    distance: Floats
    source: Indices
    note: str | None = None


def check_method(name: str) -> None:
    """Raise BadConfig unless there is a method of this name."""
    if name not in get_args(Geodesics):
        raise BadConfig(f"the method for distances must be one of {', '.join(get_args(Geodesics))}, found {name!r}")


def nearest_sources(method: Geodesics, vertices: Floats, faces: Indices, sources: Indices) -> Answer:
    """The nearest of `sources` along the surface from every vertex.

    vertices: [V, 3], each used by a face. faces: [F, 3]. sources: [S], different vertices, one at least on each
    connected piece. Where no way leads, the distance is infinite and the source means nothing.

    - exact: window propagation (Mitchell, Mount and Papadimitriou, The discrete geodesic problem, SIAM J. Comput. 16,
      1987), by Kirsanov's pygeodesic; that of `unfolded` where the way leads through a vertex that alone holds
      two sheets together.
    - unfolded: shortest paths along edges and along the straight lines between the far corners of two neighbouring
      triangles, unfolded into a plane (Lanthier, Maheshwari and Sack, Algorithmica 30, 2001, add points instead).
    - edges: shortest paths along edges (Dijkstra).
    - marching: fast marching (Kimmel and Sethian, PNAS 95, 1998), by potpourri3d.
    - heat: the heat method (Crane, Weischedel and Wardetzky, ACM Trans. Graph. 32, 2013) on an intrinsic Delaunay
      triangulation of the tufted cover (Sharp and Crane 2020), by potpourri3d, one source at a time.

    The distances of `unfolded` and `edges` are never too short, and these two always answer. The others raise
    Unanswerable, with the reason. Raises MissingLibrary without the library of the method.
    """
    reason = refusal(method, vertices, faces)
    if reason is not None:
        raise Unanswerable(f"the method {method!r} cannot answer: {reason}")
    return _METHODS[method](vertices, faces, sources)


def refusal(method: Geodesics, vertices: Floats, faces: Indices) -> str | None:
    """Why `method` cannot answer on this surface, as far as that shows beforehand: one line, or None."""
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


def _exact(vertices: Floats, faces: Indices, sources: Indices) -> Answer:
    fans = find_fans(faces, _FEATURE)
    pinches = int(fans.max()) + 1 - len(vertices)
    if not pinches:
        return Answer(*_windows(vertices, faces, sources))
    # Windows pass no vertex that alone holds sheets together: each sheet gets its own, and ways through it are added.
    vertex = np.zeros(len(vertices) + pinches, np.int64)
    vertex[fans.ravel()] = faces.ravel()
    starts = np.flatnonzero(np.isin(vertex, sources))
    sheet = components(len(vertex), fans[:, [0, 1, 1, 2]].reshape(-1, 2), _FEATURE)
    used, corners = np.unique(fans[np.isin(sheet[fans[:, 0]], sheet[starts])], return_inverse=True)
    within, nearest = _windows(vertices[vertex[used]], corners.reshape(-1, 3), np.searchsorted(used, starts))
    order = np.argsort(-within, kind="stable")  # the shortest is written last
    distance, source = np.full(len(vertices), np.inf), np.zeros(len(vertices), np.int64)
    distance[vertex[used[order]]] = within[order]
    source[vertex[used[order]]] = _number(sources, len(vertices))[vertex[starts]][nearest[order]]
    bound = _unfolded(vertices, faces, sources)
    through = ~(distance <= bound.distance * (1 + 1e-9))
    return Answer(
        np.where(through, bound.distance, distance),
        np.where(through, bound.source, source),
        f"{int(through.sum())} distances by the method 'unfolded', through {pinches} vertices that alone hold sheets "
        "together",
    )


def _windows(vertices: Floats, faces: Indices, sources: Indices) -> tuple[Floats, Indices]:
    """Exact distances and sources, [V]. Every vertex must be within reach: pygeodesic reads stray memory for others."""
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


def _edges(vertices: Floats, faces: Indices, sources: Indices) -> Answer:
    edges = find_edges(faces)
    return _shortest_paths(len(vertices), edges.ends, edges.lengths(vertices), sources)


def _unfolded(vertices: Floats, faces: Indices, sources: Indices) -> Answer:
    edges = find_edges(faces)
    lines, lengths = _lines_across(vertices, faces, edges)
    ends = np.concatenate([edges.ends, np.sort(lines, axis=1)])
    lengths = np.concatenate([edges.lengths(vertices), lengths])
    keys = ends[:, 0] * len(vertices) + ends[:, 1]
    order = np.lexsort((lengths, keys))
    order = order[np.concatenate([[True], np.diff(keys[order]) != 0])]  # two ways between the same ends: the shorter
    return _shortest_paths(len(vertices), ends[order], lengths[order], sources)


def _lines_across(vertices: Floats, faces: Indices, edges: Edges) -> tuple[Indices, Floats]:
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


def _shortest_paths(count: int, ends: Indices, lengths: Floats, sources: Indices) -> Answer:
    try:
        from scipy.sparse import csr_array
        from scipy.sparse.csgraph import dijkstra
    except ImportError as error:
        raise missing_library(_FEATURE, error) from error
    lengths = np.maximum(lengths, np.finfo(np.float64).tiny)  # an entry of zero would count as no edge
    graph = csr_array((lengths, (ends[:, 0], ends[:, 1])), shape=(count, count))
    distance, _, root = dijkstra(graph, directed=False, indices=sources, min_only=True, return_predecessors=True)
    return Answer(distance, _number(sources, count)[root])


def _marching(vertices: Floats, faces: Indices, sources: Indices) -> Answer:
    solver = _potpourri("marching", "MeshFastMarchingDistanceSolver", vertices, faces)
    # A curve of one vertex for each source; the empty list stands for distances of zero.
    distance = _asked("marching", solver.compute_distance, [[(int(source), [])] for source in sources])
    return Answer(distance, _source_of_wave(vertices, faces, sources, distance))


def _source_of_wave(vertices: Floats, faces: Indices, sources: Indices, distance: Floats) -> Indices:
    """Whose wave it is that reached each vertex at `distance` [V]; fast marching does not say.

    A vertex is reached over the edge of a triangle. Its wave is that of the edge's ends, shared out by where on the
    edge the wave's normal through the vertex crosses; so shares flow from each source, and the largest share wins.
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
    earlier = distance[ends] < distance[tip][:, None]  # a wave comes from where it has been
    weights = np.where(earlier, np.maximum(weights, 1e-9), 0)
    total = weights.sum(axis=1)
    reached = np.isfinite(distance[tip])
    if (total[reached] == 0).any():
        place = vertices[tip[reached & (total == 0)][0]].tolist()
        raise Unanswerable(f"the method 'marching' cannot answer: its distances have a minimum of their own at {place}")
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
    """When a plane wave that is at `a` and `b` [N, 3] at the distances `at_a` and `at_b` [N] is at `tip` [N, 3], [N],
    and where its normal through the tip crosses the edge, 0 at a to 1 at b, [N]. It keeps to the triangle.
    """
    length = np.maximum(np.linalg.norm(b - a, axis=1), np.finfo(np.float64).tiny)
    x = np.einsum("ni,ni->n", tip - a, b - a) / length
    y = np.sqrt(np.maximum(np.einsum("ni,ni->n", tip - a, tip - a) - x**2, 0))
    both = np.isfinite(at_a) & np.isfinite(at_b)
    slope = np.clip(np.where(both, np.where(both, at_b, 0) - np.where(both, at_a, 0), 0) / length, -1, 1)
    rise = np.maximum(np.sqrt(1 - slope**2), 1e-9)
    crossing = np.clip(x - y * slope / rise, 0, length)
    return at_a + slope * crossing + np.hypot(x - crossing, y), crossing / length


def _heat(vertices: Floats, faces: Indices, sources: Indices) -> Answer:
    solver = _potpourri("heat", "MeshHeatMethodDistanceSolver", vertices, faces)
    # The heat of all sources at once would not tell whose it is, and blurs the borders where they meet.
    fields = np.stack([_asked("heat", solver.compute_distance, int(source)) for source in sources])
    if not np.isfinite(fields).all():
        raise Unanswerable("the method 'heat' cannot answer: its system of equations has no finite solution")
    fields = np.maximum(fields - fields[np.arange(len(sources)), sources][:, None], 0)
    piece = components(len(vertices), find_edges(faces).ends, _FEATURE)
    fields[piece[sources][:, None] != piece] = np.inf  # the library answers something there
    return Answer(fields.min(axis=0), fields.argmin(axis=0))


def _potpourri(method: Geodesics, solver: str, vertices: Floats, faces: Indices) -> Any:
    try:
        import potpourri3d
    except ImportError as error:
        raise missing_library(_FEATURE, error) from error
    return _asked(method, getattr(potpourri3d, solver), vertices, faces.astype(np.int32))


def _asked(method: Geodesics, question: Callable[..., Any], *arguments: Any) -> Any:
    """What potpourri3d answers; it refuses surfaces with a RuntimeError."""
    try:
        return question(*arguments)
    except RuntimeError as error:
        reason = " ".join(str(error).split())
        raise Unanswerable(f"the method {method!r} cannot answer: {reason}") from error


def _number(sources: Indices, count: int) -> Indices:
    """The position of each vertex in `sources`, [count]; that of the last for any other vertex."""
    number = np.full(count, len(sources) - 1, np.int64)
    number[sources] = np.arange(len(sources))
    return number


_METHODS: Final[dict[Geodesics, Callable[[Floats, Indices, Indices], Answer]]] = {
    "exact": _exact,
    "unfolded": _unfolded,
    "edges": _edges,
    "marching": _marching,
    "heat": _heat,
}
