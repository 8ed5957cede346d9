"""Records of shards: place, checksum and description of each sample, and reads that are checked against them.

Descriptions stand in the manifest as tables of rows that samples share, and one number of a row a sample and table.
"""

import re
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, Final, NamedTuple, Protocol

from bodyseg_data.core import BadSample, BadShard, check_choice, reported
from bodyseg_data.samples import FIELD_KINDS, SPLITS, SampleInfo, Split, Value, check_field_name, check_key, kind_of
from bodyseg_data.shards.store import READ_ATTEMPTS, TALLY, Stage, Store

BLOCK: Final = 512
"""Bytes of a block of a tar; samples are whole blocks."""

LARGEST_SAMPLE: Final = 1 << 30
"""Largest size of a sample in its shard, bytes."""

LARGEST_SHARD: Final = 1 << 40
"""Largest size of a shard, bytes."""

MOST_TABLES: Final = 4096  # of fields, and so fields of a set; each sample has few of them

_COLUMNS: Final = ("keys", "offsets", "lengths", "crc32")
_RECORD_FIELDS: Final = {"samples", "name", "split", "size", "sha256", "notes", *_COLUMNS, "tables", "rows"}
_SHARD_NAME: Final = re.compile(r"[a-z]+-[0-9]{5,9}(?:\.[a-z][a-z0-9_]*)?\.tar")
_SHA256: Final = re.compile(r"[0-9a-f]{64}")


Row = tuple[Value | None, ...]
"""Row of a table of descriptions: a value of each of its fields, None where a sample has none."""


@dataclass(frozen=True)
class Fields:
    """The fields that descriptions of a set's samples may have.

    tables: the fields of each table, as (name, kind); kinds are those of `FIELD_KINDS`. Fields of one table change
    together, such as those of a body, or of a view; each of its rows is stored once a shard. Raises BadShard for a name
    given twice or that is none, a kind that is none, or too many fields.
    """

    tables: tuple[tuple[tuple[str, str], ...], ...] = ()

    @property
    def of_bodies(self) -> bool:
        """True where the first table is of bodies, as in sets that are packed from them."""
        return self.tables[:1] == BODY_FIELDS.tables[:1]

    def __post_init__(self) -> None:
        if len(self.kinds) != sum(map(len, self.tables)):
            raise BadShard("a field of descriptions is named once")
        if len(self.kinds) > MOST_TABLES:
            raise BadShard(f"a set has at most {MOST_TABLES} fields, found {len(self.kinds)}")
        for name, kind in self.kinds.items():
            with reported("", BadShard, BadSample):
                check_field_name(name)
            check_choice(f"the kind of field {name!r}", kind, FIELD_KINDS, BadShard)

    @cached_property
    def kinds(self) -> dict[str, str]:
        """Name -> kind of every field."""
        return {name: kind for table in self.tables for name, kind in table}

    @cached_property
    def places(self) -> dict[str, tuple[int, int]]:
        """Name -> number of the table, number of the column."""
        return {name: (at, column) for at, table in enumerate(self.tables) for column, (name, _) in enumerate(table)}

    def to_json(self) -> list[list[list[str]]]:
        """Convert to JSON: a list of tables, each a list of [name, kind]."""
        return [[[name, kind] for name, kind in table] for table in self.tables]


def fields_from_json(tree: Any, where: str) -> Fields:
    """Parse and check what `Fields.to_json` gave. Raises BadShard, naming `where`."""
    is_table = isinstance(tree, list) and all(isinstance(each, list) and each for each in tree)
    pairs = [pair for table in tree for pair in table] if is_table else [None]
    if not all(isinstance(pair, list) and list(map(type, pair)) == [str, str] for pair in pairs):
        raise BadShard(f"{where}: 'fields' must be lists of pairs, the name and the kind of a field")
    with reported(where, BadShard):
        return Fields(tuple(tuple((name, kind) for name, kind in table) for table in tree))


BODY_FIELDS: Final = Fields(
    (
        tuple((name, "text") for name in ("source", "subset", "subject", "mesh", "pose")),
        tuple((name, "int") for name in ("distance_cm", "azimuth_deg", "pitch_deg", "roll_deg", "height_cm")),
        (("things", "text"), ("hidden_pct", "int")),
    )
)
"""Fields of sets that are packed from bodies."""


@dataclass(frozen=True)
class Descriptions:
    """Descriptions of a shard's samples.

    fields: of the set. tables: rows of each of its tables, each row once, in the order of first use. rows: for each
    table one entry a sample, in stored order: the number of its row.
    """

    fields: Fields
    tables: tuple[tuple[Row, ...], ...]
    rows: tuple[tuple[int, ...], ...]

    def __repr__(self) -> str:
        return f"Descriptions({len(self.fields.kinds)} fields, {[*map(len, self.tables)]} rows)"

    def info(self, index: int, split: Split) -> SampleInfo:
        """Return the description of sample `index`. split: of the shard."""
        found: dict[str, Value] = {}
        for names, table, rows in zip(self.fields.tables, self.tables, self.rows, strict=True):
            row = table[rows[index]]
            found |= {name: value for (name, _), value in zip(names, row, strict=True) if value is not None}
        return SampleInfo(split, found)

    def to_json(self) -> dict[str, Any]:
        """Convert to the fields of a shard's record; tables by column, so that a reader makes few lists."""
        return {"tables": [list(zip(*table, strict=True)) for table in self.tables], "rows": self.rows}


def describe(infos: Sequence[SampleInfo], fields: Fields) -> Descriptions:
    """Join the descriptions of a shard's samples, in stored order.

    fields: of the set. Raises BadSample for a field that is none of them, or a value of another kind.
    """
    tables: list[dict[Row, int]] = [{} for _ in fields.tables]
    rows: list[list[int]] = [[] for _ in fields.tables]
    for info in infos:
        for name, value in info.fields.items():
            if name not in fields.kinds:
                raise BadSample(f"the set has the fields {', '.join(fields.kinds) or 'split'}, found {name!r}")
            if (kind := kind_of(value, name)) != fields.kinds[name]:
                raise BadSample(f"field {name!r} must be of the kind {fields.kinds[name]}, found {value!r}, {kind}")
        for names, table, numbers in zip(fields.tables, tables, rows, strict=True):
            row = tuple(info.fields.get(name) for name, _ in names)
            numbers.append(table.setdefault(row, len(table)))
    return Descriptions(fields, tuple(map(tuple, tables)), tuple(map(tuple, rows)))


def descriptions_from_json(record: dict[str, Any], fields: Fields, where: str) -> Descriptions:
    """Parse and check the descriptions in a shard's record. Raises BadShard, naming `where` and the rule."""
    tables, rows = record["tables"], record["rows"]
    for name, given in (("tables", tables), ("rows", rows)):
        if not isinstance(given, list) or len(given) != len(fields.tables) or set(map(type, given)) - {list}:
            raise BadShard(f"{where}: {name!r} must be {len(fields.tables)} lists")
    found = tuple(
        _table(columns, names, f"{where}: table {at}")
        for at, (columns, names) in enumerate(zip(tables, fields.tables, strict=True))
    )
    for at, (numbers, table) in enumerate(zip(rows, found, strict=True)):
        if len(numbers) != record["samples"] or set(map(type, numbers)) - {int}:
            raise BadShard(f"{where}: 'rows' must have one whole number a sample and table")
        if list(dict.fromkeys(numbers)) != list(range(len(table))):
            raise BadShard(f"{where}: 'rows' must number the rows of table {at}, all, in the order of their first use")
    return Descriptions(fields, found, tuple(map(tuple, rows)))


def _table(columns: Any, names: tuple[tuple[str, str], ...], where: str) -> tuple[Row, ...]:
    """The rows of a table that is given by columns."""
    if len(columns) != len(names) or set(map(type, columns)) != {list} or len(set(map(len, columns))) != 1:
        raise BadShard(f"{where} must be {len(names)} lists of one length")
    checked = []
    for (name, kind), column in zip(names, columns, strict=True):
        values = [tuple(value) if isinstance(value, list) else value for value in column]
        inner = (each for value in values if isinstance(value, tuple) for each in value)
        if set(map(type, values)) - {FIELD_KINDS[kind], type(None)} or {list, dict} & set(map(type, inner)):
            raise BadShard(f"{where}: {name!r} must hold {kind} or nothing")
        with reported(where, BadShard, BadSample):
            for value in set(values) - {None}:
                kind_of(value, name)
        checked.append(values)
    rows = tuple(zip(*checked, strict=True))
    if len(set(rows)) != len(rows):
        raise BadShard(f"{where} must hold each row once")
    return rows


class Entry(NamedTuple):
    """Place of a piece of a file. key: its name. offset, length: bytes. crc32: of those bytes."""

    key: str
    offset: int
    length: int
    crc32: int


class CheckedFile(Protocol):
    """A file of pieces, each with a checksum. size: bytes. sha256: of the whole file. `len()`: number of pieces."""

    @property
    def name(self) -> str: ...
    @property
    def size(self) -> int: ...
    @property
    def sha256(self) -> str: ...

    def __len__(self) -> int: ...

    def entry(self, index: int) -> Entry:
        """Place of piece `index`; pieces follow each other in the file."""


@dataclass(frozen=True)
class ShardRecord:
    """Index of one shard. keys, offsets, lengths and crc32 have one entry a sample, in stored order.

    size: of the file, bytes. sha256: of it. keys: sample keys. offsets: of a sample's first tar header, bytes. lengths:
    from there to the end of its last member's padding, bytes. crc32: of those bytes. notes: lines "MESH: NOTE" on
    meshes first seen in this shard, as of repairs and changes of method. descriptions: of the samples.
    """

    name: str
    split: Split
    size: int
    sha256: str
    keys: tuple[str, ...]
    offsets: tuple[int, ...]
    lengths: tuple[int, ...]
    crc32: tuple[int, ...]
    notes: tuple[str, ...]
    descriptions: Descriptions

    def __len__(self) -> int:
        return len(self.keys)

    def __repr__(self) -> str:
        return f"ShardRecord({self.name!r}, {len(self)} samples, {self.size} bytes)"

    def entry(self, index: int) -> Entry:
        """Place of sample `index`."""
        return Entry(self.keys[index], self.offsets[index], self.lengths[index], self.crc32[index])


def record_to_json(record: ShardRecord) -> dict[str, Any]:
    """Convert a shard's record to a JSON object."""
    plain = {field.name: getattr(record, field.name) for field in fields(record) if field.name != "descriptions"}
    return {"samples": len(record), **plain, **record.descriptions.to_json()}


def shard_name(split: Split, number: int) -> str:
    """Name of a shard by its number within the split, from 0."""
    return f"{split}-{number:05d}.tar"


def check_head(name: Any, split: Any, sha256: Any, where: str) -> None:
    """Raise BadShard, naming `where` and the rule, unless name, split and SHA-256 are those of a shard."""
    if not isinstance(name, str) or not _SHARD_NAME.fullmatch(name):
        raise BadShard(f"{where}: a shard's name must be like train-00000.tar, found {name!r}")
    where = f"{where}: {name}"
    if split not in SPLITS or not name.startswith(f"{split}-"):
        raise BadShard(f"{where}: the split must be one of {', '.join(SPLITS)} and start the name, found {split!r}")
    check_sha256(sha256, where)


def check_sha256(sha256: Any, where: str) -> None:
    """Raise BadShard, naming `where`, unless it is a SHA-256 in hexadecimal."""
    if not isinstance(sha256, str) or not _SHA256.fullmatch(sha256):
        raise BadShard(f"{where}: 'sha256' must be 64 hexadecimal digits")


def record_from_json(tree: Any, fields: Fields, where: str) -> ShardRecord:
    """Parse and check a shard's record. fields: of the set. Raises BadShard, naming `where` and the rule."""
    if not isinstance(tree, dict) or set(tree) != _RECORD_FIELDS:
        raise BadShard(f"{where}: a shard's record must have the fields {', '.join(sorted(_RECORD_FIELDS))}")
    check_head(tree["name"], tree["split"], tree["sha256"], where)
    where = f"{where}: {tree['name']}"
    for column in _COLUMNS:
        values = tree[column]
        if not isinstance(values, list) or len(values) != tree["samples"]:
            raise BadShard(f"{where}: {column!r} must have one entry a sample")
        kind = str if column == "keys" else int
        if set(map(type, values)) - {kind}:
            raise BadShard(f"{where}: {column!r} must hold {kind.__name__} only")
    notes = tree["notes"]
    if not isinstance(notes, list) or not all(isinstance(note, str) and note.isprintable() for note in notes):
        raise BadShard(f"{where}: 'notes' must be a list of text that can be printed")
    if type(tree["size"]) is not int or not 0 <= tree["size"] <= LARGEST_SHARD:
        raise BadShard(f"{where}: 'size' must be a number of bytes, at most {LARGEST_SHARD}")
    if not tree["keys"]:
        raise BadShard(f"{where}: a shard holds at least one sample")
    with reported(where, BadShard, BadSample):
        for key in tree["keys"]:
            check_key(key)
    end = 0
    for key, offset, length in zip(tree["keys"], tree["offsets"], tree["lengths"], strict=True):
        if offset != end or not 0 < length <= LARGEST_SAMPLE or length % BLOCK:
            rule = f"samples must follow each other in whole blocks of {BLOCK} bytes, each of at most {LARGEST_SAMPLE}"
            raise BadShard(f"{where}: {key}: {rule}")
        end = offset + length
    if end > tree["size"]:
        raise BadShard(f"{where}: samples end at byte {end}, the shard at {tree['size']}")
    return ShardRecord(
        name=tree["name"],
        split=tree["split"],
        size=tree["size"],
        sha256=tree["sha256"],
        descriptions=descriptions_from_json(tree, fields, where),
        **{column: tuple(tree[column]) for column in (*_COLUMNS, "notes")},
    )


def read_checked(store: Store, file: CheckedFile, index: int) -> bytes:
    """Read piece `index` of a file, again where a network may have altered it. Raises BadShard or Unreachable."""
    _, offset, length, _ = file.entry(index)
    for attempt in range(1, READ_ATTEMPTS + 1):
        try:
            data = store.read(file.name, offset, length)
        except OSError as error:
            raise BadShard(f"{location(file, index)}: cannot be read: {error.strerror or error}") from error
        TALLY.lap(Stage.STORE)
        try:
            check_bytes(data, file, index)
        except BadShard:
            if attempt == READ_ATTEMPTS or not store.prepare_reread(file.name):
                raise
        else:
            return data
    raise AssertionError("the last attempt returns or raises")


def location(file: CheckedFile, index: int) -> str:
    """Describe a piece by file, key and offset, for messages."""
    key, offset, _, _ = file.entry(index)
    return f"{file.name}: {key}: offset {offset}"


def check_bytes(data: bytes, file: CheckedFile, index: int) -> None:
    """Raise BadShard, naming file, key, offset and both checksums, unless `data` is piece `index` as it was written."""
    _, _, length, checksum = file.entry(index)
    if len(data) != length:
        raise BadShard(f"{location(file, index)}: cut short: {length} bytes expected, found {len(data)}")
    found = zlib.crc32(data)
    if found != checksum:
        raise BadShard(f"{location(file, index)}: altered: CRC-32 {checksum:08x} expected, found {found:08x}")
