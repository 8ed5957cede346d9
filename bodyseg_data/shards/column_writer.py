"""Writer of a column: a plane or a field for all samples of a set that is there, whose files stay as they are."""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import zlib
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from bodyseg_data.core import BadConfig, BadSample, BadShard
from bodyseg_data.files import write_atomically
from bodyseg_data.samples import Value
from bodyseg_data.shards.cache import is_same_file
from bodyseg_data.shards.codecs import CODECS
from bodyseg_data.shards.columns import (
    COLUMN_FORMAT,
    COLUMNS_NAME,
    check_column,
    column_file,
    column_names,
    column_tar,
    field_value,
)
from bodyseg_data.shards.manifest import PLANE_KINDS, compact_json, read_manifest, stamped
from bodyseg_data.shards.store import LocalFolder
from bodyseg_data.shards.tar import archive_end, sample_bytes


class ColumnWriter:
    """Writer of a further plane or field of every sample of a set, as a context manager.

        with ColumnWriter("shards", "instances", "uint16") as column:
            for key, instances in found:
                column.write(key, instances)

    folder: of the set. name: a lower-case word. kind: "uint8" or "uint16" for a plane; "text", "int", "float", "flag"
    or "numbers" for a field. The column is there when the block ends, all of it; after an error nothing is. Samples may
    come in any order; in the set's own, those of one shard are in memory at a time.

    Raises BadConfig for a name or kind that cannot be, or for a column that is there or that another process writes.
    """

    def __init__(self, folder: str | Path, name: str, kind: str) -> None:
        self._folder, self._name, self._kind = Path(folder), name, kind
        self._manifest = read_manifest(self._folder)
        try:
            check_column(self._manifest, name, kind, str(folder))
        except BadShard as error:
            raise BadConfig(str(error)) from error
        if (self._folder / column_file(name)).exists():
            raise BadConfig(f"{folder} has the column {name!r}: delete {column_file(name)} to write it anew")
        camera = self._manifest.rig.camera
        self._shape = (camera.rows, camera.columns)
        shards = self._manifest.shards
        self._places = {key: (at, index) for at, shard in enumerate(shards) for index, key in enumerate(shard.keys)}
        self._held: dict[int, dict[int, Any]] = {}
        self._done: dict[int, dict[str, Any]] = {}

    def __enter__(self) -> ColumnWriter:
        self._lock = contextlib.ExitStack()
        self._lock.enter_context(_locked(self._folder / ".columns.lock"))
        return self

    def write(self, key: str, value: Any) -> None:
        """Give a sample its plane, integers [H, W] as large as the set's images, or the value of its field.

        value: a NumPy array, a torch tensor or a plain value. Raises BadSample for a key that the set has not or that
        was written, or for a value of another kind or size.
        """
        if key not in self._places:
            raise BadSample(f"column {self._name!r}: the set has no sample {key!r}")
        shard, index = self._places[key]
        if shard in self._done or index in self._held.get(shard, {}):
            raise BadSample(f"column {self._name!r}: {key} was written before")
        is_plane = self._kind in PLANE_KINDS
        try:
            encoded = self._encoded(key, value) if is_plane else field_value(value, self._kind, self._name)
        except BadSample as error:
            raise BadSample(f"{key}: {error}") from error
        held = self._held.setdefault(shard, {})
        held[index] = encoded
        if len(held) == len(self._manifest.shards[shard]):
            parts = [held[each] for each in sorted(self._held.pop(shard))]
            name = self._manifest.shards[shard].name
            self._done[shard] = self._written(name, parts) if is_plane else _values(name, parts)

    def _encoded(self, key: str, value: Any) -> bytes:
        plane = np.asarray(value)
        kind = np.dtype(self._kind)
        if plane.dtype.kind not in "iu" or plane.shape != self._shape:
            found = f"{plane.dtype} {plane.shape}"
            raise BadSample(f"plane {self._name!r} must hold whole numbers {self._shape}, found {found}")
        if plane.min() < 0 or plane.max() > np.iinfo(kind).max:
            raise BadSample(f"plane {self._name!r} must be {kind}, found {plane.min()} to {plane.max()}")
        members = CODECS[self._manifest.codec].encode_plane(np.ascontiguousarray(plane, kind))
        return sample_bytes(key, {f"plane.{self._name}.{ending}": data for ending, data in members.items()})

    def _written(self, shard: str, parts: list[bytes]) -> dict[str, Any]:
        """Write the tar beside a shard and return its entry in the column's file."""
        end = archive_end(sum(map(len, parts)))
        sha256 = hashlib.sha256()
        for part in (*parts, end):
            sha256.update(part)
        name = column_tar(shard, self._name)
        try:
            write_atomically(self._folder / name, [*parts, end])
        except OSError as error:
            raise BadConfig(f"cannot write {self._folder / name}: {error.strerror or error}") from error
        return {
            "name": name,
            "size": sum(map(len, parts)) + len(end),
            "sha256": sha256.hexdigest(),
            "lengths": [*map(len, parts)],
            "crc32": [*map(zlib.crc32, parts)],
        }

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        whole = False
        try:
            if kind is None:
                self._finish()
                whole = True
        finally:
            for entry in () if whole or self._kind not in PLANE_KINDS else self._done.values():
                (self._folder / entry["name"]).unlink(missing_ok=True)
            self._lock.close()

    def _finish(self) -> None:
        """Write the column's file, and its name into the list. Raises BadSample if samples are missing."""
        shards = self._manifest.shards
        lacking = [
            (at, index)
            for at, shard in enumerate(shards)
            if at not in self._done
            for index in range(len(shard))
            if index not in self._held.get(at, {})
        ]
        if lacking:
            first = shards[lacking[0][0]].keys[lacking[0][1]]
            raise BadSample(
                f"column {self._name!r} must have every sample of the set: {len(lacking)} of {len(self._places)} are "
                f"missing, {first} the first"
            )
        tree = {
            "format": COLUMN_FORMAT,
            "name": self._name,
            "kind": self._kind,
            "set": self._manifest.digest,
            "shards": [self._done[at] for at in range(len(shards))],
        }
        names = sorted({*column_names(LocalFolder(self._folder)), self._name})
        try:
            write_atomically(self._folder / column_file(self._name), compact_json(stamped(tree)) + b"\n")
            write_atomically(self._folder / COLUMNS_NAME, compact_json({"columns": names}) + b"\n")
        except OSError as error:
            raise BadConfig(f"cannot write {self._folder}: {error.strerror or error}") from error


def _values(shard: str, values: list[Value]) -> dict[str, Any]:
    return {"name": shard, "values": values}


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Hold a lock file while columns are written. Raises BadConfig if another process holds it."""
    try:
        handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    except OSError as error:
        raise BadConfig(f"cannot write {path.parent}: {error.strerror or error}") from error
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if not is_same_file(handle, path):
            raise BlockingIOError
    except BlockingIOError:
        os.close(handle)
        raise BadConfig(f"{path.parent}: another process writes a column of this set") from None
    try:
        yield
    finally:
        path.unlink(missing_ok=True)
        os.close(handle)
