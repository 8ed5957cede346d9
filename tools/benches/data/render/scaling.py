"""`bench scaling`: the processor time of a view; docs/results/scaling.md calculates large sets from it."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from concurrent.futures import Executor, Future
from pathlib import Path
from typing import Any, Final

from bodyseg_data.bodies import BodyRef
from bodyseg_data.core import ProgressCallback, silent
from bodyseg_data.machine import required
from bodyseg_data.packing import Packing, open_engine, pack
from bodyseg_data.packing.packer import render_run
from bodyseg_data.packing.sampler import sample_key
from bodyseg_data.packing.writing import Rendered
from bodyseg_data.samples import View, ViewGrid
from bodyseg_data.shards import MANIFEST_NAME

_BODIES: Final = 8
_WRITTEN_BODIES: Final = 80
_SENT_BODIES: Final = 40
CLUSTER: Final[dict[str, Any]] = {
    "n_workers": 1,
    "threads_per_worker": 1,
    "dashboard_address": None,
    "silence_logs": 50,
    "scheduler_kwargs": {"dashboard_address": ":0"},  # any free port: another cluster may hold the usual one
}
"""Options of a cluster of one worker on this machine."""


def bench_scaling(views: int = 54, progress: ProgressCallback = silent) -> dict[str, Any]:
    """Processor milliseconds a view, with `views` views of each body of the open set, and bytes a view.

    render_ms: making a sample, in a worker, bodies and labels included. write_ms: in the process that writes shards.
    dask_ms: fetching a sample over Dask's connections, in that process and the scheduler together. bytes,
    manifest_bytes: in shards and in the manifest. Raises MissingLibrary without `distributed` or Anny.
    """
    grid = ViewGrid(count=views)
    packing = Packing("open", meshes=_BODIES + 1, views=grid)
    first, *bodies = packing.bodies()
    rendered = render_run(packing, first, tuple(grid))  # loads the body model
    start = time.process_time()
    for done, body in enumerate(bodies, start=1):
        rendered = render_run(packing, body, tuple(grid))
        progress(done, _BODIES + 2)
    render_s = (time.process_time() - start) / (_BODIES * len(grid))
    written = _write(Packing("open", meshes=_WRITTEN_BODIES, views=grid), rendered)
    progress(_BODIES + 1, _BODIES + 2)
    dask_s = _fetch(packing, rendered)
    progress(_BODIES + 2, _BODIES + 2)
    return {"views": views, "render_ms": round(render_s * 1e3, 3), **written, "dask_ms": round(dask_s * 1e3, 4)}


class _Replay(Executor):
    """Executor that returns the same images for every job, under the requested names."""

    def __init__(self, rendered: Rendered) -> None:
        self._members = [members for _, members in rendered.samples]

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        packing: Packing
        body: BodyRef
        views: tuple[View, ...]
        packing, body, views, _ = args
        keys = [sample_key(packing.source, body, view) for view in views]
        future: Future[Any] = Future()
        future.set_result(Rendered(list(zip(keys, self._members, strict=False)), ()))
        return future


def _write(packing: Packing, rendered: Rendered) -> dict[str, float]:
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "shards"
        start = time.process_time()
        manifest = pack(packing, out, _Replay(rendered), 1)
        seconds = time.process_time() - start
        count, size = manifest.samples(), sum(shard.size for shard in manifest.shards)
        listed = (out / MANIFEST_NAME).stat().st_size
    return {
        "write_ms": round(seconds / count * 1e3, 4),
        "bytes": round(size / count),
        "manifest_bytes": round(listed / count),
    }


def stand_in(sizes: tuple[tuple[int, ...], ...]) -> Rendered:
    """Run on a worker: samples of the given sizes, one size for each member."""
    members = [{str(number): bytes(size) for number, size in enumerate(sample)} for sample in sizes]
    return Rendered([(f"{number}", sample) for number, sample in enumerate(members)], ())


def _fetch(packing: Packing, rendered: Rendered) -> float:
    """Seconds of processor time a view, of client and scheduler."""
    distributed = required("distributed", "bench scaling", "cluster")
    sizes = tuple(tuple(map(len, members.values())) for _, members in rendered.samples)
    with (
        distributed.LocalCluster(**CLUSTER) as nodes,
        open_engine(nodes.scheduler_address.replace("tcp", "dask", 1), 1, packing) as engine,
    ):
        engine.executor.submit(stand_in, sizes).result()
        start = time.process_time()
        for _ in range(_SENT_BODIES):
            engine.executor.submit(stand_in, sizes).result()
        seconds = time.process_time() - start
    return seconds / (_SENT_BODIES * len(sizes))
