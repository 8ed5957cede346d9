"""`bench packing`: size of a whole set, and time of packing it in processes of this machine."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

from bodyseg_data.core import ProgressCallback, silent
from bodyseg_data.packing import PROCESSES, Packing, open_engine, pack


def bench_packing(
    data: str, num_workers: tuple[int, ...] = (2,), progress: ProgressCallback = silent
) -> dict[str, Any]:
    """Figures of packing the source `data`, all of it, into a folder that goes again; see `measured`."""
    with tempfile.TemporaryDirectory(dir=".") as folder:
        return measured(Packing(data), Path(folder) / "set", num_workers[0], progress)


def measured(packing: Packing, out: Path, workers: int, progress: ProgressCallback = silent) -> dict[str, Any]:
    """Samples and bytes of a set that is packed into `out`, and seconds."""
    start = time.perf_counter()
    with open_engine(PROCESSES, workers, packing) as engine:
        manifest = pack(packing, out, engine.executor, engine.workers, progress)
        seconds = time.perf_counter() - start
    samples, size = manifest.samples(), sum(shard.size for shard in manifest.shards)
    return {
        "samples": samples,
        "bytes": size,
        "bytes_per_sample": round(size / samples),
        "seconds": round(seconds, 1),
        "samples_per_second": round(samples / seconds, 1),
        "workers": workers,
    }
