"""Two more ways to measure distance along a surface, by potpourri3d, with which `bench partition` compares ours.

- marching: fast marching (Kimmel and Sethian, PNAS 95, 1998).
- heat: the heat method (Crane, Weischedel and Wardetzky, ACM Trans. Graph. 32, 2013) on an intrinsic Delaunay
  triangulation of the tufted cover (Sharp and Crane 2020), one source at a time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Final, cast

import numpy as np
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu

from bodyseg_data.meshes import GeodesicMethod, find_edges
from bodyseg_data.meshes.geodesics import METHODS, NearestSources, Unanswerable, refuse_unsupported
from bodyseg_data.meshes.mesh import Floats, Indices, components


@contextmanager
def rivals_installed() -> Iterator[None]:
    """Let `nearest_sources` and `partition` take "marching" and "heat", too, until the end of the block."""
    METHODS.update(RIVALS)
    try:
        yield
    finally:
        for name in RIVALS:
            del METHODS[name]


def _marching(vertices: Floats, faces: Indices, sources: Indices) -> NearestSources:
    refuse_unsupported("marching", vertices, faces)
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
    edges = find_edges(faces)  # more than two faces at one are no obstacle
    refuse_unsupported("heat", vertices, faces[(edges.faces[edges.of_side] <= 2).all(axis=1)])
    solver = _potpourri_solver("heat", "MeshHeatMethodDistanceSolver", vertices, faces)
    # One field for all sources at once would not identify the nearest, and blurs the borders where they meet.
    fields = np.stack([_call("heat", solver.compute_distance, int(source)) for source in sources])
    if not np.isfinite(fields).all():
        raise Unanswerable("the method 'heat' cannot answer: its system of equations has no finite solution")
    fields = np.maximum(fields - fields[np.arange(len(sources)), sources][:, None], 0)
    piece = components(len(vertices), edges.ends)
    fields[piece[sources][:, None] != piece] = np.inf  # the library gives finite values there
    return NearestSources(fields.min(axis=0), fields.argmin(axis=0))


def _potpourri_solver(method: str, solver: str, vertices: Floats, faces: Indices) -> Any:
    import potpourri3d

    return _call(method, getattr(potpourri3d, solver), vertices, faces.astype(np.int32))


def _call(method: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function of potpourri3d, whose RuntimeError for unsuitable surfaces becomes Unanswerable."""
    try:
        return function(*arguments)
    except RuntimeError as error:
        reason = " ".join(str(error).split())
        raise Unanswerable(f"the method {method!r} cannot answer: {reason}") from error


RIVALS: Final = {cast(GeodesicMethod, "marching"): _marching, cast(GeodesicMethod, "heat"): _heat}
