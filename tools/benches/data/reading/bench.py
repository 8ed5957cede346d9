"""`bench reading`: 64 ranks that read one object store, and what opening a set takes as it grows."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any, Final

from benches.data.reading.manifests import cost_of_opening, fit
from bodyseg_data.core import BadConfig, ProgressCallback, silent
from bodyseg_data.loading import RangeImages
from bodyseg_data.shards import MANIFEST_NAME, RemoteFolder, RetryPolicy, read_manifest, with_cache
from bodyseg_data.shards.records import check_bytes

RANKS: Final = 64
RANKS_A_MACHINE: Final = (8, 64)
BATCH: Final = 16
SIZES: Final = (1_080_000, 3_240_000, 10_800_000)
"""Samples of the manifests that are opened."""
LARGEST: Final = 99_999_360

_BLOCK_BYTES: Final = 4 << 20
"""Requests of protocols other than HTTP are of at most this size."""


class CountedFolder(RemoteFolder):
    """Folder behind an address that counts requests, as object stores get them, and bytes."""

    requests = sent = 0

    def fetch(self, name: str, start: int, stop: int, *how: Any, **more: Any) -> None:
        self._count(stop - start)
        super().fetch(name, start, stop, *how, **more)

    def _count(self, size: int) -> None:
        self.requests += -(-size // _BLOCK_BYTES)
        self.sent += size


def bench_reading(data: str, progress: ProgressCallback = silent) -> dict[str, Any]:
    """Requests and bytes of one epoch of `RANKS` ranks over the set `data`, a local folder, and costs of opening sets.

    ranks: for each number of ranks that share a machine, and so a cache, requests and bytes sent over the bytes of the
    set; the row without a cache reads samples by byte range. opening: for sets of
    `SIZES` samples, without and with an index, and for one of `LARGEST` with an index; fits: lines through those
    without, and their value for `LARGEST` samples. Raises BadConfig for a set with fewer samples than ranks.
    """
    folder = Path(data)
    images = RangeImages(folder, variant="none", split="train")
    if len(images) < RANKS:
        raise BadConfig(f"bench reading needs a set of at least {RANKS} training samples, found {len(images)}")
    kinds = [*((samples, indexed) for samples in SIZES for indexed in (False, True)), (LARGEST, True)]
    steps = len(RANKS_A_MACHINE) + 1 + len(kinds)
    rows = []
    for done, group in enumerate((None, *RANKS_A_MACHINE), 1):
        rows.append(_epoch(images, folder, group))
        progress(done, steps)
    opening = []
    for samples, indexed in kinds:
        opening.append(cost_of_opening(images.manifest, samples, indexed))
        progress(len(rows) + len(opening), steps)
    whole = [row for row in opening if not row["indexed"]]
    return {
        "rank_count": RANKS,
        "batch": BATCH,
        "samples": len(images),
        "set_bytes": images.stored_bytes(),
        "manifest_bytes": (folder / MANIFEST_NAME).stat().st_size,
        "ranks": rows,
        "opening": opening,
        "extrapolated_to": LARGEST,
        "fits": {name: fit(whole, name, LARGEST) for name in ("bytes", "cpu_s", "memory_bytes")},
    }


def _epoch(images: RangeImages, folder: Path, group: int | None) -> dict[str, Any]:
    """One epoch of all ranks. group: ranks that share a cache; None for no cache."""
    store = CountedFolder(f"file://{folder.absolute()}", {}, RetryPolicy())
    shards = {shard.name: shard for shard in read_manifest(folder).shards}
    index = {name: {offset: number for number, offset in enumerate(shard.offsets)} for name, shard in shards.items()}
    chosen = [shards[name] for name in sorted({images.location(each)[0] for each in range(len(images))})]
    with tempfile.TemporaryDirectory() as caches:
        for rank in range(RANKS):
            place = Path(caches) / str(rank // group) if group else None
            cached = with_cache(store, chosen, place, None if group else 0)
            for requests in images.batches(BATCH, rank=rank, world_size=RANKS):
                for _, sample in requests:
                    name, _, offset = images.location(sample)
                    number = index[name][offset]
                    check_bytes(cached.read(name, offset, shards[name].lengths[number]), shards[name], number)
            images.set_epoch(0)
    return {
        "ranks_a_machine": group,
        "requests": store.requests,
        "bytes": store.sent,
        "times_the_set": round(store.sent / sum(shard.size for shard in chosen), 3),
    }
