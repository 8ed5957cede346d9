"""Pieces of an index: the records of single shards as a few columns of numbers, from which one sample is found at once.

docs/reference/shard_format.md describes the bytes.
"""

from __future__ import annotations

import json
import struct
from typing import Any, Final

import numpy as np

from bodyseg_data.core.errors import BadSample, BadShard
from bodyseg_data.core.sample import check_key
from bodyseg_data.shards.descriptions import VIEW_FIELDS
from bodyseg_data.shards.records import BLOCK, LARGEST_SAMPLE, Entry, ShardRecord

LARGEST_PIECE: Final = 1 << 26
"""Largest piece, bytes."""

_HEADER: Final = struct.Struct("<4I")
"""Numbers of samples, bodies and views; bytes of the text."""

_ONE: Final = struct.Struct("<I")
_TWO: Final = struct.Struct("<2I")

_TEXT_FIELDS: Final = {"bodies", "stems", "tails", "notes"}
_VIEW_MARK: Final = "-d"
"""Begins the part of a key that names the view."""


def encode_piece(record: ShardRecord) -> bytes:
    """Encode a shard's record, without its name, split, size and hash. Raises BadShard if it would be too large."""
    described = record.descriptions
    bodies, views = len(described.bodies), len(described.views)
    stems, tails = _divided_keys(record)
    text = {
        "bodies": list(zip(*described.bodies, strict=True)),
        "stems": stems,
        "tails": tails,
        "notes": record.notes,
    }
    text_bytes = json.dumps(text, sort_keys=True, separators=(",", ":")).encode()
    blocks = np.array([*record.offsets, record.offsets[-1] + record.lengths[-1]], np.int64) // BLOCK
    data = b"".join(
        (
            _HEADER.pack(len(record), bodies, views, len(text_bytes)),
            blocks.astype("<u4").tobytes(),
            np.array(record.crc32, "<u4").tobytes(),
            np.array(described.body, _kind(bodies)).tobytes(),
            np.array(described.view, _kind(views)).tobytes(),
            np.array(described.views, "<i2").tobytes(),
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
        count, bodies, views, text_size = _HEADER.unpack_from(data)
        self._data, self._count, self._where = data, samples, where
        self._body_kind, self._view_kind = _kind(bodies), _kind(views)
        # The places of the columns: blocks, checksums, body, view, table of views, text.
        self._crc32 = _HEADER.size + 4 * (count + 1)
        self._body = self._crc32 + 4 * count
        self._view = self._body + self._body_kind.itemsize * count
        self._views = self._view + self._view_kind.itemsize * count
        text = self._views + 2 * len(VIEW_FIELDS) * views
        if not count or count != samples or text + text_size != len(data):
            raise BadShard(f"{where}: the index must hold {samples} samples, found {len(data)} bytes for {count}")
        self._text = _checked_text(data[text:], where)
        self._stems, self._tails = self._text["stems"], self._text["tails"]
        if len(self._stems) != bodies or len(self._tails) not in (views, count):
            raise BadShard(f"{where}: 'stems' and 'tails' must be as many as bodies, and as views or samples")
        self._tail_of_view = len(self._tails) == views  # each sample is a view of its own where both are equal

    def __len__(self) -> int:
        return self._count

    def entry(self, index: int) -> Entry:
        """Place of sample `index`, 0 to before `len()`. Raises BadShard if it cannot be one."""
        first, end = _TWO.unpack_from(self._data, _HEADER.size + 4 * index)
        (checksum,) = _ONE.unpack_from(self._data, self._crc32 + 4 * index)
        body = self._number(self._body, self._body_kind, index)
        tail = self._number(self._view, self._view_kind, index) if self._tail_of_view else index
        if body >= len(self._stems) or tail >= len(self._tails):
            raise BadShard(f"{self._where}: sample {index} is of a body or view that the index has not")
        key, length = self._stems[body] + self._tails[tail], BLOCK * (end - first)
        try:
            check_key(key)
        except BadSample as error:
            raise BadShard(f"{self._where}: {error}") from error
        if not 0 < length <= LARGEST_SAMPLE:
            raise BadShard(f"{self._where}: {key}: a sample takes at least a block and at most {LARGEST_SAMPLE} bytes")
        return Entry(key, BLOCK * first, length, checksum)

    def to_json(self) -> dict[str, Any]:
        """All fields of the shard's record in format 5 but its name, split, size and hash. Raises BadShard."""
        data, count = self._data, self._count
        blocks = np.frombuffer(data, "<u4", count + 1, _HEADER.size).astype(np.int64)
        views = np.frombuffer(data[self._views :], "<i2", _HEADER.unpack_from(data)[2] * len(VIEW_FIELDS))
        return {
            "samples": count,
            "keys": [self.entry(index).key for index in range(count)],
            "offsets": (BLOCK * blocks[:-1]).tolist(),
            "lengths": (BLOCK * np.diff(blocks)).tolist(),
            "crc32": np.frombuffer(data, "<u4", count, self._crc32).tolist(),
            "bodies": self._text["bodies"],
            "views": views.reshape(-1, len(VIEW_FIELDS)).T.tolist(),
            "body": np.frombuffer(data, self._body_kind, count, self._body).tolist(),
            "view": np.frombuffer(data, self._view_kind, count, self._view).tolist(),
            "notes": self._text["notes"],
        }

    def _number(self, column: int, kind: np.dtype[Any], index: int) -> int:
        """Number `index` of a column that begins at byte `column`."""
        start = column + kind.itemsize * index
        return int.from_bytes(self._data[start : start + kind.itemsize], "little")


_KINDS: Final = tuple(map(np.dtype, ("u1", "<u2", "<u4")))


def _kind(rows: int) -> np.dtype[Any]:
    """The type of numbers of a table's rows: as many bytes as they need, 1, 2 or 4."""
    return _KINDS[(rows > 1 << 8) + (rows > 1 << 16)]


def _divided_keys(record: ShardRecord) -> tuple[list[str], list[str]]:
    """First parts of the keys, one a body, and last parts, one a view; or nothing, and the keys of all samples."""
    described = record.descriptions
    stems: dict[int, str] = {}
    tails: dict[int, str] = {}
    for key, body, view in zip(record.keys, described.body, described.view, strict=True):
        at = key.rfind(_VIEW_MARK)
        if at < 0 or stems.setdefault(body, key[:at]) != key[:at] or tails.setdefault(view, key[at:]) != key[at:]:
            return [""] * len(described.bodies), list(record.keys)
    return [stems[row] for row in range(len(stems))], [tails[row] for row in range(len(tails))]


def _checked_text(data: bytes, where: str) -> dict[str, Any]:
    try:
        text = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise BadShard(f"{where}: the index's text cannot be read: {error}") from error
    if not isinstance(text, dict) or set(text) != _TEXT_FIELDS:
        raise BadShard(f"{where}: the index's text must have the fields {sorted(_TEXT_FIELDS)}")
    for field in ("stems", "tails"):
        if not isinstance(text[field], list) or set(map(type, text[field])) != {str}:
            raise BadShard(f"{where}: {field!r} must be a list of text")
    return text
