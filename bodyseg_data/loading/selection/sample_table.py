"""The descriptions of all samples of a set as arrays, made from its records without opening a shard."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.shards.records import ShardRecord

Row = TypeVar("Row")

BodyRow = tuple[str, ...]
"""Row of `bodyseg_data.shards.descriptions.BODY_FIELDS`."""

ViewRow = tuple[int, ...]
"""Row of `bodyseg_data.shards.descriptions.VIEW_FIELDS`."""


@dataclass(frozen=True)
class SampleTable:
    """Descriptions of N samples, in stored order. bodies, views: rows, each once.

    body, view: int32 [N], the number of a sample's row.
    """

    bodies: list[BodyRow]
    views: list[ViewRow]
    body: NDArray[np.int32]
    view: NDArray[np.int32]

    @classmethod
    def of(cls, shards: Iterable[ShardRecord]) -> SampleTable:
        """Join the descriptions of shards, of which one at a time is in memory."""
        bodies, views = _Joined[BodyRow](), _Joined[ViewRow]()
        for shard in shards:
            described = shard.descriptions
            bodies.add(described.bodies, described.body)
            views.add(described.views, described.view)
        return cls(list(bodies.rows), list(views.rows), bodies.numbers(), views.numbers())

    def where_body(self, fits: Callable[[BodyRow], bool]) -> NDArray[np.bool_]:
        """Mark the samples whose body's row meets a condition, bool [N]; asked once a body."""
        return np.array([fits(row) for row in self.bodies], np.bool_)[self.body]

    def where_view(self, fits: Callable[[ViewRow], bool]) -> NDArray[np.bool_]:
        """Mark the samples whose view's row meets a condition, bool [N]; asked once a view."""
        return np.array([fits(row) for row in self.views], np.bool_)[self.view]


class _Joined(Generic[Row]):
    """One table of the rows of several. rows: each with its number."""

    def __init__(self) -> None:
        self.rows: dict[Row, int] = {}
        self._parts: list[NDArray[np.int32]] = []

    def add(self, rows: tuple[Row, ...], column: tuple[int, ...]) -> None:
        """Add the table of a shard and its samples' numbers of rows."""
        numbers = np.array([self.rows.setdefault(row, len(self.rows)) for row in rows], np.int32)
        self._parts.append(numbers[np.array(column)])

    def numbers(self) -> NDArray[np.int32]:
        """Numbers of the samples' rows in the joined table, int32 [N]."""
        return np.concatenate(self._parts)
