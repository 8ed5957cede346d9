"""`bench occlusion`: every way to make the projector's shadow, against exact shadow rays.

Exact means: a ray from the point that the camera sees, before any rounding, to the projector meets nothing.
"""

from __future__ import annotations

import resource
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts.occlusion import EDGE_M, SURFACE_GAP_M, ShadowTest
from bodyseg_data.benches.occlusion_rivals import Images, Method, methods
from bodyseg_data.bodies import Body, BodyRef, open_source
from bodyseg_data.borders import find_borders
from bodyseg_data.codec import image_codec
from bodyseg_data.errors import BadConfig
from bodyseg_data.partition import Partition
from bodyseg_data.rendering.embree import EmbreeRenderer
from bodyseg_data.rendering.sampling import Sampler, surface_points
from bodyseg_data.rig import Rig, load_rig
from bodyseg_data.sample import steps
from bodyseg_data.views import View, ViewGrid

POSES: Final = (
    "standing",
    "arms_forward",
    "arms_crossed",
    "hands_on_hips",
    "walk_contact",
    "deep_squat",
    "crane",
    "hands_in_front",
    "fencing",
    "sitting",
)
"""Postures of person A: limbs before the trunk, limbs touching it, limbs far from it."""

_SCALES: Final = (1, 2, 3)
_ROUNDS: Final = 5
_GRAZING: Final = 0.2  # cosine of the angle between normal and light: 78 degrees and more


@dataclass(frozen=True)
class ExactView:
    """One view with all its stored images and the exact answer; everything bool or uint16 is [H, W]."""

    body: str
    view: View
    range: NDArray[np.uint16]
    projector_range: dict[int, NDArray[np.uint16]]
    facing: NDArray[np.bool_]
    inside: NDArray[np.bool_]
    lit: NDArray[np.bool_]
    grazing: NDArray[np.bool_]

    def images(self, scale: int) -> Images:
        """What `ShadowTest.lit` takes."""
        return self.range, self.projector_range[scale], self.facing


def bench_occlusion(views: int = 60, progress: Callable[[int, int], None] = lambda done, total: None) -> dict[str, Any]:
    """Errors and time of every method over `views` views of ten open bodies, all round and at three distances.

    wrong_pixels, false_lit, false_shadow: shares of the foreground pixels inside the projector's view, all views
    pooled; worst_view: the largest share in one view. us_per_view: median over views of the best of five runs.
    projector_bytes: mean size of the projector's stored range. Raises BadConfig for no views.
    """
    if views < 1:
        raise BadConfig(f"at least one view must be measured, found {views}")
    rig = load_rig()
    tests = {scale: ShadowTest(rig.with_projector_scale(scale)) for scale in _SCALES}
    tallies = [_Tally(method, tests[method.projector_scale]) for method in methods()]
    compiled, exact, where = _Compiled(tests[1]), _Stopwatch(), _WhereWrong()
    mask_bytes: list[int] = []
    bodies = postures()[: min(views, len(POSES))]
    for done, view in enumerate(exact_views(rig, bodies, views), start=1):
        for turn in range(len(tallies)):  # each view starts elsewhere: who comes first after rendering runs slower
            tallies[(turn + done) % len(tallies)].add(view)
        compiled.add(view)
        exact.time(lambda view=view: view.lit & (view.range > 0))  # type: ignore[misc]
        mask_bytes.append(len(image_codec("bsi").encode(view.lit.astype(np.uint8), 0)))
        where.add(view, tests[1].lit(*view.images(1)))
        progress(done, views)
    rows = [tally.row() for tally in tallies]
    mask: dict[str, Any] = {"name": "exact mask, stored", "bias": None, "projector_scale": None, "wrong_pixels": 0.0}
    mask["mask_bytes"] = round(statistics.mean(mask_bytes))
    rows.append(mask | {"us_per_view": exact.us(), "false_lit": 0.0, "false_shadow": 0.0, "worst_view": 0.0})
    return {
        "default": {"method": rows[0]["name"]}
        | rows[0]
        | {"surface_gap_mm": SURFACE_GAP_M * 1e3, "edge_mm": EDGE_M * 1e3},
        "methods": rows,
        "views": views,
        "bodies": [body.pose for body in bodies],
        "pixels": where.pixels,
        "compiled": compiled.row(),
        "where_wrong": where.row(),
        "units": {"bias": "mm", "wrong_pixels": "share of foreground pixels inside the projector's view"},
    }


def exact_view(rig: Rig, renderer: EmbreeRenderer, body: Body, ref: BodyRef, view: View) -> ExactView:
    """One view as shards store it, whole projector images at all scales, and the answer of exact shadow rays."""
    mesh = body.mesh
    nowhere = np.full(len(mesh.vertices), np.inf)
    labels = np.zeros(len(mesh.vertices), np.uint8)
    one_part = Partition(labels, nowhere, find_borders(mesh, labels, nowhere))  # parts do not matter here
    sample = Sampler(renderer, rig, mesh, one_part, "open", ref).take(view)
    camera, projector = rig.placed(mesh.centre, view)
    seen = renderer.see(camera)
    rows, columns = np.nonzero(seen.face >= 0)
    points = surface_points(seen, camera, rows, columns)
    pixels, away = projector.project(points)
    inside = (away > 0) & (pixels >= 0).all(axis=1) & (pixels < (rig.projector.columns, rig.projector.rows)).all(axis=1)
    normals, ways = mesh.normals[seen.face[rows, columns]], projector.position - points
    lengths = np.linalg.norm(normals, axis=1) * np.linalg.norm(ways, axis=1)
    grazing = np.abs(np.einsum("ij,ij->i", normals, ways)) < _GRAZING * lengths

    def image(values: NDArray[np.bool_]) -> NDArray[np.bool_]:
        whole = np.zeros(seen.face.shape, np.bool_)
        whole[rows, columns] = values
        return whole

    projector_range = {}
    for scale in _SCALES:
        _, finer = rig.with_projector_scale(scale).placed(mesh.centre, view)
        projector_range[scale] = steps(renderer.see(finer).range, sample.key)
    lit = renderer.lit(points, projector.position) & inside
    masks = map(image, (inside, lit, grazing))
    return ExactView(ref.pose, view, sample.range, projector_range, sample.faces_projector, *masks)


def postures() -> list[BodyRef]:
    """The ten bodies that are measured on."""
    by_pose: dict[str, BodyRef] = {}
    for body in open_source("open").bodies():
        by_pose.setdefault(body.pose, body)
    return [by_pose[pose] for pose in POSES]


def exact_views(rig: Rig, bodies: list[BodyRef], count: int) -> Iterator[ExactView]:
    """`count` views of `bodies` of the open source, all round and at three distances."""
    source = open_source("open")
    grid = list(ViewGrid(span_deg=360, azimuths=18))
    for index, body in enumerate(bodies):
        built = source.build(body)
        renderer = EmbreeRenderer(built.mesh)
        for turn in range(index, count, len(bodies)):
            # 23 has no divisor in common with the 54 views, so few views already mix azimuths and distances.
            yield exact_view(rig, renderer, built, body, grid[turn * 23 % len(grid)])
        renderer.close()


class _Stopwatch:
    """Median over views of the best of five runs: what the work takes when nothing else interferes."""

    def __init__(self) -> None:
        self._seconds: list[float] = []

    def time(self, work: Callable[[], NDArray[np.bool_]]) -> NDArray[np.bool_]:
        best = float("inf")
        for _ in range(_ROUNDS):
            start = time.perf_counter()
            answer = work()
            best = min(best, time.perf_counter() - start)
        self._seconds.append(best)
        return answer

    def us(self) -> float:
        return round(statistics.median(self._seconds) * 1e6, 1)


class _Tally:
    """Adds up one method's errors."""

    def __init__(self, method: Method, test: ShadowTest) -> None:
        self._method, self._test, self._watch = method, test, _Stopwatch()
        self._pixels = self._false_lit = self._false_shadow = self._bytes = self._views = 0
        self._worst = 0.0

    def add(self, view: ExactView) -> None:
        method = self._method
        stored = method.stored(view.projector_range[method.projector_scale])
        images = view.range, method.restored(stored), view.facing
        lit = self._watch.time(lambda: method.lit(self._test, images))
        false_lit, false_shadow = int((lit & ~view.lit & view.inside).sum()), int((~lit & view.lit & view.inside).sum())
        pixels = int(view.inside.sum())
        self._false_lit, self._false_shadow = self._false_lit + false_lit, self._false_shadow + false_shadow
        self._pixels += pixels
        self._worst = max(self._worst, (false_lit + false_shadow) / max(pixels, 1))
        self._bytes += len(image_codec("bsi").encode(stored, 0))
        self._views += 1

    def row(self) -> dict[str, Any]:
        shares = [_share(count, self._pixels) for count in (self._false_lit, self._false_shadow)]
        return {
            "name": self._method.name,
            "bias": self._method.bias_mm,
            "projector_scale": self._method.projector_scale,
            "wrong_pixels": _share(self._false_lit + self._false_shadow, self._pixels),
            "us_per_view": self._watch.us(),
            "false_lit": shares[0],
            "false_shadow": shares[1],
            "worst_view": round(self._worst, 6),
            "projector_step_mm": self._method.projector_step_mm,
            "projector_bytes": round(self._bytes / max(self._views, 1)),
        }


class _Compiled:
    """What numba would gain: time a view, and what it costs a process. Null where it is not installed."""

    def __init__(self, test: ShadowTest) -> None:
        self._test, self._watch, self._numpy = test, _Stopwatch(), _Stopwatch()
        self._start: dict[str, float] = {}
        self._differing = 0
        memory = _peak_mb()
        start = time.perf_counter()
        try:
            from bodyseg_data.benches import occlusion_compiled
        except ImportError:
            self._lit = None
            return
        self._lit = occlusion_compiled.lit
        imported = time.perf_counter()
        rig = test.rig
        empty = np.zeros((rig.camera.rows, rig.camera.columns), np.uint16)
        self._lit(test, empty, np.zeros((rig.projector.rows, rig.projector.columns), np.uint16), empty > 0)
        done = time.perf_counter()
        self._start = {
            "import_ms": round((imported - start) * 1e3, 1),
            "compile_ms": round((done - imported) * 1e3, 1),
            "memory_mb": round(_peak_mb() - memory, 1),
        }

    def add(self, view: ExactView) -> None:
        lit = self._lit
        if lit is None:
            return
        answer = self._watch.time(lambda: lit(self._test, *view.images(1)))
        plain = self._numpy.time(lambda: self._test.lit(*view.images(1)))
        self._differing += int((answer != plain).sum())

    def row(self) -> dict[str, Any] | None:
        if self._lit is None:
            return None
        times = {"us_per_view": self._watch.us(), "numpy_us_per_view": self._numpy.us()}
        return times | self._start | {"differing_pixels": self._differing}


class _WhereWrong:
    """Where the default's errors are: beside an exact shadow edge, under grazing light, in which pose."""

    def __init__(self) -> None:
        self.pixels = self._wrong = self._beside = self._grazing = self._grazing_pixels = 0
        self._poses: dict[str, tuple[int, int]] = {}

    def add(self, view: ExactView, lit: NDArray[np.bool_]) -> None:
        wrong = (lit != view.lit) & view.inside
        dark = view.inside & ~view.lit
        edge = _grown(view.lit) & _grown(dark)
        self.pixels += int(view.inside.sum())
        self._wrong += int(wrong.sum())
        self._beside += int((wrong & edge).sum())
        self._grazing += int((wrong & view.grazing).sum())
        self._grazing_pixels += int((view.inside & view.grazing).sum())
        before = self._poses.get(view.body, (0, 0))
        self._poses[view.body] = before[0] + int(wrong.sum()), before[1] + int(view.inside.sum())

    def row(self) -> dict[str, Any]:
        return {
            "share_of_errors_beside_a_shadow_edge": _share(self._beside, self._wrong),
            "share_of_errors_under_grazing_light": _share(self._grazing, self._wrong),
            "wrong_pixels_under_grazing_light": _share(self._grazing, self._grazing_pixels),
            "wrong_pixels_by_pose": {pose: _share(*counts) for pose, counts in self._poses.items()},
        }


def _grown(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """A mask [H, W] and all pixels beside it."""
    padded = np.pad(mask, 1)
    rows, columns = mask.shape
    grown: NDArray[np.bool_] = np.logical_or.reduce(
        [padded[row : row + rows, column : column + columns] for row in range(3) for column in range(3)]
    )
    return grown


def _share(count: int, total: int) -> float:
    return round(count / max(total, 1), 6)


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
