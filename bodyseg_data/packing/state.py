"""The state of a packing in `OUT/.packing/` while it runs, so that it can carry on where it was cut short.

plan.json           everything that shapes the bytes; another plan may not carry on here
lock                held while a packing is at work
NAME.tar.part       the shard being written
NAME.tar.json       the record of a finished shard
skipped.json        meshes left out after the check: name -> reason
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from bodyseg_data.core.errors import BadConfig, BadShard
from bodyseg_data.core.files import write_atomically
from bodyseg_data.shards.manifest import MANIFEST_NAME, read_manifest
from bodyseg_data.shards.records import ShardRecord, record_from_json, record_to_json

STATE_NAME: Final = ".packing"
_SKIPPED: Final = "skipped.json"


def check_folder(out: Path) -> None:
    """Raise BadConfig unless `out` is no folder yet, one without shards, or one that a packing has begun or ended."""
    if out.exists() and not out.is_dir():
        raise BadConfig(f"shards go into a folder, {out} is a file")
    begun = (out / MANIFEST_NAME).exists() or (out / STATE_NAME).exists()
    if not begun and out.exists() and any(out.glob("*.tar")):
        raise BadConfig(f"{out} holds tars of no packing: choose another folder")


@contextlib.contextmanager
def claimed(out: Path, description: dict[str, Any], digest: str) -> Iterator[Path]:
    """The state folder of a packing into `out`, held against any other process for as long as the context lasts.

    Raises BadConfig if another packing is at work, or if what `out` holds was packed with other options.
    """
    check_folder(out)
    state = out / STATE_NAME
    if (out / MANIFEST_NAME).exists() and read_manifest(out).plan != digest:
        raise BadConfig(
            f"{out} already holds a set of shards packed with other options or from other files: "
            "choose another folder, or delete it"
        )
    state.mkdir(parents=True, exist_ok=True)
    lock = os.open(state / "lock", os.O_CREAT | os.O_RDWR, 0o644)
    try:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise BadConfig(f"another packing is at work in {out}") from None
        _check_plan(state / "plan.json", description, out)
        yield state
    finally:
        os.close(lock)


def _check_plan(path: Path, description: dict[str, Any], out: Path) -> None:
    try:
        stored = json.loads(path.read_bytes())
    except FileNotFoundError:
        write_atomically(path, json.dumps(description, indent=1).encode())
        return
    except (ValueError, RecursionError):
        stored = None
    if stored != description:
        raise BadConfig(
            f"{out} holds an unfinished packing with other options or of other files: "
            "finish it with those, or delete the folder"
        )


def finished_shards(out: Path, state: Path, names: Sequence[str]) -> dict[str, ShardRecord]:
    """Records of the shards that an earlier run finished and that still have the bytes it wrote.

    If `out` has a manifest and not all of its shards are intact, the manifest goes: the set is no longer complete.
    """
    known: dict[str, ShardRecord] = {}
    complete = (out / MANIFEST_NAME).exists()
    if complete:
        known = {record.name: record for record in read_manifest(out).shards}
    else:
        for name in names:
            with contextlib.suppress(OSError, ValueError, RecursionError, BadShard):
                known[name] = record_from_json(json.loads((state / f"{name}.json").read_bytes()), str(state))
    records = {name: known[name] for name in names if name in known and _intact(out / name, known[name])}
    if complete and len(records) < len(names):
        for record in records.values():
            record_shard(state, record)
        (out / MANIFEST_NAME).unlink()
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


def forget_shard(out: Path, state: Path, name: str) -> None:
    """Delete a shard and its record: it is cut anew."""
    (state / f"{name}.json").unlink(missing_ok=True)
    (out / name).unlink(missing_ok=True)


def stored_skips(out: Path, state: Path, checked: Sequence[str]) -> dict[str, str]:
    """Name -> reason of the meshes that an earlier run left out after the check. checked: those that the check found.

    Raises BadConfig if the state cannot be read.
    """
    if (out / MANIFEST_NAME).exists():
        skipped = {each.mesh: each.why for each in read_manifest(out).skipped}
        return {mesh: why for mesh, why in skipped.items() if mesh not in checked}
    try:
        stored = json.loads((state / _SKIPPED).read_bytes())
    except FileNotFoundError:
        return {}
    except (ValueError, RecursionError):
        stored = None
    if not isinstance(stored, dict) or not all(isinstance(why, str) for why in stored.values()):
        raise BadConfig(f"{state / _SKIPPED} cannot be read: delete the folder {out} and pack again")
    return stored


def record_skips(state: Path, skipped: Mapping[str, str]) -> None:
    """Store the meshes that are left out after the check, if there are any."""
    if skipped:
        write_atomically(state / _SKIPPED, json.dumps(dict(skipped)).encode())
