"""Columns: planes or fields that a set got later, without a change of its own files.

A column is a set of its own beside the other: tars called like the set's shards, train-00000.NAME.tar, whose samples
have the same keys in the same order and hold one plane or one field; and a manifest, NAME.column.json, whose `plan` is
the digest of the set's. columns.json lists the names. docs/reference/shard_format.md describes the bytes.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final

from numpy.typing import NDArray

from bodyseg_data.core import BadSample, BadShard
from bodyseg_data.labels import UNLABELLED
from bodyseg_data.samples import Sample, check_field_name
from bodyseg_data.shards.codecs import CODECS
from bodyseg_data.shards.codecs.codec import OutputArrays
from bodyseg_data.shards.manifest import LARGEST_MANIFEST, Manifest, read_manifest
from bodyseg_data.shards.records import Descriptions, Entry, Fields, ShardRecord, location, read_checked
from bodyseg_data.shards.store import Store, store_at
from bodyseg_data.shards.tar import ShardReader, parse_members

COLUMNS_NAME: Final = "columns.json"


def column_file(name: str) -> str:
    """Name of a column's manifest."""
    return f"{name}.column.json"


def column_tar(shard: str, name: str) -> str:
    """Name of a column's tar beside a shard: "train-00000.instances.tar"."""
    return f"{shard.removesuffix('.tar')}.{name}.tar"


def column_names(store: Store) -> list[str]:
    """Names of a set's columns, as columns.json lists them; none where there is no such file. Raises BadShard."""
    try:
        data = store.read_file(COLUMNS_NAME, LARGEST_MANIFEST)
        return [check_field_name(name) for name in json.loads(data)["columns"]] if data is not None else []
    except (OSError, ValueError, RecursionError, TypeError, KeyError, BadSample) as error:
        raise BadShard(f"{store.name}/{COLUMNS_NAME} must be an object with the names of 'columns': {error}") from error


def read_column(where: Path | Store, manifest: Manifest, name: str) -> Manifest:
    """Read and check the manifest of one column of a set.

    Raises BadShard if there is none of that name, or for one that is damaged or of another set.
    """
    store, file = store_at(where), column_file(name)
    path = f"{store.name}/{file}"
    try:
        check_field_name(name)
    except BadSample as error:
        raise BadShard(str(error)) from error
    column = read_manifest(store, name=file)
    if column.plan != manifest.digest:
        raise BadShard(f"{path} is a column of another set: digest {column.plan}, here {manifest.digest}")
    if [*column.planes, *column.fields.kinds] != [name] or name in (*manifest.planes, *manifest.fields.kinds):
        raise BadShard(f"{path}: a column must be the plane or the field of its name, which the set itself has not")
    shards = [(column_tar(shard.name, name), len(shard)) for shard in manifest.shards]
    if [(shard.name, len(shard)) for shard in column.shards] != shards or column.codec != manifest.codec:
        raise BadShard(f"{path}: a column must have a tar of as many samples for each shard, in the set's codec")
    return column


def column_files(store: Store, manifest: Manifest) -> tuple[list[ShardRecord], list[str]]:
    """The tars of a set's columns, and the names of the small files that describe them. Raises as `read_column`."""
    names = column_names(store)
    tars = [tar for name in names for tar in read_column(store, manifest, name).shards]
    return tars, [*map(column_file, names), *([COLUMNS_NAME] if names else ())]


def open_columns(
    store: Store, manifest: Manifest, asked: Sequence[str], tried: Sequence[str] = ()
) -> dict[str, Manifest]:
    """Read the columns `asked` for, and of the names `tried` those that the set itself has not and that are columns.

    Raises as `read_column`.
    """
    found = {name: read_column(store, manifest, name) for name in asked}
    for name in tried:
        known = name in (*found, *manifest.planes, *manifest.fields.kinds)
        if not known and store.read_file(column_file(name), LARGEST_MANIFEST) is not None:
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
    return replace(joined, fields=fields, shards=tuple(_JoinedShard(fields, each) for each in shards))


class _JoinedShard(ShardRecord):
    """Record of a shard, read from the set's own when it is needed, with the fields of columns in its descriptions."""

    def __init__(self, fields: Fields, records: Sequence[ShardRecord]) -> None:
        own = records[0]
        head = {"name": own.name, "split": own.split, "size": own.size, "sha256": own.sha256}
        vars(self).update(head, _fields=fields, _records=records)

    def __len__(self) -> int:
        return len(vars(self)["_records"][0])

    def __reduce__(self) -> tuple[Any, ...]:
        return _JoinedShard, (vars(self)["_fields"], vars(self)["_records"])

    def __getattr__(self, name: str) -> Any:
        return getattr(vars(self)["_records"][0], name)  # columns of the index, which may not have been read yet

    def entry(self, index: int) -> Entry:
        found: Entry = vars(self)["_records"][0].entry(index)
        return found

    @cached_property
    def descriptions(self) -> Descriptions:
        described = [record.descriptions for record in vars(self)["_records"]]
        tables = tuple(table for each in described for table in each.tables)
        return Descriptions(vars(self)["_fields"], tables, tuple(rows for each in described for rows in each.rows))


class ColumnReader(ShardReader):
    """`ShardReader` whose samples have the planes and fields of columns, too."""

    def __init__(self, where: Path | Store, manifest: Manifest, columns: Mapping[str, Manifest]) -> None:
        super().__init__(where, manifest)
        self._columns = dict(columns)

    def read(
        self,
        shard: int,
        index: int,
        projector: bool = True,
        out: OutputArrays | None = None,
        unlabelled: int = UNLABELLED,
        planes: Sequence[str] | None = None,
    ) -> Sample:
        """See `ShardReader.read`."""
        sample = super().read(shard, index, projector, out, unlabelled, planes)
        for name, column in self._columns.items():
            record = column.shards[shard]
            if not column.planes:
                info = sample.info.with_fields(**record.descriptions.info(index, record.split).fields)
                vars(sample).update(info=info)
            elif planes is None or name in planes:
                try:
                    plane = decode_piece(column, sample.key, read_checked(self._store, record, index))
                except BadSample as error:
                    raise BadShard(f"{location(record, index)}: {error}") from error
                vars(sample).update(planes={**sample.planes, name: plane})
        return sample


def decode_piece(column: Manifest, key: str, data: bytes) -> NDArray[Any]:
    """Decode a sample of a column of planes. Raises BadSample, naming the key, unless it holds that plane alone."""
    ((name, kind),) = column.planes.items()
    members = parse_members(key, data)
    found = [member for member in members if member.startswith(f"plane.{name}.")]
    if len(members) != 1 or not found:
        raise BadSample(f"{key}: a column holds plane.{name} alone, found {', '.join(members) or 'nothing'}")
    try:
        plane = CODECS[column.codec].decode_plane(members[found[0]])
    except ValueError as error:
        raise BadSample(f"{key}: {found[0]}: {error}") from error
    shape = (column.rig.camera.rows, column.rig.camera.columns)
    if plane.dtype.name != kind or plane.shape != shape:
        raise BadSample(f"{key}: plane {name!r} must be {kind} {shape}, found {plane.dtype} {plane.shape}")
    return plane
