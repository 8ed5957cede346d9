"""`bench packing`: size of a whole set, and time and memory of packing it in processes of this machine."""

from __future__ import annotations

import multiprocessing
import resource
import tempfile
import time
from pathlib import Path
from typing import Any

from bodyseg_data.core import ProgressCallback, silent
from bodyseg_data.machine import peak_mb
from bodyseg_data.packing import PROCESSES, Packing, open_engine, pack
from bodyseg_data.samples import SPLITS


def bench_packing(
    data: str, num_workers: tuple[int, ...] = (2,), progress: ProgressCallback = silent
) -> dict[str, Any]:
    """Figures of packing the source `data`, all of it, into a folder that goes again; see `measured`."""
    with tempfile.TemporaryDirectory(dir=".") as folder:
        return measured(Packing(data), Path(folder) / "set", num_workers[0], progress)


def measured(packing: Packing, out: Path, workers: int, progress: ProgressCallback = silent) -> dict[str, Any]:
    """Samples and bytes of a set that is packed into `out`; seconds, processor seconds and most memory, MB, of the
    process that writes, and of the workers.
    """
    others, start = multiprocessing.active_children(), time.perf_counter()
    with open_engine(PROCESSES, workers, packing) as engine:
        manifest = pack(packing, out, engine.executor, engine.workers, progress)
        seconds = time.perf_counter() - start
        workers_mb = [peak_mb(each.pid) for each in multiprocessing.active_children() if each not in others]
    here, there = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    samples, size = manifest.samples(), sum(shard.size for shard in manifest.shards)
    return {
        "samples": samples,
        "splits": {split: manifest.samples(split) for split in SPLITS},
        "shards": len(manifest.shards),
        "bytes": size,
        "bytes_per_sample": round(size / samples),
        "seconds": round(seconds, 1),
        "samples_per_second": round(samples / seconds, 1),
        "workers": workers,
        "processor_seconds": {
            "writer": round(here.ru_utime + here.ru_stime, 1),
            "workers": round(there.ru_utime + there.ru_stime, 1),
        },
        "peak_mb": {"writer": peak_mb(), "workers": workers_mb},
        "notes": sum(len(shard.notes) for shard in manifest.shards),
    }
