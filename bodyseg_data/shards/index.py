"""The index of a large set: a file of one piece a shard, each read when it is needed.

So opening a set, and the memory of a process that reads it, take the same for any number of samples but for a short
line a shard. A piece is a shard's record as a few columns of numbers, from which one sample is found at once. The
manifest names size and hash of the file and the checksum of every piece, and is written after it.
docs/reference/shard_format.md describes the bytes.
"""

from __future__ import annotations

import hashlib
import json
import struct
import zlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate
from pathlib import Path
from typing import Any, Final, overload

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadSample, BadShard, reported
from bodyseg_data.files import write_atomically
from bodyseg_data.samples import Split, check_key
from bodyseg_data.shards.earlier import EARLIER_FIELDS, piece_as_current
from bodyseg_data.shards.records import (
    BLOCK,
    LARGEST_SAMPLE,
    LARGEST_SHARD,
    MOST_TABLES,
    Entry,
    Fields,
    ShardRecord,
    check_head,
    check_sha256,
    location,
    read_checked,
    record_from_json,
)
from bodyseg_data.shards.store import Store

LARGEST_PIECE: Final = 1 << 26
"""Largest piece, bytes."""

_HEADER: Final = struct.Struct("<3I")
"""Numbers of samples and tables; bytes of the text. Each table's number of rows follows."""

_TEXT_FIELDS: Final = {"tables", "stems", "tails", "notes"}
_VIEW_MARK: Final = "-d"
"""In keys of samples of bodies, begins the part that names the view. Their table 0 is of bodies, table 1 of views."""

_KINDS: Final = tuple(map(np.dtype, ("u1", "<u2", "<u4")))

INDEX_NAME: Final = "samples.index"

HELD_PIECES: Final = 512
"""Pieces that a process holds, those read last: 13 kB each where shards have 1080 samples."""

FETCHED_PIECES: Final = 64
"""Pieces that a reader of a remote set fetches one by one before it fetches the whole file."""

_TEXTS: Final = ("name", "split", "sha256")

_NUMBERS: Final = {
    "samples": (1, LARGEST_PIECE),
    "size": (0, LARGEST_SHARD),
    "piece_bytes": (1, LARGEST_PIECE),
    "piece_crc32": (0, (1 << 32) - 1),
}
"""Columns of numbers of the table of shards, with the least and the greatest value."""


@dataclass(frozen=True, eq=False)
class ShardTable:
    """Table of a set's S shards, and the place of each one's piece in the index, which it describes as a `CheckedFile`.

    size, sha256: of the index. names, splits, hashes (SHA-256): of shards. samples, sizes (bytes): of shards, int64
    [S]. ends: of pieces, bytes, int64 [S]. crc32: of pieces, int64 [S].
    """

    size: int
    sha256: str
    names: tuple[str, ...]
    splits: tuple[Split, ...]
    hashes: tuple[str, ...]
    samples: NDArray[np.int64]
    sizes: NDArray[np.int64]
    ends: NDArray[np.int64]
    crc32: NDArray[np.int64]
    name = INDEX_NAME

    def __len__(self) -> int:
        return len(self.names)

    def entry(self, index: int) -> Entry:
        """Place of the piece of shard `index`; its key is the shard's name."""
        start = int(self.ends[index - 1]) if index else 0
        return Entry(self.names[index], start, int(self.ends[index]) - start, int(self.crc32[index]))

    def to_json(self) -> dict[str, Any]:
        """Convert to the field `shards` of a manifest."""
        columns = (self.samples, self.sizes, np.diff(self.ends, prepend=0), self.crc32)
        return {
            "index": {"name": self.name, "size": self.size, "sha256": self.sha256},
            **dict(zip(_TEXTS, (self.names, self.splits, self.hashes), strict=True)),
            **{name: column.tolist() for name, column in zip(_NUMBERS, columns, strict=True)},
        }


def table_from_json(tree: Any, where: str) -> ShardTable:
    """Parse and check the field `shards` of a manifest with an index. Raises BadShard, naming `where` and the rule."""
    names = {"index", *_TEXTS, *_NUMBERS}
    if not isinstance(tree, dict) or set(tree) != names:
        raise BadShard(f"{where}: 'shards' must have the fields {sorted(names)}")
    file = tree["index"]
    if not isinstance(file, dict) or set(file) != {"name", "size", "sha256"} or file["name"] != INDEX_NAME:
        raise BadShard(f"{where}: 'index' must have the name {INDEX_NAME!r}, a size and a SHA-256")
    columns = [tree[name] for name in (*_TEXTS, *_NUMBERS)]
    if not all(isinstance(column, list) and column and len(column) == len(columns[0]) for column in columns):
        raise BadShard(f"{where}: the columns of 'shards' must be lists of one length, at least 1")
    for name, split, sha256 in zip(*columns[: len(_TEXTS)], strict=True):
        check_head(name, split, sha256, where)
    check_sha256(file["sha256"], f"{where}: 'index'")
    for name, (least, greatest) in _NUMBERS.items():
        if set(map(type, tree[name])) != {int} or not least <= min(tree[name]) <= max(tree[name]) <= greatest:
            raise BadShard(f"{where}: {name!r} must hold whole numbers of {least} to {greatest}")
    if len(set(tree["name"])) != len(tree["name"]):
        raise BadShard(f"{where}: shard names must be unique")
    ends = np.cumsum(np.array(tree["piece_bytes"], np.int64))
    if file["size"] != int(ends[-1]):
        raise BadShard(f"{where}: the pieces take {ends[-1]} bytes, the index {file['size']!r}")
    return ShardTable(
        size=file["size"],
        sha256=file["sha256"],
        names=tuple(tree["name"]),
        splits=tuple(tree["split"]),
        hashes=tuple(tree["sha256"]),
        samples=np.array(tree["samples"], np.int64),
        sizes=np.array(tree["size"], np.int64),
        ends=ends,
        crc32=np.array(tree["piece_crc32"], np.int64),
    )


class IndexedShards(Sequence[ShardRecord]):
    """Records of the shards of a set with an index. A record reads its piece when its samples are asked for.

    fields: of the descriptions. store: gives the pieces. kept: gives them from the first `FETCHED_PIECES` on, such as
    one that keeps the whole file on this machine. May be forked, pickled and used by several threads.
    """

    def __init__(self, table: ShardTable, fields: Fields, store: Store, kept: Store | None = None) -> None:
        self.table, self.fields = table, fields
        self._store, self._kept = store, kept or store
        self._fetched = 0
        self.piece = lru_cache(HELD_PIECES)(self._read_piece)
        self.whole = lru_cache(2)(self._read_whole)

    def __reduce__(self) -> tuple[Any, ...]:
        return IndexedShards, (self.table, self.fields, self._store, self._kept)

    def __len__(self) -> int:
        return len(self.table)

    @overload
    def __getitem__(self, index: int) -> ShardRecord: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[ShardRecord]: ...
    def __getitem__(self, index: int | slice) -> ShardRecord | Sequence[ShardRecord]:
        if isinstance(index, slice):
            return tuple(_IndexedShard(self, number) for number in range(len(self))[index])
        return _IndexedShard(self, range(len(self))[index])

    def where(self, number: int) -> str:
        """Place of a shard's piece, for messages."""
        return f"{self._store.name}/{location(self.table, number)}"

    def _read_piece(self, number: int) -> Piece:
        """Read the piece of a shard. Raises BadShard or Unreachable."""
        store = self._store if self._fetched < FETCHED_PIECES else self._kept
        self._fetched += 1
        data = read_checked(store, self.table, number)
        if self.fields == EARLIER_FIELDS:
            data = piece_as_current(data, self.where(number))
        return Piece(data, int(self.table.samples[number]), self.where(number))

    def _read_whole(self, number: int) -> ShardRecord:
        """The record of a shard with all columns, checked. Raises as `_read_piece`."""
        head = {name: getattr(self[number], name) for name in ("name", "split", "size", "sha256")}
        return record_from_json({**head, **self.piece(number).to_json()}, self.fields, self.where(number))


class _IndexedShard(ShardRecord):
    """Record of one shard whose samples' columns are read from the index when they are first used."""

    _shards: IndexedShards
    _number: int

    def __init__(self, shards: IndexedShards, number: int) -> None:
        table = shards.table
        head = {"name": table.names[number], "split": table.splits[number], "sha256": table.hashes[number]}
        vars(self).update(head, size=int(table.sizes[number]), _shards=shards, _number=number)

    def __len__(self) -> int:
        return int(self._shards.table.samples[self._number])

    def __reduce__(self) -> tuple[Any, ...]:
        return _IndexedShard, (self._shards, self._number)

    def entry(self, index: int) -> Entry:
        return self._shards.piece(self._number).entry(index)

    def __getattr__(self, name: str) -> Any:
        if name not in ("keys", "offsets", "lengths", "crc32", "notes", "descriptions"):
            raise AttributeError(name)
        return getattr(self._shards.whole(self._number), name)


def write_index(records: Iterable[ShardRecord], folder: Path) -> ShardTable:
    """Write the index of shards into a folder, atomically, and return their table; one record at a time is in memory.

    Raises BadShard for a shard of too many samples.
    """
    sha256 = hashlib.sha256()
    heads: list[tuple[str, Split, str]] = []
    numbers: list[tuple[int, int, int, int]] = []

    def pieces() -> Iterator[bytes]:
        for record in records:
            data = encode_piece(record)
            sha256.update(data)
            heads.append((record.name, record.split, record.sha256))
            numbers.append((len(record), record.size, len(data), zlib.crc32(data)))
            yield data

    write_atomically(folder / INDEX_NAME, pieces())
    names, splits, hashes = zip(*heads, strict=True)
    samples, sizes, lengths, crc32 = np.array(numbers, np.int64).T
    ends = np.cumsum(lengths)
    return ShardTable(int(ends[-1]), sha256.hexdigest(), names, splits, hashes, samples, sizes, ends, crc32)


def encode_piece(record: ShardRecord) -> bytes:
    """Encode a shard's record, without its name, split, size and hash. Raises BadShard if it would be too large."""
    described = record.descriptions
    counts = [*map(len, described.tables)]
    stems, tails = _divided_keys(record)
    text = {"tables": described.to_json()["tables"], "stems": stems, "tails": tails, "notes": record.notes}
    text_bytes = json.dumps(text, sort_keys=True, separators=(",", ":")).encode()
    blocks = np.array([*record.offsets, record.offsets[-1] + record.lengths[-1]], np.int64) // BLOCK
    data = b"".join(
        (
            _HEADER.pack(len(record), len(counts), len(text_bytes)),
            np.array(counts, "<u4").tobytes(),
            blocks.astype("<u4").tobytes(),
            np.array(record.crc32, "<u4").tobytes(),
            *(np.array(rows, _kind(count)).tobytes() for rows, count in zip(described.rows, counts, strict=True)),
            text_bytes,
        )
    )
    if len(data) > LARGEST_PIECE:
        raise BadShard(f"{record.name}: its index takes {len(data)} bytes, at most {LARGEST_PIECE}: use smaller shards")
    return data


class Piece:
    """Index of one shard's samples.

    data: its bytes. samples: number that it must hold. where: origin, for messages. Raises BadShard unless single
    samples can be found in it; `to_json` gives all else unchecked.
    """

    def __init__(self, data: bytes, samples: int, where: str) -> None:
        if len(data) < _HEADER.size:
            raise BadShard(f"{where}: {len(data)} bytes are no index of a shard")
        count, tables, text_size = _HEADER.unpack_from(data)
        if tables > MOST_TABLES or _HEADER.size + 4 * tables > len(data):
            raise BadShard(f"{where}: {len(data)} bytes cannot hold the sizes of {tables} tables")
        self._where = where
        counts = np.frombuffer(data, "<u4", tables, _HEADER.size).tolist()
        kinds = [_KINDS[-1], _KINDS[-1], *map(_kind, counts)]
        lengths = [count + 1, *[count] * (tables + 1)]
        sizes = [kind.itemsize * length for kind, length in zip(kinds, lengths, strict=True)]
        *starts, end = accumulate(sizes, initial=_HEADER.size + 4 * tables)
        if not count or count != samples or end + text_size != len(data):
            raise BadShard(f"{where}: the index must hold {samples} samples, found {len(data)} bytes for {count}")
        columns = zip(kinds, lengths, starts, strict=True)
        self._blocks, self._crc32, *self._rows = (np.frombuffer(data, *column) for column in columns)
        self._text = _checked_text(data[end:], where)
        self._stems: list[str] = self._text["stems"]
        self._tails: list[str] = self._text["tails"]
        self._whole_keys = not self._stems
        if [len(self._stems), len(self._tails)] != ([0, count] if self._whole_keys else counts[:2]):
            raise BadShard(
                f"{where}: 'stems' and 'tails' must be as many as rows of the first tables, or none and samples"
            )

    def entry(self, index: int) -> Entry:
        """Place of sample `index`, 0 to before `len()`. Raises BadShard if it cannot be one."""
        first, end, key = int(self._blocks[index]), int(self._blocks[index + 1]), self._key(index)
        length = BLOCK * (end - first)
        try:
            check_key(key)
        except BadSample as error:
            raise BadShard(f"{self._where}: {error}") from error
        if not 0 < length <= LARGEST_SAMPLE:
            raise BadShard(f"{self._where}: {key}: a sample takes at least a block and at most {LARGEST_SAMPLE} bytes")
        return Entry(key, BLOCK * first, length, int(self._crc32[index]))

    def _key(self, index: int) -> str:
        """Key of a sample, unchecked. Raises BadShard for a row that is not in its table."""
        if self._whole_keys:
            return self._tails[index]
        body, view = int(self._rows[0][index]), int(self._rows[1][index])
        if body >= len(self._stems) or view >= len(self._tails):
            raise BadShard(f"{self._where}: sample {index} has a row that its tables have not")
        return self._stems[body] + self._tails[view]

    def to_json(self) -> dict[str, Any]:
        """All fields of the shard's record but its name, split, size and hash. Raises BadShard."""
        blocks, count = self._blocks.astype(np.int64), len(self._crc32)
        return {
            "samples": count,
            "keys": [self._key(index) for index in range(count)],
            "offsets": (BLOCK * blocks[:-1]).tolist(),
            "lengths": (BLOCK * np.diff(blocks)).tolist(),
            "crc32": self._crc32.tolist(),
            "tables": self._text["tables"],
            "rows": [rows.tolist() for rows in self._rows],
            "notes": self._text["notes"],
        }


def _kind(rows: int) -> np.dtype[Any]:
    """The type of numbers of a table's rows: as many bytes as they need, 1, 2 or 4."""
    return _KINDS[(rows > 1 << 8) + (rows > 1 << 16)]


def _divided_keys(record: ShardRecord) -> tuple[list[str], list[str]]:
    """First parts of keys, one a row of table 0, and last parts, one a row of table 1; or none, and whole keys."""
    described = record.descriptions
    whole: tuple[list[str], list[str]] = [], list(record.keys)
    if len(described.tables) < 2:
        return whole
    stems: dict[int, str] = {}
    tails: dict[int, str] = {}
    for key, body, view in zip(record.keys, *described.rows[:2], strict=True):
        at = key.rfind(_VIEW_MARK)
        if at < 0 or stems.setdefault(body, key[:at]) != key[:at] or tails.setdefault(view, key[at:]) != key[at:]:
            return whole
    return [stems[row] for row in range(len(stems))], [tails[row] for row in range(len(tails))]


def _checked_text(data: bytes, where: str) -> dict[str, Any]:
    with reported(f"{where}: the index's text cannot be read", BadShard, ValueError, RecursionError):
        text = json.loads(data)
    if not isinstance(text, dict) or set(text) != _TEXT_FIELDS:
        raise BadShard(f"{where}: the index's text must have the fields {sorted(_TEXT_FIELDS)}")
    for field in ("stems", "tails"):
        if not isinstance(text[field], list) or set(map(type, text[field])) - {str}:
            raise BadShard(f"{where}: {field!r} must be a list of text")
    return text
