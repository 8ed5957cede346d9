"""Shards of a packing: its cut into them, the writing of those that are not yet there, and the state of a run.

The state stands in `OUT/.packing/` while the packing runs, so that it can carry on where it was cut short.

plan.json           everything that shapes the bytes; another plan may not carry on here
.lock               held while a packing is at work
NAME.tar.part       the shard being written
NAME.tar.json       the record of a finished shard
skipped.json        meshes left out after the check: name -> reason
"""

import contextlib
import hashlib
import itertools
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

from bodyseg_data.bodies import BodyRef
from bodyseg_data.core import BadConfig, BadShard, ProgressCallback, reported
from bodyseg_data.files import Table, parse_json, parts_left, write_atomically
from bodyseg_data.files import claimed as held_alone
from bodyseg_data.labels import TEMPLATE
from bodyseg_data.packing.jobs import ordered
from bodyseg_data.packing.options import Packing
from bodyseg_data.packing.skipping import SKIPPABLE
from bodyseg_data.samples import SPLITS, Split, View
from bodyseg_data.shards import (
    BODY_FIELDS,
    MANIFEST_NAME,
    Fields,
    Manifest,
    ShardRecord,
    TarWriter,
    column_file,
    column_tar,
    read_manifest,
    record_from_json,
    record_to_json,
    shard_name,
)

STATE_NAME: Final = ".packing"
_SKIPPED: Final = "skipped.json"
_NO_FIELDS: Final = Fields(())
_COLUMN: Final = f"plane.{TEMPLATE}."


@dataclass(frozen=True)
class Rendered:
    """The result of a run. samples: key and members (extension -> bytes), also a column's. notes: about the body."""

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


def files_of(packing: Packing, shard: str) -> list[str]:
    """The tars of a shard: its own and, of a packing with the map of the body, that of this column."""
    return [shard, column_tar(shard, TEMPLATE)] if packing.template else [shard]


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
            shards.append(Shard(shard_name(split, number), split, runs))
    return shards


def cut_again(shards: Sequence[Shard], body: BodyRef) -> list[Shard]:
    """The shards whose samples change without a body: the first that holds it, and all after it of its split."""
    of_split = (shard for shard in shards if shard.split == body.split)
    return list(itertools.dropwhile(lambda shard: all(each != body for each, _ in shard.runs), of_split))


def write_shards(
    packing: Packing,
    shards: Sequence[Shard],
    folders: tuple[Path, Path],
    render: Callable[[BodyRef, tuple[View, ...]], Future[Rendered]],
    workers: int,
    progress: ProgressCallback,
) -> tuple[tuple[BodyRef, Exception] | None, dict[str, ShardRecord]]:
    """Write the shards that are not yet there. Returns the first body that cannot be packed and the error, or None, and
    the records of all finished tars.

    folders: of the set and of its state. render: begins to render a body from some views.
    """
    out, state = folders
    total = sum(len(shard) for shard in shards)
    records = finished_shards(out, state, [shard.name for shard in shards])
    if packing.template:
        names = [column_tar(shard.name, TEMPLATE) for shard in shards]
        records |= finished_shards(out, state, names, _NO_FIELDS, column_file(TEMPLATE))
    todo = [shard for shard in shards if not records.keys() >= {*files_of(packing, shard.name)}]
    done = total - sum(map(len, todo))
    progress(done, total)
    jobs = (partial(render, body, views) for shard in todo for body, views in shard.runs)
    with contextlib.closing(ordered(jobs, workers)) as results:
        for shard in todo:
            with contextlib.ExitStack() as stack:
                writers = {}
                for name in files_of(packing, shard.name):
                    if name not in records:
                        of_set = name == shard.name
                        fields = BODY_FIELDS if of_set else _NO_FIELDS
                        (out / (MANIFEST_NAME if of_set else column_file(TEMPLATE))).unlink(missing_ok=True)
                        writer = TarWriter(out / name, state / f"{name}.part", shard.split, fields)
                        writers[name] = stack.enter_context(writer)
                for body, views in shard.runs:
                    try:
                        rendered = next(results)
                    except SKIPPABLE as error:
                        stack.pop_all().__exit__(type(error), error, None)  # as after any error: its files go
                        return (body, error), records
                    for key, members in rendered.samples:
                        apart = {name: data for name, data in members.items() if name.startswith(_COLUMN)}
                        whole = {name: data for name, data in members.items() if name not in apart}
                        for name, writer in writers.items():
                            writer.write(key, whole if name == shard.name else apart)
                        done += 1
                    # A body that goes on in the next shard is noted where it begins.
                    if shard.name in writers and views[0] == next(packing.views_of(body)):
                        writers[shard.name].note(body.mesh, rendered.notes)
                    progress(done, total)
            for name, writer in writers.items():
                records[name] = writer.record
                record_shard(state, writer.record)
    return None, records


def digest_of(description: Mapping[str, Any]) -> str:
    """The plan of a manifest: a digest of everything that shapes the bytes."""
    return hashlib.sha256(json.dumps(description, sort_keys=True).encode()).hexdigest()


def writing_into(out: Path) -> contextlib.AbstractContextManager[None]:
    """Raise BadConfig, naming the folder of the set, for errors of the disk within the context."""
    return reported(f"cannot write shards in {out}", BadConfig, OSError)


def check_folder(out: Path) -> None:
    """Raise BadConfig unless `out` is no folder yet, one without shards, or one that a packing has begun or ended."""
    if out.exists() and not out.is_dir():
        raise BadConfig(f"shards are written into a folder, but {out} is a file")
    begun = (out / MANIFEST_NAME).exists() or (out / STATE_NAME).exists()
    if not begun and out.exists() and any(out.glob("[!.]*.tar")):
        raise BadConfig(f"{out} holds tar files that no packing wrote: choose another folder")


@contextlib.contextmanager
def claimed(out: Path, description: dict[str, Any], digest: str) -> Iterator[Path]:
    """The state folder of a packing into `out`, held against any other process for as long as the context lasts.

    Raises BadConfig if another packing is at work, or if what `out` holds was packed with other options.
    """
    check_folder(out)
    state = out / STATE_NAME
    if (out / MANIFEST_NAME).exists() and not _is_of(read_manifest(out), digest, description["shard_samples"]):
        other = "packed with other options or from other files: choose another folder, or delete it"
        raise BadConfig(f"{out} already holds a set of shards {other}")
    with held_alone(state, "packing"):
        for leftover in parts_left(out):
            leftover.unlink()  # of a run that could not even clean up
        _check_plan(state / "plan.json", description, out)
        yield state


def _is_of(manifest: Manifest, digest: str, shard_samples: int) -> bool:
    """True for the set of a plan, cut by so many samples a shard, which not every plan tells."""
    splits = ([len(shard) for shard in manifest.shards if shard.split == split] for split in SPLITS)
    return manifest.plan == digest and all(sizes[0] == min(shard_samples, sum(sizes)) for sizes in splits if sizes)


def _check_plan(path: Path, description: dict[str, Any], out: Path) -> None:
    description = json.loads(json.dumps(description))  # tuples as lists, to compare with what was stored
    if not path.exists():
        write_atomically(path, json.dumps(description, indent=1).encode())
        return
    with contextlib.suppress(BadConfig):  # a damaged plan is another
        if parse_json(path.read_bytes(), str(path)) == description:
            return
    raise BadConfig(f"{out} holds an unfinished packing of other options or files: finish it, or delete the folder")


def finished_shards(
    out: Path, state: Path, names: Sequence[str], fields: Fields = BODY_FIELDS, manifest: str = MANIFEST_NAME
) -> dict[str, ShardRecord]:
    """Records of the shards that an earlier run finished and that still have the bytes it wrote. fields: of the set.

    If `out` has a manifest and not all of its shards are intact, the set is no longer complete: the manifest must go
    before a shard is written. manifest: its name, that of a column for the column's tars.
    """
    known: dict[str, ShardRecord] = {}
    complete = (out / manifest).exists()
    if complete:
        known = {record.name: record for record in read_manifest(out, name=manifest).shards}
    else:
        for name in names:
            with contextlib.suppress(OSError, ValueError, RecursionError, BadShard):
                known[name] = record_from_json(json.loads((state / f"{name}.json").read_bytes()), fields, str(state))
    records = {name: known[name] for name in names if name in known and _intact(out / name, known[name])}
    if complete and len(records) < len(names):
        for record in records.values():
            record_shard(state, record)
    return records


def _intact(path: Path, record: ShardRecord) -> bool:
    try:
        with path.open("rb") as file:
            # Where the set's index is damaged, the samples of a shard are not known: it is made again.
            return hashlib.file_digest(file, "sha256").hexdigest() == record.sha256 and len(record.keys) == len(record)
    except (OSError, BadShard):
        return False


def record_shard(state: Path, record: ShardRecord) -> None:
    """Note that a shard is finished and in place."""
    write_atomically(state / f"{record.name}.json", json.dumps(record_to_json(record)).encode())


def forget_shard(out: Path, state: Path, names: Sequence[str]) -> None:
    """Delete the tars of a shard and their records: it is cut anew."""
    for name in names:
        (state / f"{name}.json").unlink(missing_ok=True)
        (out / name).unlink(missing_ok=True)


def stored_skips(out: Path, state: Path, checked: Sequence[str]) -> dict[str, str]:
    """Name -> reason of the meshes that an earlier run left out after the check. checked: those that the check found.

    Raises BadConfig if the state cannot be read.
    """
    if (out / MANIFEST_NAME).exists():
        return {mesh: why for mesh, why in read_manifest(out).skipped.items() if mesh not in checked}
    path = state / _SKIPPED
    if not path.exists():
        return {}
    with reported(f"{path} cannot be read: delete the folder {out} and pack again", BadConfig):
        stored = parse_json(path.read_bytes(), "it")
        table = Table(stored, "it")
        return {mesh: table.text(mesh) for mesh in stored}


def record_skips(state: Path, skipped: Mapping[str, str]) -> None:
    """Store the meshes that are left out after the check, if there are any."""
    if skipped:
        write_atomically(state / _SKIPPED, json.dumps(dict(skipped)).encode())
