"""`bodyseg shard`: render bodies and pack them into shards."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bodyseg_data.bodies import SourceName
from bodyseg_data.codec import CodecName
from bodyseg_data.commands.progress import Progress
from bodyseg_data.errors import BadConfig
from bodyseg_data.machine import processors
from bodyseg_data.manifest import Manifest
from bodyseg_data.options import option
from bodyseg_data.packing import Packing, pack, plan
from bodyseg_data.rendering import RendererName
from bodyseg_data.rig import load_rig
from bodyseg_data.views import ViewGrid

EXAMPLE = "bodyseg shard --source open --meshes 40 --out shards"


@dataclass(frozen=True)
class Options:
    """What the command takes."""

    source: SourceName = option("where bodies come from")
    path: Path | None = option("folder of the source's meshes, for sources that read one", None)
    out: Path | None = option("folder for the shards; a packing cut short carries on where it stopped", None)
    meshes: int | None = option("how many bodies, evenly from every subset (default: all)", None)
    views: int | None = option("how many views of each body (default: all, distances x azimuths)", None)
    distances: tuple[int, ...] = option("distances from the camera, cm", ViewGrid.distances_cm)
    azimuths: int = option("how many directions round the body", ViewGrid.azimuths)
    azimuth_span: int = option("degrees that the azimuths cover", ViewGrid.span_deg)
    rig: str = option("a rig that ships with the package, or a .toml file", "paper")
    renderer: RendererName = option("what draws", Packing.renderer)
    codec: CodecName = option("how images are stored", Packing.codec)
    shard_samples: int = option("samples a shard", Packing.shard_samples)
    workers: int | None = option("processes that render (default: one a processor)", None)
    plan: bool = option("print the counts as JSON and render nothing", False)

    def packing(self) -> Packing:
        """What to pack. Raises BadConfig."""
        views = ViewGrid(self.distances, self.azimuths, self.azimuth_span, self.views)
        return Packing(
            source=self.source,
            path=self.path,
            meshes=self.meshes,
            views=views,
            rig=load_rig(self.rig),
            renderer=self.renderer,
            codec=self.codec,
            shard_samples=self.shard_samples,
        )


def run(options: Options) -> int:
    """Pack, or print the plan."""
    packing = options.packing()
    if options.plan:
        sys.stdout.write(json.dumps(plan(packing), indent=2) + "\n")
        return 0
    if options.out is None:
        raise BadConfig("--out is missing: the folder for the shards (or --plan to see the counts only)")
    workers = processors() if options.workers is None else options.workers
    manifest = pack_in_processes(packing, options.out, workers, "packing")
    size = sum(shard.size for shard in manifest.shards)
    sys.stdout.write(
        f"{options.out}: {manifest.samples()} samples in {len(manifest.shards)} shards, {size / 1e6:.1f} MB, "
        f"{size / manifest.samples() / 1000:.1f} kB a sample\n"
    )
    return 0


def pack_in_processes(packing: Packing, out: Path, workers: int, title: str) -> Manifest:
    """Pack with `workers` processes on this machine, showing progress."""
    if workers < 1:
        raise BadConfig(f"packing needs at least one worker, found {workers}")
    # One thread of linear algebra a worker: with one worker a processor, more only get in each other's way.
    for library in ("OPENBLAS", "OMP", "MKL"):
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")
    # Fresh processes, not forks: a fork of a process that has used threads, or drawn with OpenGL, can deadlock.
    context = multiprocessing.get_context("spawn")
    executor = _Workers(workers, mp_context=context, initializer=_end_with_parent)
    try:
        with Progress(title, "views") as progress:
            return pack(packing, out, executor, workers, progress.update)
    except BaseException:
        # Nothing of what the workers are at will be used: the user need not wait for it.
        for worker in multiprocessing.active_children():
            worker.kill()
        raise
    finally:
        executor.shutdown(wait=True, cancel_futures=True)


class _Workers(ProcessPoolExecutor):
    """Processes that Ctrl-C on a terminal does not reach: it goes to this one, which ends them."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        # Workers are started in here. They start with the signals blocked that are blocked now; and a signal that
        # came between starting one and telling it what it is would leave it behind, with a traceback of its own.
        with _signals_held():
            before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
            try:
                return super().submit(fn, *args, **kwargs)
            finally:
                signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _signals_held() -> Iterator[None]:
    """Put off what SIGINT and SIGTERM do until the context ends."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = {number: signal.signal(number, lambda number, frame: came.append(number)) for number in numbers}
    try:
        yield
    finally:
        for number, action in before.items():
            signal.signal(number, action)
        for late in came:
            signal.raise_signal(late)


def _end_with_parent() -> None:
    """Make a worker end when the process that started it is gone, however it went."""
    parent = multiprocessing.parent_process()

    def wait() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
