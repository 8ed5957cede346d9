"""Records of shards: place, checksum and description of each sample, and reads that are checked against them.

Descriptions stand in the manifest as tables of bodies and views, and two numbers of rows a sample.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, fields
from itertools import chain
from typing import Any, Final, NamedTuple, Protocol

from bodyseg_data.core import BadSample, BadShard
from bodyseg_data.samples import SPLITS, SampleInfo, Split, check_key
from bodyseg_data.shards.store import READ_ATTEMPTS, Store

BODY_FIELDS: Final = ("source", "subset", "subject", "mesh", "pose")
"""Fields of `SampleInfo` in a row of the table of bodies."""

VIEW_FIELDS: Final = ("distance_cm", "azimuth_deg", "pitch_deg", "roll_deg", "height_cm")
"""Fields of `SampleInfo` in a row of the table of views."""

DESCRIPTION_FIELDS: Final = ("bodies", "views", "body", "view")
"""Fields of a shard's record that hold its `Descriptions`."""

LARGEST_VALUE: Final = 32_767
"""Largest number, without its sign, that a row of the table of views may hold."""

BLOCK: Final = 512
"""Bytes of a block of a tar; samples are whole blocks."""

LARGEST_SAMPLE: Final = 1 << 30
"""Largest size of a sample in its shard, bytes."""

LARGEST_SHARD: Final = 1 << 40
"""Largest size of a shard, bytes."""

_COLUMNS: Final = ("keys", "offsets", "lengths", "crc32")
_RECORD_FIELDS: Final = {"samples", "name", "split", "size", "sha256", "notes", *_COLUMNS, *DESCRIPTION_FIELDS}
_SHARD_NAME: Final = re.compile(r"[a-z]+-[0-9]{5}\.tar")
_SHA256: Final = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True)
class Descriptions:
    """Descriptions of a shard's samples.

    bodies: rows of `BODY_FIELDS`, views: rows of `VIEW_FIELDS`; each row once, in the order of first use. body, view:
    one entry a sample, in stored order: the number of its row.
    """

    bodies: tuple[tuple[str, ...], ...]
    views: tuple[tuple[int, ...], ...]
    body: tuple[int, ...]
    view: tuple[int, ...]

    def __repr__(self) -> str:
        return f"Descriptions({len(self.body)} samples, {len(self.bodies)} bodies, {len(self.views)} views)"

    def info(self, index: int, split: Split) -> SampleInfo:
        """Return the description of sample `index`. split: of the shard."""
        body, view = self.bodies[self.body[index]], self.views[self.view[index]]
        fields: dict[str, Any] = dict(zip((*BODY_FIELDS, *VIEW_FIELDS), (*body, *view), strict=True))
        return SampleInfo(**fields, split=split)

    def to_json(self) -> dict[str, Any]:
        """Convert to the fields of a shard's record; tables by column, so that a reader makes few lists."""
        tables = {"bodies": list(zip(*self.bodies, strict=True)), "views": list(zip(*self.views, strict=True))}
        return {**tables, "body": self.body, "view": self.view}


def describe(infos: Sequence[SampleInfo]) -> Descriptions:
    """Join the descriptions of a shard's samples, in stored order."""
    bodies: dict[tuple[str, ...], int] = {}
    views: dict[tuple[int, ...], int] = {}
    body, view = [], []
    for info in infos:
        body.append(bodies.setdefault(tuple(getattr(info, field) for field in BODY_FIELDS), len(bodies)))
        view.append(views.setdefault(tuple(getattr(info, field) for field in VIEW_FIELDS), len(views)))
    return Descriptions(tuple(bodies), tuple(views), tuple(body), tuple(view))


def descriptions_from_json(record: dict[str, Any], where: str) -> Descriptions:
    """Parse and check the descriptions in a shard's record. Raises BadShard, naming `where` and the rule."""
    bodies, views = (
        _table(record, table, width, kind, where)
        for table, width, kind in (("bodies", len(BODY_FIELDS), str), ("views", len(VIEW_FIELDS), int))
    )
    if max(map(abs, chain.from_iterable(views)), default=0) > LARGEST_VALUE:
        raise BadShard(f"{where}: 'views' must hold whole numbers of at most {LARGEST_VALUE}")
    for column, table, rows in (("body", "bodies", bodies), ("view", "views", views)):
        if list(dict.fromkeys(record[column])) != list(range(len(rows))):
            raise BadShard(
                f"{where}: {column!r} must number the rows of {table!r}, all of them, in the order of their first use"
            )
    return Descriptions(bodies, views, tuple(record["body"]), tuple(record["view"]))


def _table(record: dict[str, Any], name: str, width: int, kind: type, where: str) -> tuple[tuple[Any, ...], ...]:
    columns = record[name]
    if (
        not isinstance(columns, list)
        or set(map(type, columns)) != {list}
        or len(columns) != width
        or len(set(map(len, columns))) != 1
    ):
        raise BadShard(f"{where}: {name!r} must be {width} lists of one length")
    if set(map(type, chain.from_iterable(columns))) - {kind}:
        raise BadShard(f"{where}: {name!r} must hold {kind.__name__} only")
    table = tuple(zip(*columns, strict=True))
    if len(set(table)) < len(table):
        raise BadShard(f"{where}: {name!r} must hold each row once")
    return table


def difference(stored: SampleInfo, listed: SampleInfo) -> str | None:
    """Return one line on the first field in which a sample's own description differs from the manifest's, or None.

    Fields that the manifest does not hold are the sample's own; the split is the shard's, which its reader compares.
    """
    for field in (*BODY_FIELDS, *VIEW_FIELDS):
        own, other = getattr(stored, field), getattr(listed, field)
        if own != other:
            return f"{field!r} is {own!r}, in the manifest {other!r}"
    return None


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
        ...


@dataclass(frozen=True)
class ShardRecord:
    """Index of one shard. keys, offsets, lengths and crc32 have one entry a sample, in stored order.

    size: of the file, bytes. sha256: of the file. keys: sample keys. offsets: of a sample's first tar header, bytes.
    lengths: from there to the end of the padding of its last member, bytes. crc32: of those bytes. notes: lines
    "MESH: NOTE" on meshes whose first view is in this shard, such as repairs and changes of method. descriptions: of
    the samples.
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


def record_from_json(tree: Any, where: str) -> ShardRecord:
    """Parse and check a shard's record. Raises BadShard, naming `where` and the rule."""
    if not isinstance(tree, dict) or set(tree) != _RECORD_FIELDS:
        raise BadShard(f"{where}: a shard's record has not the fields of format 5")
    check_head(tree["name"], tree["split"], tree["sha256"], where)
    where = f"{where}: {tree['name']}"
    for column in (*_COLUMNS, "body", "view"):
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
    end = 0
    for key, offset, length in zip(tree["keys"], tree["offsets"], tree["lengths"], strict=True):
        try:
            check_key(key)
        except BadSample as error:
            raise BadShard(f"{where}: {error}") from error
        if offset != end or not 0 < length <= LARGEST_SAMPLE or length % BLOCK:
            raise BadShard(
                f"{where}: {key}: samples must follow each other in whole blocks of {BLOCK} bytes, each of at most "
                f"{LARGEST_SAMPLE}"
            )
        end = offset + length
    if end > tree["size"]:
        raise BadShard(f"{where}: samples end at byte {end}, the shard at {tree['size']}")
    return ShardRecord(
        name=tree["name"],
        split=tree["split"],
        size=tree["size"],
        sha256=tree["sha256"],
        descriptions=descriptions_from_json(tree, where),
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
