"""Columns: planes or fields that a set got later, without a change of its own files; and their writer.

A column is a set of its own beside the other: tars called like the set's shards, train-00000.NAME.tar, whose samples
have the same keys in the same order and hold one plane or one field; and a manifest, NAME.column.json, whose `plan` is
the digest of the set's. columns.json lists the names. docs/reference/shard_format.md describes the bytes.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from bodyseg_data.core import BadConfig, BadSample, BadShard, reported
from bodyseg_data.files import claimed, write_atomically
from bodyseg_data.samples import MOST_FIELDS, SampleInfo, as_array, check_field_name, check_key, kind_of, plain_value
from bodyseg_data.shards.codecs import CODECS
from bodyseg_data.shards.manifest import (
    LARGEST_MANIFEST,
    PLANE_KINDS,
    Manifest,
    check_plane,
    manifest_bytes,
    read_manifest,
)
from bodyseg_data.shards.records import Descriptions, Fields, ShardRecord
from bodyseg_data.shards.remote import read_optional
from bodyseg_data.shards.store import LocalFolder, Store, store_at
from bodyseg_data.shards.tar import TarWriter

COLUMNS_NAME: Final = "columns.json"


def column_file(name: str | None = None) -> str:
    """Name of a column's manifest; without a name, that of the list of columns."""
    return COLUMNS_NAME if name is None else f"{name}.column.json"


def column_tar(shard: str, name: str) -> str:
    """Name of a column's tar beside a shard: "train-00000.instances.tar"."""
    return f"{shard.removesuffix('.tar')}.{name}.tar"


def column_names(store: Store) -> list[str]:
    """Names of a set's columns, as columns.json lists them; none where there is no such file. Raises BadShard."""
    what = f"{store.name}/{COLUMNS_NAME} must be an object with the names of 'columns'"
    with reported(what, BadShard, OSError, ValueError, RecursionError, TypeError, KeyError, BadSample):
        data = read_optional(store, COLUMNS_NAME, LARGEST_MANIFEST)
        return [check_field_name(name) for name in json.loads(data)["columns"]] if data is not None else []


def read_column(
    where: Path | Store, manifest: Manifest, name: str, keep: Callable[[bytes], object] | None = None
) -> Manifest:
    """Read and check the manifest of one column of a set. keep: as of `read_manifest`.

    Raises BadShard if there is none of that name, or for one that is damaged or of another set.
    """
    store, file = store_at(where), column_file(name)
    path = f"{store.name}/{file}"
    with reported("", BadShard, BadSample):
        check_field_name(name)
    column = read_manifest(store, keep, file)
    if column.plan != manifest.digest:
        raise BadShard(f"{path} is a column of another set: digest {column.plan}, here {manifest.digest}")
    if [*column.planes, *column.fields.kinds] != [name] or name in (*manifest.planes, *manifest.fields.kinds):
        raise BadShard(f"{path}: a column must be the plane or the field of its name, which the set itself has not")
    shards = [(column_tar(shard.name, name), len(shard)) for shard in manifest.shards]
    if [(shard.name, len(shard)) for shard in column.shards] != shards or column.codec != manifest.codec:
        raise BadShard(f"{path}: a column must have a tar of as many samples for each shard, in the set's codec")
    return column


def _list_of(names: Sequence[str]) -> bytes:
    return json.dumps({"columns": names}).encode() + b"\n"


def column_files(store: Store, manifest: Manifest) -> tuple[list[ShardRecord], dict[str, bytes]]:
    """Tars of a set's columns, and the small files that describe them, name -> content. Raises as `read_column`."""
    names, pages, tars = column_names(store), dict[str, bytes](), list[ShardRecord]()
    for name in names:
        tars += read_column(store, manifest, name, partial(pages.__setitem__, column_file(name))).shards
    return tars, {**pages, COLUMNS_NAME: _list_of(names)} if names else {}


def open_columns(store: Store, manifest: Manifest, asked: Sequence[str], tried: Sequence[str]) -> dict[str, Manifest]:
    """Read the columns `asked` for, and of the names `tried` those that the set itself has not and that are columns.

    Raises as `read_column`.
    """
    found = {name: read_column(store, manifest, name) for name in asked}
    for name in tried:
        known = name in (*found, *manifest.planes, *manifest.fields.kinds)
        if not known and read_optional(store, column_file(name), LARGEST_MANIFEST) is not None:
            found[name] = read_column(store, manifest, name)
    return found


def with_columns(manifest: Manifest, columns: Mapping[str, Manifest]) -> Manifest:
    """The manifest of a set with what columns add to its planes, its fields and the descriptions of its samples."""
    planes = {name: kind for column in columns.values() for name, kind in column.planes.items()}
    joined = replace(manifest, planes={**manifest.planes, **planes})
    added = [column for column in columns.values() if not column.planes]
    if not added:
        return joined
    fields = Fields((*manifest.fields.tables, *(table for column in added for table in column.fields.tables)))
    shards = zip(manifest.shards, *(column.shards for column in added), strict=True)
    return replace(joined, fields=fields, shards=tuple(_with_fields(fields, *each) for each in shards))


def _with_fields(fields: Fields, own: ShardRecord, *added: ShardRecord) -> ShardRecord:
    """Record of a shard with the fields of columns in its descriptions. fields: those of set and columns."""
    described = [record.descriptions for record in (own, *added)]
    tables = tuple(table for each in described for table in each.tables)
    rows = tuple(numbers for each in described for numbers in each.rows)
    kept = {name: getattr(own, name) for name in ShardRecord.__dataclass_fields__}
    return ShardRecord(**{**kept, "descriptions": Descriptions(fields, tables, rows)})


class ColumnWriter:
    """Writer of a further plane or field of every sample of a set, as a context manager.

        with ColumnWriter("shards", "instances", "uint16") as column:
            for key, instances in found:
                column.write(key, instances)

    folder: of the set. name: a lower-case word. kind: "uint8" or "uint16" for a plane; "text", "int", "float", "flag"
    or "numbers" for a field. The column is there, whole, when the block ends; after an error there is none. Samples may
    come in any order; in the set's own order, only those of one shard are in memory at a time.

    Raises BadConfig for a name or kind that cannot be, or for a column that is there already.
    """

    def __init__(self, folder: str | Path, name: str, kind: str) -> None:
        self._folder, self._name, self._kind = Path(folder), name, kind
        self._is_plane = kind in PLANE_KINDS
        self._claim: contextlib.ExitStack | None = None
        with reported(f"a column is of the kind {' or '.join(PLANE_KINDS)}, or a field", BadConfig, BadShard):
            self._fields = Fields(() if self._is_plane else (((name, kind),),))
            if self._is_plane:
                check_plane(name, kind, str(folder))
        self._begin()

    def __enter__(self) -> ColumnWriter:
        with contextlib.ExitStack() as claim:
            claim.enter_context(claimed(self._folder, "ColumnWriter"))
            self._begin()  # again: this or another writer may have written it since
            self._claim = claim.pop_all()
        return self

    def _begin(self) -> None:
        """Begin the column anew. Raises BadConfig if it is there."""
        self._set = read_manifest(self._folder)
        name, shards = self._name, self._set.shards
        if name in (*self._set.planes, *self._set.fields.kinds):
            raise BadConfig(f"{self._folder}: the set itself has {name!r} already")
        Fields((*self._set.fields.tables, *self._fields.tables))  # raises BadShard where the set then had too many
        beside = column_names(LocalFolder(self._folder))  # not yet where a writer was killed before its end
        if name in beside and (self._folder / column_file(name)).exists():
            raise BadConfig(f"{self._folder} has the column {name!r}: delete {column_file(name)} to write it anew")
        self._counted = [name]  # fields of columns that count where samples may come to have too many
        if len(self._set.fields.kinds) + len(beside) >= MOST_FIELDS:
            columns = (read_column(self._folder, self._set, each) for each in beside if each != name)
            self._counted += [each for column in columns for each in column.fields.kinds]
        self._places = {key: (at, index) for at, shard in enumerate(shards) for index, key in enumerate(shard.keys)}
        self._held: list[dict[int, dict[str, bytes]]] = [{} for _ in shards]
        self._records: dict[int, ShardRecord] = {}

    def write(self, key: str, value: Any) -> None:
        """Give a sample its plane, integers [H, W] as large as the set's images, or the value of its field.

        value: a NumPy array, a torch tensor or a plain value. Raises BadSample for a key that the set does not have or
        that was written before, or for a value of another kind or size; BadConfig if the disk cannot be written.
        """
        if self._claim is None:
            raise BadConfig("a ColumnWriter writes in a with statement: with ColumnWriter(...) as column")
        if key not in self._places:
            raise BadSample(f"column {self._name!r}: the set has no sample {key!r}")
        check_key(key, (self._name,) if self._is_plane else ())
        at, index = self._places[key]
        shard, held = self._set.shards[at], self._held[at]
        if at in self._records or index in held:
            raise BadSample(f"column {self._name!r}: {key} was written before")
        with reported(key, BadSample):
            held[index] = self._plane(value) if self._is_plane else self._field(value, shard, index)
        if len(held) < len(shard):
            return
        path = self._folder / column_tar(shard.name, self._name)
        writer = TarWriter(path, path.with_name(f".{path.name}.part"), shard.split, self._fields)
        with reported(f"cannot write {path}", BadConfig, OSError), writer as tar:
            for number, each in enumerate(shard.keys):
                tar.write(each, held.pop(number))
        self._records[at] = tar.record

    def _plane(self, value: Any) -> dict[str, bytes]:
        plane, kind = as_array(value, f"plane {self._name!r}"), np.dtype(self._kind)
        shape = (self._set.rig.camera.rows, self._set.rig.camera.columns)
        if plane.dtype.kind not in "iu" or plane.shape != shape:
            raise BadSample(f"plane {self._name!r} must hold whole numbers {shape}, found {plane.dtype} {plane.shape}")
        if plane.min() < 0 or plane.max() > np.iinfo(kind).max:
            raise BadSample(f"plane {self._name!r} must be {kind}, found {plane.min()} to {plane.max()}")
        members = CODECS[self._set.codec].encode_plane(np.ascontiguousarray(plane, kind))
        return {f"plane.{self._name}.{ending}": data for ending, data in members.items()}

    def _field(self, value: Any, shard: ShardRecord, index: int) -> dict[str, bytes]:
        value = plain_value(value)
        value = float(value) if self._kind == "float" and type(value) is int else value
        if kind_of(value, self._name) != self._kind:
            raise BadSample(f"field {self._name!r} must be of the kind {self._kind}, found {value!r}")
        if len(self._set.fields.kinds) + len(self._counted) > MOST_FIELDS:  # to look them up takes milliseconds
            shard.descriptions.info(index, shard.split).with_fields(**dict.fromkeys(self._counted, 0))
        return {"json": json.dumps(SampleInfo(shard.split, {self._name: value}).to_json(), sort_keys=True).encode()}

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        with self._claim or contextlib.ExitStack():
            self._claim = None
            try:
                if kind is None:
                    self._finish()
                    self._records = {}
            finally:
                if self._records:
                    (self._folder / column_file(self._name)).unlink(missing_ok=True)
                for record in self._records.values():
                    (self._folder / record.name).unlink(missing_ok=True)

    def _finish(self) -> None:
        """Write the column's manifest, and its name into the list. Raises BadSample if samples are missing."""
        lacking = [
            key for key, (at, index) in self._places.items() if at not in self._records and index not in self._held[at]
        ]
        if lacking:
            missing = f"{len(lacking)} of {len(self._places)} are missing, {lacking[0]} the first"
            raise BadSample(f"column {self._name!r} must have every sample of the set: {missing}")
        planes = {self._name: self._kind} if self._is_plane else {}
        records = [self._records[at] for at in range(len(self._records))]
        with reported(f"cannot write {self._folder}", BadConfig, OSError):
            write_column_manifest(self._folder, self._set, self._name, records, planes, self._fields)


def write_column_manifest(
    folder: Path,
    manifest: Manifest,
    name: str,
    records: Sequence[ShardRecord],
    planes: Mapping[str, str],
    fields: Fields,
    source: str = "column",
) -> None:
    """Write the manifest of a column whose tars are written, and its name into the list of columns.

    manifest: of the set. records: of the tars, in the order of its shards. planes, fields: what they hold. source: what
    wrote them.
    """
    column = replace(
        manifest,
        rigs=(manifest.rig,),
        source=source,
        renderer="",
        plan=manifest.digest,
        shards=tuple(records),
        skipped={},
        fields=fields,
        projector="none",
        planes=planes,
    )
    names = sorted({*column_names(LocalFolder(folder)), name})
    write_atomically(folder / column_file(name), manifest_bytes(column))
    write_atomically(folder / COLUMNS_NAME, _list_of(names))
