"""Columns: planes or fields that a set got later, without a change of its own files.

NAME.column.json names the set by its digest, and has the values of a field, or the checksums of a plane's tars, one
beside each shard: train-00000.NAME.tar holds the planes of the samples of train-00000.tar, under the same keys.
columns.json lists the names, since addresses cannot be listed. docs/reference/shard_format.md describes the bytes.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig, BadSample, BadShard
from bodyseg_data.labels import UNLABELLED
from bodyseg_data.samples import FIELD_KINDS, Sample, Value, check_field_name, kind_of
from bodyseg_data.shards.codecs import CODECS
from bodyseg_data.shards.codecs.codec import OutputArrays
from bodyseg_data.shards.manifest import LARGEST_MANIFEST, PLANE_KINDS, Manifest, check_plane, stamped_from
from bodyseg_data.shards.records import (
    BLOCK,
    LARGEST_SAMPLE,
    LARGEST_SHARD,
    CheckedFile,
    Descriptions,
    Entry,
    Fields,
    ShardRecord,
    check_sha256,
    location,
    read_checked,
)
from bodyseg_data.shards.store import Store, store_at
from bodyseg_data.shards.tar import ShardReader, parse_members

COLUMN_FORMAT: Final = "bodyseg column 1"
COLUMNS_NAME: Final = "columns.json"

_FIELDS: Final = {"format", "name", "kind", "set", "shards", "digest"}
_TAR_FIELDS: Final = {"name", "size", "sha256", "lengths", "crc32"}


@dataclass(frozen=True)
class ColumnTar:
    """A plane's tar beside a shard, with one entry a sample, in the shard's order; a `CheckedFile`.

    size: bytes. lengths: bytes of each sample, headers and padding included. crc32: of those bytes. shard: whose keys
    its samples have.
    """

    name: str
    size: int
    sha256: str
    lengths: tuple[int, ...]
    crc32: tuple[int, ...]
    shard: ShardRecord

    def __len__(self) -> int:
        return len(self.lengths)

    def entry(self, index: int) -> Entry:
        """Place of sample `index`."""
        length = self.lengths[index]
        return Entry(self.shard.entry(index).key, self._ends[index] - length, length, self.crc32[index])

    @cached_property
    def _ends(self) -> tuple[int, ...]:
        return tuple(accumulate(self.lengths))


@dataclass(frozen=True)
class Column:
    """A plane or a field of all samples of a set, kept beside it.

    kind: "uint8" or "uint16" of a plane, else one of `FIELD_KINDS`. of: digest of the set's manifest. tars: of a plane,
    one a shard. values: of a field, for each shard one a sample. codec: of the planes, that of the set. shape: rows and
    columns of a plane. digest: of the column's own file.
    """

    name: str
    kind: str
    of: str
    tars: tuple[ColumnTar, ...]
    values: tuple[tuple[Value, ...], ...]
    codec: str
    shape: tuple[int, int]
    digest: str

    @property
    def is_plane(self) -> bool:
        """True for images, False for values of a field."""
        return self.kind in PLANE_KINDS

    def read(self, store: Store, shard: int, index: int) -> NDArray[Any]:
        """Read the plane of sample `index` of shard number `shard`. Raises BadShard or Unreachable."""
        tar = self.tars[shard]
        data = read_checked(store, tar, index)
        try:
            return self.decoded(shard, index, data)
        except BadSample as error:
            raise BadShard(f"{location(tar, index)}: {error}") from error

    def decoded(self, shard: int, index: int, data: bytes) -> NDArray[Any]:
        """Decode the bytes of a sample in a tar. Raises BadSample unless they hold its plane alone."""
        key = self.tars[shard].entry(index).key
        members = parse_members(key, data)
        found = [name for name in members if name.startswith(f"plane.{self.name}.")]
        if len(members) != 1 or not found:
            raise BadSample(f"{key}: a column holds plane.{self.name} alone, found {', '.join(members) or 'nothing'}")
        try:
            plane = CODECS[self.codec].decode_plane(members[found[0]])
        except ValueError as error:
            raise BadSample(f"{key}: {found[0]}: {error}") from error
        if plane.dtype.name != self.kind or plane.shape != self.shape:
            expected = f"{self.kind} {self.shape}"
            raise BadSample(f"{key}: plane {self.name!r} must be {expected}, found {plane.dtype} {plane.shape}")
        return plane


def column_file(name: str) -> str:
    """Name of a column's own file."""
    return f"{name}.column.json"


def column_tar(shard: str, name: str) -> str:
    """Name of a column's tar beside a shard: "train-00000.instances.tar"."""
    return f"{shard.removesuffix('.tar')}.{name}.tar"


def check_column(manifest: Manifest, name: Any, kind: Any, where: str) -> None:
    """Raise BadShard, naming `where`, unless a set can get a column of this name and kind."""
    if kind not in (*PLANE_KINDS, *FIELD_KINDS):
        known = f"{', '.join(PLANE_KINDS)} for a plane, or {', '.join(FIELD_KINDS)} for a field"
        raise BadShard(f"{where}: the kind of a column must be {known}, found {kind!r}")
    if kind in PLANE_KINDS:
        check_plane(name, kind, where)
    try:
        check_field_name(name)
    except BadSample as error:
        raise BadShard(f"{where}: {error}") from error
    if name in manifest.planes or name in manifest.fields.kinds:
        raise BadShard(f"{where}: the set itself has {name!r} already")


def column_names(store: Store) -> list[str]:
    """Names of a set's columns, as columns.json lists them; none where there is no such file. Raises BadShard."""
    path = f"{store.name}/{COLUMNS_NAME}"
    data = _contents(store, COLUMNS_NAME)
    if data is None:
        return []
    try:
        names = json.loads(data)["columns"]
        for name in names:
            check_field_name(name)
    except (ValueError, RecursionError, TypeError, KeyError, BadSample) as error:
        raise BadShard(f"{path} must be an object with the names of 'columns': {error}") from error
    return list(names)


def column_files(store: Store, manifest: Manifest) -> tuple[list[CheckedFile], list[str]]:
    """The tars of a set's columns, and the names of the small files that describe them. Raises as `read_column`."""
    names = column_names(store)
    tars: list[CheckedFile] = [tar for name in names for tar in read_column(store, manifest, name).tars]
    return tars, [*map(column_file, names), *([COLUMNS_NAME] if names else ())]


def read_column(where: Path | Store, manifest: Manifest, name: str) -> Column:
    """Read and check one column of a set, but for its tars.

    Raises BadConfig if there is none of that name, BadShard for a file that is damaged or of another set.
    """
    store = store_at(where)
    path = f"{store.name}/{column_file(name)}"
    data = _contents(store, column_file(name)) if re.fullmatch(r"\w+", name) else None
    if data is None:
        raise BadConfig(f"{store.name} has no column {name!r}: there is no {column_file(name)}")
    tree = stamped_from(data, path, [COLUMN_FORMAT])
    if set(tree) != _FIELDS or tree["name"] != name or not isinstance(tree["shards"], list):
        raise BadShard(f"{path}: a column has the fields {sorted(_FIELDS)} and the name of its file")
    if tree["set"] != manifest.digest:
        raise BadShard(f"{path} is a column of another set: digest {tree['set']}, here {manifest.digest}")
    check_column(manifest, name, tree["kind"], path)
    if len(tree["shards"]) != len(manifest.shards):
        raise BadShard(f"{path}: the set has {len(manifest.shards)} shards, the column {len(tree['shards'])}")
    is_plane = tree["kind"] in PLANE_KINDS
    pairs = list(zip(tree["shards"], manifest.shards, strict=True))
    return Column(
        name=name,
        kind=tree["kind"],
        of=tree["set"],
        tars=tuple(_tar(each, shard, name, path) for each, shard in pairs) if is_plane else (),
        values=() if is_plane else tuple(_values(each, shard, name, tree["kind"], path) for each, shard in pairs),
        codec=manifest.codec,
        shape=(manifest.rig.camera.rows, manifest.rig.camera.columns),
        digest=tree["digest"],
    )


def open_columns(store: Store, manifest: Manifest, asked: Sequence[str], tried: Sequence[str] = ()) -> list[Column]:
    """Read the columns `asked` for, and of the names `tried` those that the set itself has not and that are columns.

    Raises as `read_column`.
    """
    names = list(dict.fromkeys(asked))
    for name in dict.fromkeys(tried):
        known = name in names or name in manifest.planes or name in manifest.fields.kinds
        if not known and _contents(store, column_file(name)) is not None:
            names.append(name)
    return [read_column(store, manifest, name) for name in names]


def _contents(store: Store, name: str) -> bytes | None:
    try:
        return store.read_file(name, LARGEST_MANIFEST)
    except OSError as error:
        raise BadShard(f"{store.name}/{name} cannot be read: {error}") from error


def _tar(tree: Any, shard: ShardRecord, name: str, path: str) -> ColumnTar:
    where = f"{path}: {column_tar(shard.name, name)}"
    if not isinstance(tree, dict) or set(tree) != _TAR_FIELDS or tree["name"] != column_tar(shard.name, name):
        raise BadShard(f"{where}: a column's tar must have the fields {sorted(_TAR_FIELDS)} and be called so")
    check_sha256(tree["sha256"], where)
    for field, greatest in (("lengths", LARGEST_SAMPLE), ("crc32", (1 << 32) - 1)):
        column = tree[field]
        if not isinstance(column, list) or len(column) != len(shard) or set(map(type, column)) - {int}:
            raise BadShard(f"{where}: {field!r} must have one whole number a sample")
        if not 0 <= min(column) <= max(column) <= greatest:
            raise BadShard(f"{where}: {field!r} must be 0 to {greatest}")
    if any(not length or length % BLOCK for length in tree["lengths"]):
        raise BadShard(f"{where}: samples must take whole blocks of {BLOCK} bytes, at least one")
    if type(tree["size"]) is not int or not sum(tree["lengths"]) <= tree["size"] <= LARGEST_SHARD:
        raise BadShard(f"{where}: 'size' must be a number of bytes that holds its samples, found {tree['size']!r}")
    lengths, crc32 = tuple(tree["lengths"]), tuple(tree["crc32"])
    return ColumnTar(tree["name"], tree["size"], tree["sha256"], lengths, crc32, shard)


def _values(tree: Any, shard: ShardRecord, name: str, kind: str, path: str) -> tuple[Value, ...]:
    where = f"{path}: {shard.name}"
    values = tree.get("values") if isinstance(tree, dict) else None
    if not isinstance(values, list) or set(tree) != {"name", "values"} or tree["name"] != shard.name:
        raise BadShard(f"{where}: the values of a shard must have its 'name' and a list of 'values'")
    found = tuple(tuple(value) if isinstance(value, list) else value for value in values)
    try:
        fits = len(found) == len(shard) and {kind_of(value, name) for value in found} == {kind}
    except BadSample as error:
        raise BadShard(f"{where}: {error}") from error
    if not fits:
        raise BadShard(f"{where}: 'values' must have one value of the kind {kind} a sample")
    return found


def with_columns(manifest: Manifest, columns: Sequence[Column]) -> Manifest:
    """The manifest of a set with what columns add to its planes, its fields and the descriptions of its samples."""
    planes = {column.name: column.kind for column in columns if column.is_plane}
    fields = [column for column in columns if not column.is_plane]
    joined = replace(manifest, planes={**manifest.planes, **planes})
    if not fields:
        return joined
    tables = tuple(((column.name, column.kind),) for column in fields)
    shards = tuple(
        _JoinedShard(shard, {(column.name, column.kind): column.values[at] for column in fields})
        for at, shard in enumerate(manifest.shards)
    )
    return replace(joined, fields=Fields((*manifest.fields.tables, *tables)), shards=shards)


class _JoinedShard(ShardRecord):
    """Record of a shard, read from the set's own when it is needed, with further fields in its descriptions."""

    _own: ShardRecord
    _added: Mapping[tuple[str, str], tuple[Value, ...]]

    def __init__(self, own: ShardRecord, added: Mapping[tuple[str, str], tuple[Value, ...]]) -> None:
        head = {name: getattr(own, name) for name in ("name", "split", "size", "sha256")}
        vars(self).update(head, _own=own, _added=added)

    def __len__(self) -> int:
        return len(self._own)

    def __reduce__(self) -> tuple[Any, ...]:
        return _JoinedShard, (self._own, self._added)

    def __getattr__(self, name: str) -> Any:
        return getattr(vars(self)["_own"], name)  # columns of the index, which may not have been read yet

    def entry(self, index: int) -> Entry:
        return self._own.entry(index)

    @cached_property
    def descriptions(self) -> Descriptions:
        own = self._own.descriptions
        tables, rows = list(own.tables), list(own.rows)
        for values in self._added.values():
            numbers = {value: number for number, value in enumerate(dict.fromkeys(values))}
            tables.append(tuple((value,) for value in numbers))
            rows.append(tuple(numbers[value] for value in values))
        fields = Fields((*own.fields.tables, *((pair,) for pair in self._added)))
        return Descriptions(fields, tuple(tables), tuple(rows))


class ColumnReader(ShardReader):
    """`ShardReader` whose samples have the planes and fields of columns, too."""

    def __init__(self, where: Path | Store, manifest: Manifest, columns: Sequence[Column]) -> None:
        super().__init__(where, manifest)
        self._columns = tuple(columns)

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
        wanted = [each for each in self._columns if each.is_plane and (planes is None or each.name in planes)]
        fields = {each.name: each.values[shard][index] for each in self._columns if not each.is_plane}
        if wanted:
            read = {column.name: column.read(self._store, shard, index) for column in wanted}
            vars(sample).update(planes={**sample.planes, **read})
        if fields:
            vars(sample).update(info=sample.info.with_fields(**fields))
        return sample


def field_value(value: Any, kind: str, name: str) -> Value:
    """The value of a field as files hold it, from Python's, NumPy's or torch's. Raises BadSample, naming the field."""
    value = value.tolist() if isinstance(value, np.generic | np.ndarray) or hasattr(value, "detach") else value
    if kind == "numbers" and isinstance(value, list | tuple):
        value = tuple(float(each) if type(each) is int else each for each in value)
    value = float(value) if kind == "float" and type(value) is int else value
    if kind_of(value, name) != kind:
        raise BadSample(f"field {name!r} must be of the kind {kind}, found {value!r}")
    checked: Value = value
    return checked
