"""Columns: planes or fields that a set got later, without a change of its own files.

A column is a set of its own beside the other: tars called like the set's shards, train-00000.NAME.tar, whose samples
have the same keys in the same order and hold one plane or one field; and a manifest, NAME.column.json, whose `plan` is
the digest of the set's. columns.json lists the names. docs/reference/shard_format.md describes the bytes.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from bodyseg_data.core import BadSample, BadShard
from bodyseg_data.samples import check_field_name
from bodyseg_data.shards.manifest import LARGEST_MANIFEST, Manifest, read_manifest
from bodyseg_data.shards.records import Descriptions, Fields, ShardRecord
from bodyseg_data.shards.store import Store, store_at

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
    return replace(joined, fields=fields, shards=tuple(_with_fields(fields, *each) for each in shards))


def _with_fields(fields: Fields, own: ShardRecord, *added: ShardRecord) -> ShardRecord:
    """Record of a shard with the fields of columns in its descriptions. fields: of both."""
    described = [record.descriptions for record in (own, *added)]
    tables = tuple(table for each in described for table in each.tables)
    rows = tuple(numbers for each in described for numbers in each.rows)
    kept = {name: getattr(own, name) for name in ShardRecord.__dataclass_fields__}
    return ShardRecord(**{**kept, "descriptions": Descriptions(fields, tables, rows)})
