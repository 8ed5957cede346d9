"""Rendering and packing: views a second against the plain way, where the time goes, what each saving brings.

Both ways go from the same bodies and views to files on the disk, in turns, with two processes each: bodies to shards as
`bodyseg shard` makes them, and bodies to PNG files by plain pyrender (`plain.py`). A round's clock starts
when its first body is done, which is rendered alone.
"""

from __future__ import annotations

import operator
import statistics
import time
from collections.abc import Sequence
from concurrent.futures import Executor, Future
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np

from benches.data.render.alone import measure_renderers
from benches.data.render.steps import measure_stages, measure_steps
from benches.measuring import counter, evenly_spaced
from bodyseg_data.bodies import BodyRef
from bodyseg_data.core import MissingLibrary, ProgressCallback, silent
from bodyseg_data.meshes import Mesh
from bodyseg_data.packing import PROCESSES, Packing, Sampler, open_engine, pack
from bodyseg_data.packing.packer import render_run
from bodyseg_data.rendering import open_renderer
from bodyseg_data.samples import View

_WORKERS: Final = 2
_ROUNDS: Final = 3
_TETRAHEDRON: Final = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])


def bench_render(views: int = 486, progress: ProgressCallback = silent) -> dict[str, Any]:
    """Views a second of both ways, medians of three rounds of at least `views` views.

    range_error_mm: stored camera ranges against pyrender's, drawn with one sample at each pixel's centre, median of the
    absolute difference. silhouette_error: share of the body's pixels that only one of the two sees. "plain_errors" says
    the same of the plain way, and the share of its labels that differ. stages and steps: see `steps.py`. All
    that needs pyrender is null where it cannot draw, and "plain_missing" says why. renderers: see `alone.py`.
    """
    grid = tuple(Packing("open").views)
    packing = Packing("open", meshes=1 + _WORKERS * max(1, -(-(views - len(grid)) // (len(grid) * _WORKERS))))
    bodies = packing.bodies()
    packing.opened().build(bodies[0])  # fills the body model's cache, which several workers would do at once
    missing = _why_no_pyrender()
    total = 4 + 2 * _ROUNDS
    tick = counter(progress, total)
    few = evenly_spaced(bodies, 4)
    with open_engine(PROCESSES, 1, packing) as alone:  # a process of its own: it has other libraries than packing has
        renderers = alone.executor.submit(measure_renderers, packing, few, grid, evenly_spaced(grid, 9)).result()
    tick()
    rates: dict[str, list[float]] = {"ours": [], "plain": []}
    sizes: dict[str, float | None] = {"ours": None, "plain": None}
    ways = {"ours": _pack_round} | ({} if missing else {"plain": _plain_round})
    with open_engine(PROCESSES, _WORKERS, packing) as ours, open_engine(PROCESSES, _WORKERS, packing) as plain:
        executors = {"ours": ours.executor, "plain": plain.executor}
        for name in ways:
            _warm_up(name, executors[name], packing, bodies[0], grid[:1])
        # In a worker, which has one thread of linear algebra as packing has it.
        stages = ours.executor.submit(measure_stages, packing, few, grid).result()
        tick()
        chain = ours.executor.submit(measure_steps, packing, few, evenly_spaced(grid, 9)).result()
        tick()
        for _ in range(_ROUNDS):
            for name, way in ways.items():
                with TemporaryDirectory() as folder:
                    rate, size = way(packing, bodies, grid, executors[name], Path(folder))
                rates[name].append(rate)
                sizes[name] = round(size)
                tick()
    errors = None if missing else _errors(packing, few, evenly_spaced(grid, 9))
    progress(total, total)
    middle = {name: statistics.median(values) if values else None for name, values in rates.items()}
    # Round by round, since what else the machine does changes from one to the next.
    times = None if missing else statistics.median(map(operator.truediv, rates["ours"], rates["plain"]))
    return {
        "views_per_second": {name: None if value is None else round(value, 2) for name, value in middle.items()},
        "times_faster": None if times is None else round(times, 2),
        "range_error_mm": None if errors is None else errors["ours"]["range_mm"],
        "silhouette_error": None if errors is None else errors["ours"]["silhouette"],
        "plain_errors": None if errors is None else errors["plain"],
        "plain_missing": missing,
        "stages": stages,
        "steps": chain,
        "bytes_per_view": sizes,
        "views": len(grid) * len(bodies),
        "bodies": len(bodies),
        "workers": _WORKERS,
        **renderers,
    }


def _pack_round(
    packing: Packing, bodies: Sequence[BodyRef], views: Sequence[View], executor: Executor, folder: Path
) -> tuple[float, float]:
    """Views a second, and bytes a view."""
    first: list[float] = []

    def watch(done: int, total: int) -> None:
        if done >= len(views) and not first:
            first.append(time.perf_counter())

    manifest = pack(packing, folder / "shards", executor, _WORKERS, watch)
    seconds = time.perf_counter() - first[0]
    return (manifest.samples() - len(views)) / seconds, sum(s.size for s in manifest.shards) / manifest.samples()


def _plain_round(
    packing: Packing, bodies: Sequence[BodyRef], views: Sequence[View], executor: Executor, folder: Path
) -> tuple[float, float]:
    from benches.data.render.plain import plain_run

    sizes = [executor.submit(plain_run, packing, bodies[0], tuple(views), folder).result()]
    start = time.perf_counter()
    rest = [executor.submit(plain_run, packing, body, tuple(views), folder) for body in bodies[1:]]
    sizes += [future.result() for future in rest]
    seconds = time.perf_counter() - start
    return len(rest) * len(views) / seconds, sum(sizes) / (len(bodies) * len(views))


def _warm_up(name: str, executor: Executor, packing: Packing, body: BodyRef, views: tuple[View, ...]) -> None:
    """Have every worker load what it needs."""
    with TemporaryDirectory() as folder:
        jobs: list[Future[Any]] = []
        for _ in range(_WORKERS):
            if name == "ours":
                jobs.append(executor.submit(render_run, packing, body, views))
            else:
                from benches.data.render.plain import plain_run

                jobs.append(executor.submit(plain_run, packing, body, views, Path(folder)))
        for job in jobs:
            job.result()


def _errors(packing: Packing, bodies: Sequence[BodyRef], views: Sequence[View]) -> dict[str, dict[str, float]]:
    """Errors of both ways against pyrender with one sample at each pixel's centre."""
    from benches.data.render.plain import PlainScenes

    apart: dict[str, list[Any]] = {"ours": [], "plain": []}
    outline, labels, seen = {"ours": 0, "plain": 0}, 0, 0
    for ref in bodies:
        body = packing.opened().build(ref)
        parts = body.partition()
        exact, plain = open_renderer("opengl", body.mesh), PlainScenes(packing.rig, body.mesh, parts.labels)
        sampler = Sampler(open_renderer(packing.renderer, body.mesh), packing.rig, body.mesh, parts, "open", ref)
        for view in views:
            true_m = exact.render(packing.rig.placed(body.mesh.centre, view)[0]).range
            sample, drawn = sampler.take(view), plain.take(view)
            for name, image in (("ours", sample.range), ("plain", drawn["range"])):
                both = (true_m > 0) & (image > 0)
                apart[name].append(np.abs(image[both] * packing.rig.range_step_m - true_m[both]) * 1e3)
                outline[name] += int(((true_m > 0) != (image > 0)).sum())
            labels += int(((sample.labels != drawn["labels"]) & (sample.range > 0) & (drawn["range"] > 0)).sum())
            seen += int((true_m > 0).sum())
        exact.close()
    found: dict[str, dict[str, float]] = {
        name: {
            "range_mm": round(float(np.median(np.concatenate(apart[name]))), 5),
            "silhouette": round(outline[name] / seen, 6),
        }
        for name in apart
    }
    found["plain"]["labels"] = round(labels / seen, 6)
    return found


def _why_no_pyrender() -> str | None:
    """None if pyrender can draw here, else one line."""
    tetrahedron = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    try:
        open_renderer("opengl", Mesh("tetrahedron", tetrahedron, _TETRAHEDRON)).close()
    except MissingLibrary as error:
        return str(error)
    return None
