"""`bench cluster`: costs of packing on Dask clusters of this machine, and the time that they predict for any cluster.

Processor time is measured by role, in workers, in the scheduler and in the process that packs, since workers that share
the processors of one machine cannot show in seconds how many machines would do.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from benches.data.render.scaling import CLUSTER
from bodyseg_data.core import ProgressCallback, silent
from bodyseg_data.machine import processors, required
from bodyseg_data.packing import Packing, open_engine, pack
from bodyseg_data.packing.packer import render_run
from bodyseg_data.samples import ViewGrid
from bodyseg_data.shards import MANIFEST_NAME

_VIEWS: Final = 54
"""Views of a body, and so of a job."""

_IDLE_S: Final = 20.0
"""Seconds for which idle processes are measured: Dask's take time while they wait, too."""

_PROCESSES: Final = True
"""Workers are processes, as on a cluster, and not threads."""

MACHINES: Final = 1000
"""Number of workers of one core for which the costs predict the speed."""


Usage = tuple[float, float, float]
"""Processor seconds of all workers, of the scheduler, and of the process that packs."""


@dataclass(frozen=True)
class Costs:
    """Processor milliseconds a view. worker: in all workers; scheduler; packer: the process that packs and writes."""

    worker: float
    scheduler: float
    packer: float

    def seconds(self, views: int, workers: int, processors: int | None = None) -> float:
        """Predict the seconds of a packing: the slowest of workers, scheduler and packer sets them.

        processors: those that all share; None if each has its own.
        """
        shared = sum(asdict(self).values()) / processors if processors else 0.0
        return views * max(self.worker / workers, self.scheduler, self.packer, shared) / 1e3


def bench_cluster(
    views: int = 40, num_workers: tuple[int, ...] = (1, 2, 4), progress: ProgressCallback = silent
) -> dict[str, Any]:
    """Costs of packing `views` open bodies of `_VIEWS` views each, by clusters of workers of one thread.

    clusters: for each of `num_workers` the seconds from the first job to the manifest, views a second; `Costs` in
    milliseconds a view; idle_ms, the milliseconds a second that workers, scheduler and packer each take while nothing
    is packed, which the costs leave out; and predicted_s, the seconds that the costs of the first cluster predict on
    the processors of this machine if nothing else runs on them. The body model is loaded before, by a packing of one
    body. job_bytes, result_bytes: on the connections, for one body. machines: `at_scale` of the costs of the last
    cluster. equal: whether all manifests are the same bytes. Raises MissingLibrary without `distributed` or Anny.
    """
    packing = Packing("open", meshes=views, views=ViewGrid(count=_VIEWS))
    count = views * _VIEWS
    cores = processors()
    rows: list[dict[str, Any]] = []
    measured: list[Costs] = []
    manifests = set()
    sizes: dict[str, int] = {}
    for done, workers in enumerate(num_workers, 1):
        with tempfile.TemporaryDirectory() as folder, _nodes(workers) as nodes:
            sizes = sizes or _sizes(packing)
            seconds, costs, idle = _packed(packing, workers, nodes, Path(folder))
            manifests.add((Path(folder) / "shards" / MANIFEST_NAME).read_bytes())
        measured.append(costs)
        rows.append(
            {
                "workers": workers,
                "seconds": round(seconds, 3),
                "views_a_second": round(count / seconds, 2),
                **{f"{name}_ms": round(value, 4) for name, value in asdict(costs).items()},
                "idle_ms": {name: round(value * 1e3, 2) for name, value in zip(asdict(costs), idle, strict=True)},
                "predicted_s": round(measured[0].seconds(count, workers, cores), 3),
            }
        )
        progress(done, len(num_workers))
    return {
        "views": count,
        "views_a_job": _VIEWS,
        "processors": cores,
        "clusters": rows,
        **sizes,
        "machines": at_scale(measured[-1]),
        "equal": len(manifests) == 1,
    }


def at_scale(costs: Costs) -> dict[str, float] | None:
    """Views a second of `MACHINES` workers, and the number of workers from which on more bring nothing.

    None if scheduler or packer took no more than when idle: a measurement of too few jobs, which predicts nothing.
    """
    if not costs.scheduler or not costs.packer:
        return None
    return {
        "workers": MACHINES,
        "views_a_second": round(1 / costs.seconds(1, MACHINES), 1),
        "useful_workers": int(costs.worker / max(costs.scheduler, costs.packer)),
    }


@contextmanager
def _nodes(workers: int) -> Iterator[Any]:
    """A cluster on this machine, whose scheduler is a thread of this process."""
    distributed = required("distributed", "bench cluster", "cluster")
    options = CLUSTER | {"n_workers": workers, "processes": _PROCESSES, "protocol": "tcp://"}
    with distributed.LocalCluster(**options) as nodes:
        yield nodes


def _sizes(packing: Packing) -> dict[str, int]:
    """Bytes of the first body's job and of its result as Dask sends them."""
    from distributed.protocol import serialize_bytes

    job = (packing, packing.bodies()[0], tuple(packing.views), "0" * 64)
    return {
        "job_bytes": len(serialize_bytes((render_run, *job))),
        "result_bytes": len(serialize_bytes(render_run(*job))),
    }


def _packed(packing: Packing, workers: int, nodes: Any, folder: Path) -> tuple[float, Costs, Usage]:
    """Seconds of a packing, its costs, and what idle processes use, seconds of processor a second."""
    import distributed

    address = nodes.scheduler_address.replace("tcp", "dask", 1)
    warm = Packing(packing.source, meshes=workers, views=ViewGrid(count=1), rig=packing.rig)
    with open_engine(address, workers, warm) as engine:
        pack(warm, folder / "warm", engine.executor, workers)
    with distributed.Client(nodes, set_as_default=False) as client, open_engine(address, workers, packing) as engine:

        def used() -> Usage:
            """Processor seconds so far: of all workers, of the scheduler's thread, of the rest of this process."""
            scheduler = client.run_on_scheduler(time.thread_time)
            return sum(client.run(time.process_time).values()), scheduler, time.process_time() - scheduler

        def measured(work: Callable[[], object]) -> tuple[float, Usage]:
            before, start = used(), time.perf_counter()
            work()
            seconds, after = time.perf_counter() - start, used()
            workers_s, scheduler_s, packer_s = (end - begin for begin, end in zip(before, after, strict=True))
            return seconds, (workers_s, scheduler_s, packer_s)

        measured(lambda: None)  # the first question takes longer
        _, asking = measured(lambda: None)  # what it takes itself, which is no cost of what it measures
        waited, idle = measured(lambda: time.sleep(_IDLE_S))
        seconds, taken = measured(lambda: pack(packing, folder / "shards", engine.executor, workers))
    worker, scheduler, packer = (max(each - own, 0.0) / waited for each, own in zip(idle, asking, strict=True))
    count = len(packing.bodies()) * len(packing.views) / 1e3
    rates: Usage = worker, scheduler, packer
    above_idle = zip(taken, asking, rates, strict=True)
    costs = Costs(*(max(spent - own - rate * seconds, 0.0) / count for spent, own, rate in above_idle))
    return seconds, costs, rates
