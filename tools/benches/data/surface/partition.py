"""`bench partition`: ways to measure distance along the surface, time against wrongly labelled surface.

On sound bodies every method is compared with the exact one; on bodies broken on purpose each is measured as it is,
and as `partition` uses it: mended first, with a fall-back.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final, get_args

import numpy as np
from numpy.typing import NDArray

from benches.data.surface.broken_bodies import CASES, Broken, scan, sound
from benches.data.surface.rival_geodesics import RIVALS, rivals_installed
from benches.measuring import counter, median_time
from bodyseg_data.bodies import Body, open_source
from bodyseg_data.core import ProgressCallback, silent
from bodyseg_data.meshes import GeodesicMethod, Mesh, Partition, nearest_sources, partition
from bodyseg_data.meshes.geodesics import FALLBACK_METHOD, Unanswerable
from bodyseg_data.meshes.mending import MendedSurface
from bodyseg_data.meshes.partitioning import _nearest_landmarks, _with_borders
from bodyseg_data.packing.options import evenly_sampled

METHODS: Final[tuple[GeodesicMethod, ...]] = (*get_args(GeodesicMethod), *RIVALS)
DEFAULT: Final[GeodesicMethod] = "exact"

OPEN_BODIES: Final = 8
MIT_FRAMES: Final = 3
_POINTS: Final = 4
"""Random points a triangle."""
REPEATS: Final = 3


@rivals_installed()
def bench_partition(mit: Path | None = None, progress: ProgressCallback = silent) -> dict[str, Any]:
    """Time and error of every method on open bodies, MIT frames (if `mit` is their folder) and broken bodies.

    wrong_surface: share of the surface's area labelled differently from the exact answer, by random points in every
    triangle. ms: processor time of the distances alone, the median of several runs, mean over bodies; partition_ms: of
    the whole partition. Raises BadConfig for a folder without frames.
    """
    source = open_source("open")
    chosen = evenly_sampled(source.bodies(), OPEN_BODIES)
    frames = None if mit is None else open_source("mit", mit)
    frame_refs = [] if frames is None else evenly_sampled(frames.bodies(), min(MIT_FRAMES, len(frames.bodies())))
    advance = counter(progress, len(chosen) + len(frame_refs) + len(CASES))

    def measured(bodies: Sequence[Body]) -> dict[str, Any]:
        rows = []
        for body in bodies:
            rows.append(_on_sound(body))
            advance()
        return {method: _mean([row[method] for row in rows]) for method in METHODS}

    methods = measured([source.build(ref) for ref in chosen])
    on_frames: Any = "not measured: no folder of frames was given (--mit)"
    if frames is not None:
        on_frames = {
            "frames": [ref.mesh for ref in frame_refs],
            "methods": measured([frames.build(ref) for ref in frame_refs]),
        }
    whole = source.build(chosen[0])
    exact = whole.partition()
    broken = {}
    for name, step in CASES.items():
        broken[name] = _on_broken(name, step(sound(whole), np.random.default_rng(0)), whole, exact, step is scan)
        advance()
    return {
        "methods": methods,
        "default": DEFAULT,
        "falls_back_to": FALLBACK_METHOD,
        "open": [ref.mesh for ref in chosen],
        "mit": on_frames,
        "broken": chosen[0].mesh,
        "bodies": broken,
    }


def wrong_surface(mesh: Mesh, parts: Partition, other: Mesh, exact: Partition, parent: NDArray[np.int64]) -> float:
    """Share of a surface that `parts` labels differently from `exact`, the partition of `other`, in which triangle
    `parent` [F] each of the mesh's triangles lies; triangles with a parent of -1 do not count.
    """
    faces = np.repeat(np.flatnonzero(parent >= 0), _POINTS).astype(np.int32)
    weights = np.random.default_rng(0).dirichlet([1, 1, 1], len(faces))
    points = np.einsum("nc,ncd->nd", weights, mesh.vertices[mesh.faces[faces]])
    differs = parts.labels_at(mesh, faces, points) != exact.labels_at(other, parent[faces].astype(np.int32), points)
    areas = np.linalg.norm(mesh.normals, axis=1)[faces]
    return round(float((differs * areas).sum() / areas.sum()), 6)


def _on_sound(body: Body) -> dict[str, dict[str, float]]:
    mesh = body.mesh
    exact = body.partition()
    reached = np.isfinite(exact.distance)
    used, corners = np.unique(mesh.faces[reached[mesh.faces].all(axis=1)], return_inverse=True)
    surface = mesh.vertices[used], corners.reshape(-1, 3), np.searchsorted(used, body.landmarks)
    rows: dict[str, dict[str, float]] = {}
    for method in METHODS:
        seconds, answer = median_time(partial(nearest_sources, method, *surface), REPEATS)
        partition_s, parts = median_time(partial(partition, mesh, body.landmarks, method), REPEATS)
        rows[method] = {
            "ms": round(1e3 * seconds, 1),
            "partition_ms": round(1e3 * partition_s, 1),
            "wrong_surface": wrong_surface(mesh, parts, mesh, exact, np.arange(len(mesh.faces))),
            "distance_error_mm": round(float(np.abs(answer.distance - exact.distance[used]).mean()) * 1e3, 3),
        }
    return rows


def partition_unmended(mesh: Mesh, landmarks: NDArray[np.int64], method: GeodesicMethod) -> Partition:
    """Partition `mesh` by `method` without mending or a fallback method. Raises Unanswerable if `method` fails."""
    unmended = MendedSurface(mesh.faces.astype(np.int64), np.arange(len(mesh.vertices)), ())
    return _with_borders(mesh, unmended, *_nearest_landmarks(mesh, landmarks, unmended, method), ())


def _on_broken(name: str, broken: Broken, whole: Body, exact: Partition, is_scan: bool) -> dict[str, Any]:
    body = broken.body(name)
    mesh, other, parent = body.mesh, whole.mesh, broken.parent
    if is_scan:  # its surface is another one
        other, exact, parent = mesh, body.partition(), np.arange(len(mesh.faces))
    rows = {}
    for method in METHODS:
        try:
            parts = partition_unmended(mesh, body.landmarks, method)
            as_it_is: Any = wrong_surface(mesh, parts, other, exact, parent)
        except Unanswerable as error:
            as_it_is = str(error)
        seconds, parts = median_time(partial(partition, mesh, body.landmarks, method))
        rows[method] = {
            "as_it_is": as_it_is,
            "wrong_surface": wrong_surface(mesh, parts, other, exact, parent),
            "partition_ms": round(1e3 * seconds, 1),
            "note": parts.note,
        }
    return {"triangles": len(mesh.faces), "methods": rows}


def _mean(rows: Sequence[dict[str, float]]) -> dict[str, float]:
    return {name: round(float(np.mean([row[name] for row in rows])), 6) for name in rows[0]}
