"""From finished renders to shards: files are read ahead by threads and written in the source's order."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, Final

from bodyseg_data.core import ProgressCallback, silent
from bodyseg_data.machine import processors
from bodyseg_data.packing.jobs import ordered
from bodyseg_data.packing.shard_writer import ShardWriter
from bodyseg_data.renders import Render, RenderSource, check_plausible
from bodyseg_data.samples import SPLITS
from bodyseg_data.shards import CodecName, Manifest, ProjectorKind, read_manifest

_CHECKED: Final = 4
"""Number of renders whose two views are compared: a mistake in a set is in all of it."""


def plan_renders(source: RenderSource) -> dict[str, Any]:
    """Counts per split, classes and planes, without reading any image; plain JSON."""
    splits = list(map(source.split, source.keys()))
    counts = {split: splits.count(split) for split in SPLITS}
    described = {"classes": list(source.classes.names), "planes": dict(source.planes), "fields": dict(source.fields)}
    return {"source": "renders", "views": len(splits), **counts, "rigs": len(source.rigs), **described}


def pack_renders(
    source: RenderSource,
    out: Path,
    *,
    codec: CodecName = "bsi",
    projector: ProjectorKind | None = None,
    shard_samples: int = 1080,
    workers: int | None = None,
    progress: ProgressCallback = silent,
) -> Manifest:
    """Pack renders into the folder `out` and return its manifest; carries on where an interrupted packing stopped.

    projector, codec, shard_samples: as of `ShardWriter`. workers: threads that read, and as many that encode (default:
    one a processor). Renders of finished shards are not read again. Raises BadSample for the first render that breaks
    a rule, and as `ShardWriter`.
    """
    keys, count = source.keys(), processors() if workers is None else workers
    writer = ShardWriter(
        out,
        rig=source.rigs,
        classes=source.classes,
        projector=projector,
        planes=source.planes,
        fields=source.fields,
        codec=codec,
        shard_samples=shard_samples,
        workers=count,
    )
    with ThreadPoolExecutor(max(1, count)) as pool, writer:

        def reads(key: str) -> Callable[[], Future[Render | None]]:
            return partial(pool.submit, lambda: None if key in writer else source.load(key))

        done = sum(key in writer for key in keys)
        progress(done, len(keys))
        for number, (key, render) in enumerate(zip(keys, ordered(map(reads, keys), count), strict=True)):
            if render is None:
                continue
            if number < _CHECKED:
                check_plausible(render, source.rigs[render.rig], key)
            given = dict(vars(render))
            if projector == "none":
                given["projector_range_m"] = None
            done += writer.write(**given)
            progress(done, len(keys))
    return read_manifest(out)
