"""What a packing leaves in `OUT/.packing/` while it runs, so that it can carry on where it was cut short.

plan.json           everything that shapes the bytes; another plan may not carry on here
lock                held while a packing is at work
NAME.tar.part       the shard being written
NAME.tar.json       the record of a finished shard
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import os
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

from bodyseg_data.errors import BadConfig, BadShard
from bodyseg_data.files import write_atomically
from bodyseg_data.manifest import (
    MANIFEST_NAME,
    Manifest,
    ShardRecord,
    read_manifest,
    record_from_json,
    record_to_json,
)

STATE_NAME: Final = ".packing"


def finished_set(out: Path, digest: str) -> Manifest | None:
    if not (out / MANIFEST_NAME).exists():
        return None
    manifest = read_manifest(out)
    if manifest.plan != digest:
        raise BadConfig(f"{out} already holds a set of shards packed with other options: choose another folder")
    shutil.rmtree(out / STATE_NAME, ignore_errors=True)  # left by a packing cut after its manifest
    return manifest


@contextlib.contextmanager
def claimed(out: Path, description: dict[str, Any]) -> Iterator[Path]:
    """The state folder of a packing into `out`, held against any other process for as long as the context lasts."""
    if out.exists() and not out.is_dir():
        raise BadConfig(f"shards go into a folder, {out} is a file")
    state = out / STATE_NAME
    if not state.exists() and out.exists() and any(out.glob("*.tar")):
        raise BadConfig(f"{out} holds tars that no packing here knows of: choose another folder")
    state.mkdir(parents=True, exist_ok=True)
    lock = os.open(state / "lock", os.O_CREAT | os.O_RDWR, 0o644)
    try:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise BadConfig(f"another packing is at work in {out}") from None
        plan_file = state / "plan.json"
        if plan_file.exists():
            if json.loads(plan_file.read_bytes()) != description:
                raise BadConfig(
                    f"{out} holds an unfinished packing with other options: finish it with those, or delete the folder"
                )
        else:
            write_atomically(plan_file, json.dumps(description, indent=1).encode())
        yield state
    finally:
        os.close(lock)


def finished_shards(out: Path, state: Path, names: Sequence[str]) -> dict[str, ShardRecord]:
    """Records of the shards that an earlier run finished and that are still what it wrote."""
    records = {}
    for name in names:
        try:
            tree = json.loads((state / f"{name}.json").read_bytes())
            record = record_from_json(tree, str(state))
            with (out / name).open("rb") as file:
                intact = hashlib.file_digest(file, "sha256").hexdigest() == record.sha256
        except (OSError, ValueError, BadShard):
            continue
        if intact:
            records[name] = record
    return records


def record_shard(state: Path, record: ShardRecord) -> None:
    """Note that a shard is finished and in place."""
    write_atomically(state / f"{record.name}.json", json.dumps(record_to_json(record)).encode())
