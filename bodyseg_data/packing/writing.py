"""The cut of a packing into shards, and the writing of those that are not yet there."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from bodyseg_data.bodies.source import BodyRef
from bodyseg_data.core.errors import BadShard
from bodyseg_data.core.splits import SPLITS, Split
from bodyseg_data.core.system.progress import ProgressCallback
from bodyseg_data.core.views import View
from bodyseg_data.packing.engines.ordered import ordered
from bodyseg_data.packing.options import Packing
from bodyseg_data.packing.skipping import SKIPPABLE
from bodyseg_data.packing.state import finished_shards, record_shard
from bodyseg_data.shards.records import ShardRecord
from bodyseg_data.shards.tar import ShardWriter


@dataclass(frozen=True)
class Rendered:
    """The result of a run. samples: key and members (extension -> bytes). notes: lines about the body."""

    samples: list[tuple[str, dict[str, bytes]]]
    notes: tuple[str, ...]


@dataclass(frozen=True)
class Shard:
    """A shard to be written: its samples in order, as runs of views of one body."""

    name: str
    split: Split
    runs: tuple[tuple[BodyRef, tuple[View, ...]], ...]

    def __len__(self) -> int:
        return sum(len(views) for _, views in self.runs)


def cut(packing: Packing, bodies: Sequence[BodyRef]) -> list[Shard]:
    """Cut the samples of bodies into shards: by split, then in the order of bodies and views."""
    shards = []
    for split in SPLITS:
        entries = ((body, view) for body in bodies if body.split == split for view in packing.views_of(body))
        for number in itertools.count():
            part = list(itertools.islice(entries, packing.shard_samples))
            if not part:
                break
            runs = tuple(
                (body, tuple(view for _, view in run))
                for body, run in itertools.groupby(part, key=lambda entry: entry[0])
            )
            shards.append(Shard(f"{split}-{number:05d}.tar", split, runs))
    return shards


def cut_again(shards: Sequence[Shard], body: BodyRef) -> list[Shard]:
    """The shards whose samples change without a body: the first that holds it, and all after it of its split."""
    of_split = [shard for shard in shards if shard.split == body.split]
    first = next(index for index, shard in enumerate(of_split) if any(each == body for each, _ in shard.runs))
    return of_split[first:]


def write_shards(
    packing: Packing,
    shards: Sequence[Shard],
    folders: tuple[Path, Path],
    render: Callable[[BodyRef, tuple[View, ...]], Future[Rendered]],
    workers: int,
    progress: ProgressCallback,
) -> tuple[tuple[BodyRef, Exception] | None, dict[str, ShardRecord]]:
    """Write the shards that are not yet there. Returns the first body that cannot be packed and the error, or None, and
    the records of all finished shards.

    folders: of the set and of its state. render: begins to render a body from some views.
    """
    out, state = folders
    total = sum(len(shard) for shard in shards)
    records = finished_shards(out, state, [shard.name for shard in shards])
    done = sum(len(record) for record in records.values())
    progress(done, total)
    todo = [shard for shard in shards if shard.name not in records]
    jobs = (partial(render, body, views) for shard in todo for body, views in shard.runs)
    with contextlib.closing(ordered(jobs, workers)) as results:
        for shard in todo:
            with ShardWriter(out / shard.name, state / f"{shard.name}.part", shard.split) as writer:
                for body, views in shard.runs:
                    try:
                        rendered = next(results)
                    except SKIPPABLE as error:
                        return (body, error), records
                    for key, members in rendered.samples:
                        writer.write(key, members)
                        done += 1
                    # A body that goes on in the next shard is noted where it begins.
                    if views[0] == next(packing.views_of(body)):
                        writer.note(body.mesh, rendered.notes)
                    progress(done, total)
            if writer.record is None:
                raise BadShard(f"{shard.name} was not written")
            records[shard.name] = writer.record
            record_shard(state, writer.record)
    return None, records
