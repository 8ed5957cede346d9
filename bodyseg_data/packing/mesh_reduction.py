"""Mesh reduction: fewer triangles, with ranges that, seen from the rig, stay within a tolerance.

Edges are collapsed where that moves the surface least (Garland and Heckbert, Surface simplification using quadric
error metrics, SIGGRAPH 1997; pymeshlab), some of them at a time. Every stage is judged by the quantity that the
tolerance limits: ranges that the rig's camera sees, by casting rays at the coarse mesh and at the whole one.
"""

import math
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.bodies import Body
from bodyseg_data.core import BadConfig, BadMesh
from bodyseg_data.meshes import Mesh, SceneMesh, find_edges, with_pymeshlab
from bodyseg_data.rendering import open_renderer
from bodyseg_data.rigs import PlacedCamera, Rig
from bodyseg_data.samples import View

Range = NDArray[np.float32]
Indices = NDArray[np.int64]

TOLERANCE_M: Final = 2e-4
"""An independent error of 0.2 mm makes a sensor's uncertainty of 1 mm one of 1.02 mm."""

PAYS_FROM: Final = 150_000
"""Triangles from which reducing a mesh, smooth or noisy, costs less than it saves over 54 views
(docs/explanation/mesh_resolution.md)."""

WITHIN: Final = 95
"""Per cent of the pixels whose range must be right to the tolerance. The others lie beside edges that hide something:
the slightest change of the edge shows the surface behind it, however far that is."""

_FEATURE: Final = "reducing a mesh"
_STEP: Final = 0.6  # least share of triangles that a step leaves: gentle steps end with a better mesh than one leap
_STEEPEST: Final = 2.0  # power of the count by which errors of scans grow, seldom higher; a step too far costs double
_LITTLE: Final = 0.85  # a step that leaves a larger share of the triangles saves less than sorting all edges costs
_AIM: Final = 0.95  # share of the tolerance that a step aims at, by the errors before it
_TRIES: Final = 2  # steps between a mesh that is fine enough and one that is not
_COARSER_PIXELS: Final = 4  # along a side: every sixteenth ray measures the same error
_AZIMUTHS_DEG: Final = (0, 90, 180, 270)
_REST: Final = {
    "targetperc": 0.0, "qualitythr": 0.3, "boundaryweight": 1.0, "planarquadric": False, "planarweight": 0.001,
    "qualityweight": False, "autoclean": True,
}  # fmt: skip
"""The filter's defaults, all given each time: for an option that is left out, a call takes that of the call before."""


@dataclass(frozen=True)
class Reduction:
    """A coarser mesh. landmarks: int64 [N], the vertices of the marks. error_m: its `range_error`.

    note: one line on the reduction, or on why none was possible; None for a mesh that is as coarse as it may be.
    """

    mesh: Mesh
    landmarks: Indices
    error_m: float
    note: str | None = None


def reduced_body(
    body: Body,
    tolerance_mm: float | None,
    rig: Rig,
    distance_cm: int,
    pitches_deg: Sequence[int] = (0,),
    pymeshlab: bool = False,
) -> Body:
    """`body` with a mesh as coarse as the tolerance permits, and a note if that changed it.

    tolerance_mm: of `reduce`; None: `TOLERANCE_M` with `pymeshlab`, for meshes of `PAYS_FROM` triangles and more, while
    without it they stay whole and get a note; 0: no mesh is reduced.
    """
    if tolerance_mm == 0 or (tolerance_mm is None and len(body.mesh.faces) < PAYS_FROM):
        return body
    if tolerance_mm is None and not pymeshlab:
        note = f"whole, with {len(body.mesh.faces)} triangles: --pymeshlab packs it faster"
        return replace(body, notes=(*body.notes, note))
    tolerance_m = TOLERANCE_M if tolerance_mm is None else tolerance_mm / 1000
    marks = np.array([*body.landmarks, *(piece.vertex for piece in body.pieces)], np.int64)
    reduction = reduce(body.mesh, marks, tolerance_m, rig, distance_cm, pitches_deg)
    notes = body.notes if reduction.note is None else (*body.notes, reduction.note)
    landmarks, others = np.split(reduction.landmarks, [len(body.landmarks)])
    pieces = tuple(replace(piece, vertex=int(at)) for piece, at in zip(body.pieces, others, strict=True))
    return replace(body, mesh=reduction.mesh, landmarks=landmarks, notes=notes, pieces=pieces)


def reduce(
    mesh: Mesh,
    landmarks: Indices,
    tolerance_m: float,
    rig: Rig,
    distance_cm: int = 215,
    pitches_deg: Sequence[int] = (0,),
) -> Reduction:
    """A mesh of few triangles whose ranges are those of `mesh` within the tolerance.

    landmarks: int64 [N], vertices of `mesh`. tolerance_m: metres, positive; `range_error` of the result is at most
    that, as the rig's camera sees it from four sides at each pitch, `distance_cm` away. The triangles round landmarks
    and at open edges stay as they are, and so does the bounding box, by which views are placed. No piece goes, none is
    joined to another. The same mesh gives the same bits each time.

    A mesh that cannot be reduced is returned whole with a note that says why. Raises BadConfig for a tolerance that is
    not positive, MissingLibrary without pymeshlab or embreex.
    """
    if not (math.isfinite(tolerance_m) and tolerance_m > 0):
        raise BadConfig(f"a mesh is reduced to a positive tolerance, found {tolerance_m * 1000:g} mm")
    best = Reduction(mesh, landmarks, 0.0)
    cameras = probe_cameras(mesh, rig, distance_cm, pitches_deg)
    wanted = seen_ranges(mesh, cameras)
    if not any(image.any() for image in wanted):
        return replace(best, note=f"left whole: the rig sees nothing of it at {distance_cm} cm")
    best, coarser = _descended(best, tolerance_m, cameras, wanted)
    for _ in range(_TRIES):
        share = _share_between(best, coarser, tolerance_m)
        if share > _LITTLE:
            break
        between = _coarser(best, share, cameras, wanted)
        if between.error_m <= tolerance_m:
            best = between
            break
        coarser = between
    if best.mesh is mesh:
        return replace(best, note=coarser.note)
    within = f"{WITHIN} % of pixels within {best.error_m * 1000:.2f} mm"
    return replace(best, note=f"reduced from {len(mesh.faces)} to {len(best.mesh.faces)} triangles, {within}")


def probe_cameras(mesh: Mesh, rig: Rig, distance_cm: int, pitches_deg: Sequence[int]) -> tuple[PlacedCamera, ...]:
    """The rig's camera on four sides of a mesh at each pitch, with fewer, larger pixels."""
    few = replace(rig, camera=rig.camera.scaled(1 / _COARSER_PIXELS))
    views = (View(distance_cm, azimuth, pitch) for pitch in pitches_deg for azimuth in _AZIMUTHS_DEG)
    return tuple(few.placed(mesh.centre, view)[0] for view in views)


def seen_ranges(mesh: Mesh, cameras: Sequence[PlacedCamera]) -> list[Range]:
    """Ranges that cameras see of a mesh, by casting rays: float32 [H, W], metres, 0 where there is no body."""
    with closing(open_renderer("embree", mesh)) as renderer:
        return [renderer.render(camera).range for camera in cameras]


def range_error(ranges: Sequence[Range], wanted: Sequence[Range]) -> float:
    """The 95th percentile (`WITHIN`) of the difference of ranges, metres, over all pixels where either is not 0.

    A pixel that only one of them sees counts with its whole range: 5 % of those break any tolerance.
    """
    apart = [np.abs(a - b)[(a > 0) | (b > 0)] for a, b in zip(ranges, wanted, strict=True)]
    return float(np.percentile(np.concatenate(apart), WITHIN))


def _descended(
    best: Reduction, tolerance_m: float, cameras: Sequence[PlacedCamera], wanted: Sequence[Range]
) -> tuple[Reduction, Reduction]:
    """Reduce stage by stage; returns the coarsest mesh within the tolerance, and the first beyond it or the same."""
    while (share := max(_STEP, (best.error_m / (_AIM * tolerance_m)) ** (1 / _STEEPEST))) < _LITTLE:
        coarser = _coarser(best, share, cameras, wanted)
        if coarser.error_m > tolerance_m:
            return best, coarser
        if len(coarser.mesh.faces) > _LITTLE * len(best.mesh.faces):
            return coarser, coarser  # nothing is left that could go
        best = coarser
    return best, best


def _coarser(before: Reduction, share: float, cameras: Sequence[PlacedCamera], wanted: Sequence[Range]) -> Reduction:
    """Reduce `before` to about `share` of its triangles; an infinite error and a note if that makes no sound mesh."""
    try:
        mesh, landmarks = edges_collapsed(before.mesh, before.landmarks, round(len(before.mesh.faces) * share))
    except BadMesh as error:
        return replace(before, error_m=math.inf, note=f"left whole: {error}")
    return Reduction(mesh, landmarks, range_error(seen_ranges(mesh, cameras), wanted))


def _share_between(finer: Reduction, coarser: Reduction, tolerance_m: float) -> float:
    """The share of `finer`'s triangles with which the error should just be the tolerance; 1 if `coarser` is no help.

    On a smooth surface the error grows as a power of the count: so by the straight line through both in logarithms of
    count and error, or half way if `finer` has no error.
    """
    if finer is coarser or coarser.error_m == math.inf:
        return 1.0
    way = 0.5
    if finer.error_m > 0:
        low, high, aim = (math.log(error) for error in (finer.error_m, coarser.error_m, _AIM * tolerance_m))
        way = min(max((aim - low) / (high - low), 0.1), 0.9)
    return float((len(coarser.mesh.faces) / len(finer.mesh.faces)) ** way)


def edges_collapsed(mesh: Mesh, landmarks: Indices, count: int, optimal: bool = True) -> tuple[Mesh, Indices]:
    """`mesh` with edges collapsed until about `count` triangles are left, and its landmarks' vertices in the result.

    optimal: put the vertex that an edge becomes where the error is least; else at one of its ends, so that every vertex
    left is one of the mesh's. Raises BadMesh if the result is no body, MissingLibrary without pymeshlab.
    """
    used, points = np.unique(mesh.faces), mesh.surface_vertices
    low, high = points.min(axis=0), points.max(axis=0)
    outermost = used[np.concatenate([points.argmin(axis=0), points.argmax(axis=0)])]  # the bounding box stays with them
    held, edges = np.zeros(len(mesh.vertices), np.bool_), find_edges(mesh.faces)
    seams = edges.ends[edges.faces != 2].ravel()  # also rims of holes: the sides of a seam would part if they moved
    held[np.concatenate([landmarks, outermost, seams])] = True
    if isinstance(mesh, SceneMesh):
        held[_between_labels(mesh)] = True
    fixed = np.asarray(held[mesh.faces].any(axis=1))
    if fixed.all():
        return mesh, landmarks
    number, vertices, faces, origin = with_pymeshlab(
        _FEATURE, lambda pymeshlab: _decimated(pymeshlab, mesh, fixed, count, optimal)
    )
    order = np.argsort(number, kind="stable")
    found = order[np.minimum(np.searchsorted(number[order], landmarks), len(order) - 1)]
    vertices = np.clip(vertices, low, high)
    if not np.array_equal(vertices[found], mesh.vertices[landmarks]):
        raise BadMesh("collapsing edges moved a landmark")
    further: dict[str, Any] = {"labels": mesh.labels[origin]} if isinstance(mesh, SceneMesh) else {}
    return replace(mesh, vertices=vertices, faces=faces, **further), found.astype(np.int64)


def _decimated(
    pymeshlab: Any, mesh: Mesh, fixed: NDArray[np.bool_], count: int, optimal: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int32], Indices]:
    """Collapse edges in pymeshlab's thread; returns vertices' numbers in `mesh`, metres, faces, and faces' numbers."""
    meshes = pymeshlab.MeshSet()
    number = np.arange(len(mesh.vertices), dtype=np.float64)  # goes along with each vertex
    count_up = np.arange(1.0, len(mesh.faces) + 1)  # goes along with each triangle, negative on those that stay
    of_face = np.where(fixed, -count_up, count_up)
    meshes.add_mesh(pymeshlab.Mesh(mesh.vertices, mesh.faces, v_scalar_array=number, f_scalar_array=of_face))
    try:
        meshes.compute_selection_by_condition_per_face(condselect="fq > 0.5")
        meshes.meshing_decimation_quadric_edge_collapse(
            targetfacenum=max(count - int(fixed.sum()), 1),  # counts selected faces only
            preservenormal=True,
            preservetopology=True,
            preserveboundary=True,
            optimalplacement=optimal,
            selected=True,
            **_REST,
        )
    except pymeshlab.PyMeshLabException as error:
        raise BadMesh(f"edges could not be collapsed: {' '.join(str(error).split())}") from error
    coarse = meshes.current_mesh()
    return (
        np.array(coarse.vertex_scalar_array()),
        np.array(coarse.vertex_matrix(), np.float64),
        np.array(coarse.face_matrix(), np.int32),
        np.abs(coarse.face_scalar_array()).astype(np.int64) - 1,
    )


def _between_labels(mesh: SceneMesh) -> Indices:
    """Vertices whose triangles have more than one label."""
    low, high = np.full(len(mesh.vertices), 255, np.uint8), np.zeros(len(mesh.vertices), np.uint8)
    np.minimum.at(low, mesh.faces, mesh.labels.min(axis=1)[:, None])
    np.maximum.at(high, mesh.faces, mesh.labels.max(axis=1)[:, None])
    return np.flatnonzero(low < high)
