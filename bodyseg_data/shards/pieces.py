"""Pieces of an index: the records of single shards as a few columns of numbers, from which one sample is found at once.

docs/shard_format.md describes the bytes.
"""

from __future__ import annotations

import json
import struct
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadShard
from bodyseg_data.shards.descriptions import VIEW_FIELDS
from bodyseg_data.shards.records import BLOCK, Entry, ShardRecord

LARGEST_PIECE: Final = 1 << 26
"""Largest piece, bytes."""

_HEADER: Final = struct.Struct("<4I")
"""Numbers of samples, bodies and views; bytes of the text."""

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
        body_kind, view_kind = _kind(bodies), _kind(views)
        sizes = (4 * (count + 1), 4 * count, body_kind.itemsize * count, view_kind.itemsize * count, 10 * views)
        if count != samples or _HEADER.size + sum(sizes) + text_size != len(data):
            raise BadShard(f"{where}: the index must hold {samples} samples, found {len(data)} bytes for {count}")
        ends = np.cumsum((_HEADER.size, *sizes)).tolist()
        self._blocks: NDArray[np.uint32] = np.frombuffer(data, "<u4", count + 1, ends[0])
        self._crc32: NDArray[np.uint32] = np.frombuffer(data, "<u4", count, ends[1])
        self._body: NDArray[Any] = np.frombuffer(data, body_kind, count, ends[2])
        self._view: NDArray[Any] = np.frombuffer(data, view_kind, count, ends[3])
        self._views: NDArray[np.int16] = np.frombuffer(data, "<i2", len(VIEW_FIELDS) * views, ends[4])
        self._text = _checked_text(data[ends[5] :], where)
        stems, tails = self._text["stems"], self._text["tails"]
        if len(stems) != bodies or len(tails) not in (views, count):
            raise BadShard(f"{where}: 'stems' and 'tails' must be as many as bodies, and as views or samples")
        if not count or int(self._body.max()) >= bodies or int(self._view.max()) >= views:
            raise BadShard(f"{where}: the index names rows that it has not")
        self._stems, self._tails = stems, tails
        self._tail_of_view = len(tails) == views  # each sample is a view of its own where both numbers are equal

    def __len__(self) -> int:
        return len(self._crc32)

    def entry(self, index: int) -> Entry:
        """Place of sample `index`. Raises IndexError beyond the samples."""
        first, end = int(self._blocks[index]), int(self._blocks[index + 1])
        return Entry(self._key(index), BLOCK * first, BLOCK * (end - first), int(self._crc32[index]))

    def to_json(self) -> dict[str, Any]:
        """All fields of the shard's record in format 5 but its name, split, size and hash."""
        blocks = self._blocks.astype(np.int64)
        views = self._views.reshape(-1, len(VIEW_FIELDS))
        return {
            "samples": len(self),
            "keys": [self._key(index) for index in range(len(self))],
            "offsets": (BLOCK * blocks[:-1]).tolist(),
            "lengths": (BLOCK * np.diff(blocks)).tolist(),
            "crc32": self._crc32.tolist(),
            "bodies": self._text["bodies"],
            "views": views.T.tolist(),
            "body": self._body.tolist(),
            "view": self._view.tolist(),
            "notes": self._text["notes"],
        }

    def _key(self, index: int) -> str:
        tail = int(self._view[index]) if self._tail_of_view else index
        return f"{self._stems[self._body[index]]}{self._tails[tail]}"


def _kind(rows: int) -> np.dtype[Any]:
    """The type of numbers of a table's rows: as many bytes as they need, 1, 2 or 4."""
    return np.dtype("u1" if rows <= 1 << 8 else "<u2" if rows <= 1 << 16 else "<u4")


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
