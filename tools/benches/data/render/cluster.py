"""`bench cluster`: packing on Dask clusters of this machine, and the time that the costs of a view predict for it."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any, Final

from bodyseg_data.core.system.libraries import missing_library
from bodyseg_data.core.system.progress import ProgressCallback, silent
from bodyseg_data.core.views import ViewGrid
from bodyseg_data.packing.engines.engine import open_engine
from bodyseg_data.packing.options import Packing
from bodyseg_data.packing.pack import pack
from bodyseg_data.shards.manifest import MANIFEST_NAME

_BODIES: Final = 40
_PROCESSES: Final = True
"""Workers are processes, as on a cluster, and not threads."""


def bench_cluster(
    views: int = 54, num_workers: tuple[int, ...] = (1, 2, 4), progress: ProgressCallback = silent
) -> dict[str, Any]:
    """Seconds of packing `views` views of each of `_BODIES` open bodies, by clusters of workers of one thread.

    clusters: for each of `num_workers` the seconds from the first job to the manifest, views a second, and the share of
    the speed of as many times the first cluster's workers. The body model is loaded before, by a packing of one body.
    equal: whether all manifests are the same bytes.
    Raises MissingLibrary without `distributed` or Anny.
    """
    packing = Packing("open", meshes=_BODIES, views=ViewGrid(count=views))
    rows: list[dict[str, Any]] = []
    manifests = set()
    for done, workers in enumerate(num_workers, 1):
        with tempfile.TemporaryDirectory() as folder:
            seconds = _packed(packing, workers, Path(folder))
            manifests.add((Path(folder) / "shards" / MANIFEST_NAME).read_bytes())
        speed = _BODIES * views / seconds
        first = rows[0] if rows else {"workers": workers, "views_a_second": speed}
        ideal = first["views_a_second"] * workers / first["workers"]
        rows.append(
            {
                "workers": workers,
                "seconds": round(seconds, 3),
                "views_a_second": round(speed, 2),
                "share_of_linear": round(speed / ideal, 3),
            }
        )
        progress(done, len(num_workers))
    return {"views": _BODIES * views, "clusters": rows, "equal": len(manifests) == 1}


def _packed(packing: Packing, workers: int, folder: Path) -> float:
    try:
        import distributed
    except ImportError as error:
        raise missing_library("bench cluster", error, extra="cluster") from error
    options: dict[str, Any] = {
        "n_workers": workers,
        "threads_per_worker": 1,
        "processes": _PROCESSES,
        "protocol": "tcp://",
    }
    options |= {"dashboard_address": None, "silence_logs": 50, "scheduler_kwargs": {"dashboard_address": ":0"}}
    with distributed.LocalCluster(**options) as nodes:
        address = nodes.scheduler_address.replace("tcp", "dask", 1)
        warm = Packing(packing.source, meshes=workers, views=ViewGrid(count=1), rig=packing.rig)
        for part, name in ((warm, "warm"), (packing, "shards")):
            with open_engine(address, workers, part) as engine:
                start = time.perf_counter()
                pack(part, folder / name, engine.executor, workers)
                seconds = time.perf_counter() - start
    return seconds
