"""Descriptions of a shard's samples in the manifest: tables of bodies and views, and two row numbers a sample."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any, Final

from bodyseg_data.core.errors import BadShard
from bodyseg_data.core.sample import SampleInfo
from bodyseg_data.core.splits import Split

BODY_FIELDS: Final = ("source", "subset", "subject", "mesh", "pose")
"""Fields of `SampleInfo` in a row of the table of bodies."""

VIEW_FIELDS: Final = ("distance_cm", "azimuth_deg", "pitch_deg", "roll_deg", "height_cm")
"""Fields of `SampleInfo` in a row of the table of views."""

DESCRIPTION_FIELDS: Final = ("bodies", "views", "body", "view")
"""Fields of a shard's record that hold its `Descriptions`."""

LARGEST_VALUE: Final = 32_767
"""Largest number, without its sign, that a row of the table of views may hold."""


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
