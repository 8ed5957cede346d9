"""`bench reduction`: what coarser meshes cost in accuracy and save in time, and whether making them pays.

Times are processor seconds of one core. A body's views a second are 54 over all that is done for it once it is there:
reduction, partition, ray tree, and 54 times rendering, labelling and encoding a view.
"""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from benches.data.surface.broken_bodies import scan, sound
from benches.measuring import median_time
from bodyseg_data.bodies import Body, BodyRef, open_source
from bodyseg_data.core import ProgressCallback, silent
from bodyseg_data.meshes import Mesh, Partition, partition, with_pymeshlab
from bodyseg_data.meshes.partitioning import find_borders
from bodyseg_data.packing import Packing, Sampler
from bodyseg_data.packing.mesh_reduction import PAYS_FROM, TOLERANCE_M, WITHIN, edges_collapsed, reduce
from bodyseg_data.packing.options import evenly_sampled
from bodyseg_data.packing.sampler import faces_towards
from bodyseg_data.rendering import open_renderer
from bodyseg_data.rendering.embree import EmbreeRenderer
from bodyseg_data.rigs import load_rig
from bodyseg_data.samples import View, ViewGrid
from bodyseg_data.shards import encode_sample

SHARES: Final = (1.0, 0.75, 0.5, 0.25, 0.1, 0.05, 0.02)
TOLERANCES_MM: Final = (0.1, 0.2, 0.5, 1.0)
VIEWS_A_BODY: Final = 54

_POSES: Final = ("arms_crossed", "deep_squat")
EDGE_MM: Final = 8  # subdivided until no edge is longer, the open body has 200 000 triangles
GROWN_MM: Final = (16, 12, 10)  # 63 000, 101 000, 133 000
SCAN: Final = 200_000
HALF_A_SCAN: Final = 100_000
_LABEL_SHARE: Final = 0.25
_JUMP_M: Final = 0.01  # a pixel this far off sees another surface
_REF: Final = BodyRef("A", "A", "body", "any", "train")

Row = dict[str, Any]


def bench_reduction(views: int = 4, mit: Path | None = None, progress: ProgressCallback = silent) -> dict[str, Any]:
    """Rows of every kind of body by share of its triangles and by tolerance; then one body, ever more finely divided.

    views: of each body, all round, for errors and times. mit: the folder of MIT frames, if there is one.
    """
    kinds = _kinds(mit)
    one = kinds["open"][0]
    _Reference(one, 1).row(one.mesh, one.landmarks, 0.0)  # what is imported or compiled on first use is no body's cost
    finer = [("smooth scan", subdivided(one, edge_mm / 1000)) for edge_mm in GROWN_MM]
    finer.append(("rough scan", _rough(one, HALF_A_SCAN)))
    total = len(kinds) + len(finer)
    measured: dict[str, Row] = {}
    for name, bodies in kinds.items():
        measured[name] = _measured([_Reference(body, views) for body in bodies])
        progress(len(measured), total)
    pays = [{"kind": name, **kind["pays"]} for name, kind in measured.items()]
    for done, (name, body) in enumerate(finer, start=len(kinds) + 1):
        whole = _Reference(body, views)
        pays.append(
            {"kind": name, **_compared(whole.row(body.mesh, body.landmarks, 0.0), _reduced(whole, TOLERANCE_M))}
        )
        progress(done, total)
    return {
        "kinds": measured,
        "pays": pays,
        "default": {"tolerance_mm": TOLERANCE_M * 1000, "within_percent": WITHIN, "from_triangles": PAYS_FROM},
        "views_a_body": VIEWS_A_BODY,
        "renderer": Packing.renderer,
        "views": views,
    }


def _kinds(mit: Path | None) -> dict[str, list[Body]]:
    bodies = _open_bodies()
    frames = [] if mit is None else _mit_frames(mit)
    return {
        "open": bodies,
        **({"mit": frames} if frames else {}),
        "smooth scan": [subdivided(bodies[0], EDGE_MM / 1000)],
        "rough scan": [_rough(bodies[0], SCAN)],
    }


def _open_bodies() -> list[Body]:
    """Two postures of one person, and another person."""
    source = open_source("open")
    postures = {body.pose: body for body in reversed(source.bodies()) if body.subset == "A"}
    people = evenly_sampled([body for body in source.bodies() if body.subset == "people"], 1)
    return [source.build(body) for body in (*(postures[pose] for pose in _POSES), *people)]


def _mit_frames(folder: Path) -> list[Body]:
    source = open_source("mit", folder)
    return [source.build(body) for body in evenly_sampled([body for body in source.bodies() if body.subset == "B"], 2)]


def _rough(body: Body, triangles: int) -> Body:
    """Edges halved, and every vertex moved at random by 0.3 mm: a scan with noise."""
    return scan(sound(body), np.random.default_rng(0), triangles).body(body.mesh.name)


def subdivided(body: Body, longest_m: float) -> Body:
    """The body with edges longer than that divided, smoothly: a scan without noise (C. Loop, 1987; pymeshlab)."""

    def divide(pymeshlab: Any) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
        meshes = pymeshlab.MeshSet()
        meshes.add_mesh(pymeshlab.Mesh(body.mesh.vertices, body.mesh.faces))
        longest = pymeshlab.PureValue(longest_m)
        meshes.meshing_surface_subdivision_loop(loopweight="Loop", iterations=3, threshold=longest, selected=False)
        fine = meshes.current_mesh()
        return np.array(fine.vertex_matrix()), np.array(fine.face_matrix(), np.int32)

    # Subdivision puts new vertices behind the old ones: landmarks keep theirs.
    return replace(body, mesh=Mesh(body.mesh.name, *with_pymeshlab("bench reduction", divide)))


class _Reference:
    """A whole body and its images from some views, against which coarser meshes are measured."""

    def __init__(self, body: Body, views: int) -> None:
        self.body, self.rig = body, load_rig()
        self.views = list(ViewGrid(span_deg=360, count=views))
        self.partition_s, self.parts = median_time(body.partition)
        self.seen = self.see(body.mesh, self.parts)

    def see(self, mesh: Mesh, parts: Partition) -> list[tuple[NDArray[Any], ...]]:
        """Range, label and facing images of all views."""
        renderer = EmbreeRenderer(mesh)
        images: list[tuple[NDArray[Any], ...]] = []
        for view in self.views:
            camera, projector = self.rig.placed(self.body.mesh.centre, view)
            seen = renderer.render(camera)
            rows, columns = np.nonzero(seen.face >= 0)
            faces, points = seen.face[rows, columns], camera.points(seen.range, rows, columns)
            labels, facing = np.zeros(seen.face.shape, np.uint8), np.zeros(seen.face.shape, np.bool_)
            labels[rows, columns] = parts.labels_at(mesh, faces, points)
            facing[rows, columns] = faces_towards(mesh, faces, points, projector.position)
            images.append((seen.range.astype(np.float64), labels, facing))
        return images

    def errors(self, mesh: Mesh, parts: Partition) -> Row:
        """Errors of a coarser mesh; ranges in mm, counts as shares of pixels."""
        apart, silhouette, labels, facing = [], 0, 0, 0
        for one, other in zip(self.see(mesh, parts), self.seen, strict=True):
            common = (one[0] > 0) & (other[0] > 0)
            apart.append(np.abs(one[0] - other[0])[common] * 1000)
            silhouette += int(((one[0] > 0) != (other[0] > 0)).sum())
            labels += int((one[1] != other[1])[common].sum())
            facing += int((one[2] != other[2])[common].sum())
        every = np.concatenate(apart)
        same = every[every < _JUMP_M * 1000]
        return {
            "rms_mm": round(float(np.sqrt((every**2).mean())), 4),
            "rms_mm_same_surface": round(float(np.sqrt((same**2).mean())), 4),
            "other_surface": round(1 - len(same) / len(every), 6),
            "p95_mm": round(float(np.percentile(every, WITHIN)), 4),
            "max_mm": round(float(every.max()), 2),
            "silhouette": round(silhouette / len(every), 6),
            "labels": round(labels / len(every), 6),
            "facing": round(facing / len(every), 6),
        }

    def row(self, mesh: Mesh, landmarks: NDArray[np.int64], reduce_s: float) -> Row:
        """Errors, times and views a second with a coarser mesh that took `reduce_s` to make."""
        whole = mesh is self.body.mesh
        part_s, parts = (self.partition_s, self.parts) if whole else median_time(lambda: partition(mesh, landmarks))
        # A copy, so that what a mesh works out once is worked out, and counted, for every row.
        copy = Mesh(mesh.name, mesh.vertices, mesh.faces)
        rays = EmbreeRenderer(copy)
        tree_s, renderer = median_time(lambda: open_renderer(Packing.renderer, copy))
        sampler_s, sampler = median_time(lambda: Sampler(renderer, self.rig, copy, parts, "open", _REF))
        cameras = [self.rig.placed(copy.centre, view)[0] for view in self.views]
        pass_s, rays_s = (
            statistics.median(median_time(partial(one.render, camera), 2)[0] for camera in cameras)
            for one in (renderer, rays)
        )
        view_s = statistics.median(median_time(partial(_encoded, sampler, view), 2)[0] for view in self.views)
        body_s = reduce_s + part_s + tree_s + sampler_s + VIEWS_A_BODY * view_s
        seconds = {
            "reduce": reduce_s,
            "partition": part_s,
            "tree": tree_s + sampler_s,
            "pass": pass_s,
            "ray_pass": rays_s,
            "view": view_s,
        }
        times = {f"{name}_ms": round(value * 1000, 2) for name, value in seconds.items()}
        errors = self.errors(mesh, parts)
        return {"triangles": len(mesh.faces), **errors, **times, "views_per_second": round(VIEWS_A_BODY / body_s, 2)}


def _measured(wholes: Sequence[_Reference]) -> Row:
    """All rows of one kind of body, averaged over its bodies."""
    by_share = [_by_share(whole) for whole in wholes]
    by_tolerance = [[_reduced(whole, mm / 1000) for mm in TOLERANCES_MM] for whole in wholes]
    shares = [_mean([rows[i] for rows in by_share]) for i in range(len(SHARES))]
    tolerances = [_mean([rows[i] for rows in by_tolerance]) for i in range(len(TOLERANCES_MM))]
    return {
        "bodies": len(wholes),
        "shares": [{"share": share} | row for share, row in zip(SHARES, shares, strict=True)],
        "tolerances": [{"tolerance_mm": mm} | row for mm, row in zip(TOLERANCES_MM, tolerances, strict=True)],
        "pays": _compared(shares[0], tolerances[TOLERANCES_MM.index(TOLERANCE_M * 1000)]),
        "labels": _label_methods(wholes[0]),
    }


def _by_share(whole: _Reference) -> list[Row]:
    """As the reducer does it: every stage is made of the one before."""
    mesh, landmarks, seconds, rows = whole.body.mesh, whole.body.landmarks, 0.0, []
    for share in SHARES:
        if share < 1:
            count = round(len(whole.body.mesh.faces) * share)
            more, (mesh, landmarks) = median_time(partial(edges_collapsed, mesh, landmarks, count))
            seconds += more
        rows.append(whole.row(mesh, landmarks, seconds))
    return rows


def _reduced(whole: _Reference, tolerance_m: float) -> Row:
    body = whole.body
    seconds, reduction = median_time(lambda: reduce(body.mesh, body.landmarks, tolerance_m, whole.rig))
    return whole.row(reduction.mesh, reduction.landmarks, seconds)


def _compared(kept: Row, reduced: Row) -> Row:
    return {
        "triangles": kept["triangles"],
        "reduced_to": reduced["triangles"],
        "reduce_ms": reduced["reduce_ms"],
        "views_per_second": {"whole": kept["views_per_second"], "reduced": reduced["views_per_second"]},
    }


def _label_methods(whole: _Reference) -> dict[str, Row]:
    """Pixels labelled differently from the whole mesh: by partition of the coarse mesh, or by labels carried to it.

    For labels to be carried exactly, what is left must be vertices of the whole mesh.
    """
    from scipy.spatial import KDTree

    body = whole.body
    count = round(len(body.mesh.faces) * _LABEL_SHARE)
    free, marks = edges_collapsed(body.mesh, body.landmarks, count)
    bound, _ = edges_collapsed(body.mesh, body.landmarks, count, optimal=False)
    own = KDTree(body.mesh.vertices).query(bound.vertices)[1]
    labels, distance = whole.parts.labels[own], whole.parts.distance[own]
    carried = replace(whole.parts, labels=labels, distance=distance, borders=find_borders(bound, labels, distance))
    errors = {"partitioned": whole.errors(free, partition(free, marks)), "carried": whole.errors(bound, carried)}
    return {name: {key: row[key] for key in ("labels", "p95_mm")} for name, row in errors.items()}


def _mean(rows: Sequence[Row]) -> Row:
    """Means of all columns; of the largest errors, the largest."""
    mean = {key: round(statistics.fmean(row[key] for row in rows), 6) for key in rows[0]}
    mean["triangles"] = round(mean["triangles"])
    mean["max_mm"] = max(row["max_mm"] for row in rows)
    return mean


def _encoded(sampler: Sampler, view: View) -> dict[str, bytes]:
    return encode_sample(sampler.take(view), "bsi")
