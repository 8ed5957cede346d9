"""`bench cold`: a store that many ranks begin to read at once, and what their look-ahead asks of it, in simulated time.

The plans are those that `LookAhead` makes for the ranks' own orders; connections and clock alone are simulated.
"""

from __future__ import annotations

import heapq
import itertools
from collections import defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

from benches.data.reading.bench import BATCH, LARGEST, RANKS, RANKS_A_MACHINE
from benches.data.reading.far import LATENCY_S, ORDERS, RATE
from benches.data.reading.manifests import write_large_index
from benches.measuring import counter
from bodyseg_data.core import ProgressCallback, silent
from bodyseg_data.loading import RangeImages
from bodyseg_data.loading.image_set import Pass, batch_bounds
from bodyseg_data.shards import LookAhead, RemoteFolder, RetryPolicy, with_cache
from bodyseg_data.shards.ahead import CONNECTIONS

_POLL_S: Final = 0.02
"""Seconds after which a thread looks again whether another rank has fetched a shard."""

Spans = list[tuple[float, float]]
"""Start and end of requests."""

LARGE_SAMPLES: Final = 320
"""Samples of each rank that are read of the large set."""


def bench_cold(data: str, progress: ProgressCallback = silent) -> dict[str, Any]:
    """Cold starts of `RANKS` ranks with each order: see `cold_start`.

    rows: the first epoch of the train split of `data`, a local folder, for each number of ranks that share a machine.
    large: the first `LARGE_SAMPLES` of each rank of a set of `LARGEST` samples, by blocks and without a cache. Raises
    BadConfig for a set with fewer samples than ranks.
    """
    folder = Path(data)
    images = RangeImages(folder, "none", "train")
    cases = [*itertools.product(ORDERS, (None, *RANKS_A_MACHINE))]
    tick = counter(progress, len(cases) + 1)
    small = []
    for order, group in cases:
        small.append(cold_start(images, folder, order, group, RANKS, BATCH))
        tick()
    with TemporaryDirectory() as name:
        write_large_index(images.manifest, LARGEST, Path(name))
        whole = RangeImages(name, "none", "train")
        large = cold_start(whole, Path(name), "blocks", None, RANKS, BATCH, LARGE_SAMPLES)
        tick()
    return {
        "rank_count": RANKS,
        "batch": BATCH,
        "latency_s": LATENCY_S,
        "rate": RATE,
        "connections": CONNECTIONS,
        "set_bytes": images.stored_bytes(),
        "rows": small,
        "large_samples": LARGEST,
        "large": large,
    }


def cold_start(
    images: RangeImages, folder: Path, order: str, group: int | None, ranks: int, batch: int, most: int | None = None
) -> dict[str, Any]:
    """The first epoch of all ranks from a store of `LATENCY_S` a request and `RATE` bytes a second and connection.

    images: of `folder`, a local set, which stands for the store. group: ranks that share a cache; None for no cache.
    most: first samples of each rank's epoch; None for all of them. samples, requests, bytes: of all ranks. first_s:
    seconds until the last rank's first batch is there; all_s: until all is. most_at_once: requests at one time;
    of_one_file: the most of them for one file.
    """
    spans: defaultdict[str, Spans] = defaultdict(list)
    came: dict[tuple[int, str], tuple[float, float]] = {}  # of shards by machine, of ranges by rank: start and end
    sent = samples = 0
    with TemporaryDirectory() as caches:
        everyone = images.requests(0, ORDERS[order])
        bounds = batch_bounds(len(images), 0, batch, ranks, False)
        jobs: list[Iterator[Any]] = []  # partial calls of the look-ahead's own methods
        first: list[list[tuple[str, int]]] = []
        for rank in range(ranks):
            if rank % (group or 1) == 0:
                remote = RemoteFolder(f"file://{folder.absolute()}", {}, RetryPolicy())
                kept = (Path(caches) / str(rank), None) if group else (None, 0)
                store = with_cache(remote, images.manifest.shards, *kept)
            places = [
                (store, file, index)
                for _, file, index in itertools.islice(Pass(0, everyone, bounds, rank, ranks).places(images), most)
            ]
            samples += len(places)
            ahead = LookAhead(places)
            while not ahead._planned:
                ahead._plan()  # all at once: nothing waits for memory
            jobs.append(iter([*ahead._jobs]))
            first.append([(file.name, file.entry(index).offset) for _, file, index in places[:batch]])
        waiting: list[tuple[float, int, int, Any]] = [
            (0.0, thread, rank, None) for thread in range(CONNECTIONS) for rank in range(ranks)
        ]
        while waiting:
            now, thread, rank, again = heapq.heappop(waiting)
            job = again or next(jobs[rank], None)
            if job is None:
                continue
            owner, end = rank // (group or 1), now
            if job.func.__name__ == "_keep":
                file = job.args[1]
                if (owner, file.name) not in came:
                    end = now + LATENCY_S + file.size / RATE
                    came[owner, file.name] = now + LATENCY_S, end
                    spans[file.name].append((now, end))
                    sent += file.size
                elif came[owner, file.name][1] > now:  # another rank of the machine fetches it
                    heapq.heappush(waiting, (now + _POLL_S, thread, rank, job))
                    continue
            else:
                one = job.args[0]
                end = now + LATENCY_S + (one.stop - one.start) / RATE
                came |= {(rank, f"{one.name} {offset}"): (end, end) for offset, _, _ in one.pieces}
                spans[one.name].append((now, end))
                sent += one.stop - one.start
            heapq.heappush(waiting, (end, thread, rank, None))
    ready = []
    for rank, needed in enumerate(first):
        for name, offset in needed:
            shard = came.get((rank // (group or 1), name))
            ready.append(came[rank, f"{name} {offset}"][1] if shard is None else shard[0] + offset / RATE)
    return {
        "order": order,
        "ranks_a_machine": group,
        "samples": samples,
        "requests": sum(map(len, spans.values())),
        "bytes": sent,
        "first_s": round(max(ready), 2),
        "all_s": round(max(end for each in spans.values() for _, end in each), 2),
        "most_at_once": _most(itertools.chain(*spans.values())),
        "of_one_file": max(map(_most, spans.values())),
    }


def _most(spans: Iterable[tuple[float, float]]) -> int:
    """The most requests at one time; one that ends makes room for another that starts then."""
    steps = sorted(step for start, end in spans for step in ((start, 1), (end, -1)))
    return max(itertools.accumulate(change for _, change in steps))
