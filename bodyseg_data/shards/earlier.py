"""Sets that were packed before format 7, as the reader of today sees them.

Formats 5 and 6 knew the 33 parts alone, one rig a set, and twelve fixed fields of descriptions, ten of them in the
manifest (docs/reference/shard_format.md). Their images are `BSI2`, or PNGs whose label bytes hold the facing bits.
"""

import json
import struct
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadShard, reported
from bodyseg_data.labels import BACKGROUND, LANDMARKS, PART_CLASSES, UNLABELLED
from bodyseg_data.samples import SampleInfo, Value
from bodyseg_data.shards.records import BODY_FIELDS, Fields

EARLIER_FORMATS: Final = ("bodyseg shards 5", "bodyseg shards 6")
"""Formats that are read besides today's; the second has an index."""

EARLIER_FIELDS: Final = Fields(BODY_FIELDS.tables[:2])

_TREE: Final = {"format", "parts", "rig", "codec", "source", "renderer", "plan", "shards"}
_DEFAULTS: Final[dict[str, Value]] = {"pitch_deg": 0, "roll_deg": 0, "height_cm": 0, "things": "", "hidden_pct": 0}
_PIECE: Final = struct.Struct("<4I")
_THING: Final = 62


def manifest_as_current(tree: dict[str, Any], where: str) -> dict[str, Any]:
    """Fields of a manifest of format 5 or 6, but `skipped`, as format 7 has them. Raises BadShard, naming `where`."""
    if set(tree) != _TREE:
        raise BadShard(f"{where}: format {tree['format']!r} has the fields {sorted(_TREE)}, found {sorted(tree)}")
    if tree["parts"] != list(LANDMARKS):
        raise BadShard(f"{where}: 'parts' are not those of format {tree['format']!r}")
    shards = tree["shards"]
    if tree["format"] == EARLIER_FORMATS[0] and isinstance(shards, list):
        shards = [_record_as_current(record) for record in shards]
    kept = {name: tree[name] for name in ("format", "codec", "source", "renderer", "plan")}
    return {
        **kept,
        "rigs": [tree["rig"]],
        "classes": PART_CLASSES.to_json(),
        "fields": EARLIER_FIELDS.to_json(),
        "projector": "shadow",
        "planes": {},
        "shards": shards,
    }


def _record_as_current(record: Any) -> Any:
    columns = ("bodies", "views", "body", "view")
    if not isinstance(record, dict) or not set(columns) <= set(record):
        return record  # the reader of records refuses it
    kept = {name: value for name, value in record.items() if name not in columns}
    return {**kept, "tables": [record["bodies"], record["views"]], "rows": [record["body"], record["view"]]}


def piece_as_current(data: bytes, where: str) -> bytes:
    """A piece of an index of format 6 as format 7 has it. Raises BadShard, naming `where`, for other bytes."""
    what = f"{where}: {len(data)} bytes are no piece of an index of format 6"
    with reported(what, BadShard, ValueError, LookupError, TypeError, RecursionError, struct.error):
        count, bodies, views, _ = _PIECE.unpack_from(data)
        widths = [1 if rows <= 1 << 8 else 2 if rows <= 1 << 16 else 4 for rows in (bodies, views)]
        end = _PIECE.size + 4 * (2 * count + 1) + sum(widths) * count
        columns = np.frombuffer(data, "<i2", 5 * views, end).reshape(views, 5)
        text = json.loads(data[end + 10 * views :])
        stems, tails = text["stems"], text["tails"]
        if len(tails) != views:  # one key for each sample
            first = end - sum(widths) * count
            body = np.frombuffer(data, f"<u{widths[0]}", count, first)
            stems, tails = [], [stems[row] + tail for row, tail in zip(body.tolist(), tails, strict=True)]
        text = {"tables": [text["bodies"], columns.T.tolist()], "stems": stems, "tails": tails, "notes": text["notes"]}
        text_bytes = json.dumps(text, sort_keys=True, separators=(",", ":")).encode()
    head = struct.pack("<5I", count, 2, len(text_bytes), bodies, views)
    return head + data[_PIECE.size : end] + text_bytes


def completed(info: SampleInfo) -> SampleInfo:
    """The description of a sample of a body with all of its fields: earlier formats left out those that were 0."""
    if "hidden_pct" in info.fields or EARLIER_FIELDS.kinds.keys() - _DEFAULTS.keys() - info.fields.keys():
        return info
    return SampleInfo(info.split, {**info.fields, **{k: v for k, v in _DEFAULTS.items() if k not in info.fields}})


def split_label_bytes(stored: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Labels and facing bits of the label bytes of earlier formats, uint8 [...] each.

    A label byte is 255 for background; else bits 0 to 5 hold the part, 62 for a thing, bit 6 is set if the surface
    faces the projector, and bit 7 if it faces a second one.
    """
    labels = (stored & np.uint8(0x3F)).astype(np.uint8)
    labels[labels == _THING] = UNLABELLED
    facing = (stored >> np.uint8(6)).astype(np.uint8)
    background = stored == BACKGROUND
    labels[background], facing[background] = BACKGROUND, 0
    return labels, facing
