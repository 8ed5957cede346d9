"""`bench far`: reading a set from a store that is far away, cold, with and without look-ahead, in every order."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np

from benches.data.reading.throttled import ThrottledServer
from benches.measuring import counter
from bodyseg_data.core import ProgressCallback, silent
from bodyseg_data.loading import RangeImages, loader
from bodyseg_data.packing import PROCESSES, Packing, open_engine, pack
from bodyseg_data.samples import ViewGrid
from bodyseg_data.shards import LookAhead
from bodyseg_data.shards.ahead import CONNECTIONS

LATENCY_S: Final = 0.03
RATE: Final = 4e6
"""Bytes a second of one connection."""
BATCH: Final = 20
SHARD_SAMPLES: Final = 88
ORDERS: Final[dict[str, Any]] = {"blocks": "blocks", "global": True, "stored": False}
CACHES: Final = ("whole", "part", "none")
_PART: Final = 20 / 44
"""Share of the set's bytes that the cache of the row `part` has room for."""
_VIEWS: Final = 36


def bench_far(
    views: int = 2016, progress: ProgressCallback = silent, data: str | None = None, num_workers: int = 2
) -> dict[str, Any]:
    """Cold epochs of `all` over a throttled server.

    views: samples in all, rounded up to whole bodies; data: a set to take in place of a new one. rows: for each cache
    (for the whole set, for a part of it, none) each order, and one also without look-ahead: seconds to the first batch
    and of the epoch, bytes sent over the set's, requests.
    link_s: the set's bytes by the rate of all connections. shard_s: one shard's fetch. local_s: of an epoch from a
    local folder. warm_over_local: processor time from a full cache over that from the folder. mixing: see `_mixing`.
    """
    with TemporaryDirectory(prefix="bodyseg-far-") as folder:
        packed = Path(data) if data else _packed(views, Path(folder) / "set")
        images = RangeImages(packed)
        images.image(0)  # its loops are compiled
        sizes = [shard.size for shard in images.manifest.shards]
        tick = counter(progress, (len(ORDERS) + 1) * len(CACHES) + 1)
        rows = []
        with ThrottledServer(packed, LATENCY_S, RATE) as server:
            for cache in CACHES:
                for order, looks in (*((name, True) for name in ORDERS), ("global", False)):
                    rows.append(_epoch(server, Path(folder), cache, order, looks, num_workers, sum(sizes)))
                    tick()
        local = _warm(packed, Path(folder) / "kept", num_workers)
        tick()
    return {
        "samples": len(images),
        "shards": len(sizes),
        "set_bytes": sum(sizes),
        "latency_s": LATENCY_S,
        "rate": RATE,
        "connections": CONNECTIONS,
        "num_workers": num_workers,
        "link_s": round(sum(sizes) / (CONNECTIONS * RATE), 3),
        "shard_s": round(LATENCY_S + max(sizes) / RATE, 3),
        "rows": rows,
        **local,
        "load": round(os.getloadavg()[0], 1),
        "processors": os.cpu_count(),
        "mixing": {order: _mixing(images, shuffle) for order, shuffle in ORDERS.items()},
    }


def _packed(views: int, out: Path) -> Path:
    packing = Packing("open", meshes=-(-views // _VIEWS), views=ViewGrid(count=_VIEWS), shard_samples=SHARD_SAMPLES)
    with open_engine(PROCESSES, None, packing) as on:
        pack(packing, out, on.executor, on.workers)
    return out


@contextmanager
def _looking(ahead_too: bool) -> Iterator[None]:
    """Loaders of the context look ahead, or not."""
    start = LookAhead.start
    if not ahead_too:
        LookAhead.start = lambda *_: None  # type: ignore[method-assign]
    try:
        yield
    finally:
        LookAhead.start = start  # type: ignore[method-assign]


def _epoch(
    server: ThrottledServer, folder: Path, cache: str, order: str, looks: bool, workers: int, size: int
) -> dict[str, Any]:
    limit = {"whole": None, "part": int(size * _PART), "none": 0}[cache]
    with TemporaryDirectory(dir=folder) as place, _looking(looks):
        kept = {"cache_bytes": 0} if limit == 0 else {"cache": place, "cache_bytes": limit}
        images = RangeImages(server.url, "all", **kept)
        server.forget()
        start, first = time.perf_counter(), 0.0
        for _ in loader(images, BATCH, workers, shuffle=ORDERS[order]):
            first = first or time.perf_counter() - start
        seconds = time.perf_counter() - start
    return {
        "order": order,
        "cache": cache,
        "look_ahead": looks,
        "first_s": round(first, 3),
        "epoch_s": round(seconds, 3),
        "times_the_set": round(server.sent / size, 3),
        "requests": server.requests,
    }


def _warm(packed: Path, cache: Path, workers: int, turns: int = 3) -> dict[str, float]:
    """Epochs from a full cache and from a local folder in turns, the least of each."""
    with ThrottledServer(packed, 0.0, 1e9) as server:
        kept = loader(RangeImages(server.url, "all", cache=cache), BATCH, workers)
        both = [kept, loader(RangeImages(packed, "all"), BATCH, workers)]
        found: list[list[float]] = [[], []]
        seconds = []
        for turn in range(turns + 1):
            for which, batches in enumerate(both):
                start, begun = time.process_time(), time.perf_counter()
                for _ in batches:
                    pass
                if which:
                    seconds.append(time.perf_counter() - begun)
                if turn:  # the first fills the cache
                    found[which].append(time.process_time() - start)
    return {
        "warm_over_local": round(min(found[0]) / min(found[1]), 3),
        "local_s": round(min(seconds), 3),
    }


def _mixing(images: RangeImages, shuffle: Any, epochs: int = 3) -> dict[str, float]:
    """Measure how far an order is from uniform: means over batches of `BATCH` samples.

    subjects: different bodies in a batch. largest_share: of a batch from one body. apart: distance in the manifest of
    samples that follow each other, over that of two samples drawn at random.
    """
    mesh = np.unique(images.table()["mesh"], return_inverse=True)[1]
    subjects, largest, apart = [], [], []
    for epoch in range(epochs):
        order = images.order(epoch, shuffle)
        apart.append(np.abs(np.diff(order)).mean() / (len(order) / 3))
        for start in range(0, len(order) - BATCH + 1, BATCH):
            counts = np.unique(mesh[order[start : start + BATCH]], return_counts=True)[1]
            subjects.append(len(counts))
            largest.append(counts.max() / BATCH)
    return {
        "subjects": round(float(np.mean(subjects)), 2),
        "largest_share": round(float(np.mean(largest)), 3),
        "apart": round(float(np.mean(apart)), 3),
    }
