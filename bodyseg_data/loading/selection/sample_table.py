"""The descriptions of all samples of a set as arrays, made from the manifest without opening a shard."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.shards.descriptions import Descriptions
from bodyseg_data.shards.manifest import Manifest

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
    def of(cls, manifest: Manifest) -> SampleTable:
        """Join the descriptions of all shards."""
        shards = [shard.descriptions for shard in manifest.shards]
        bodies, body = _joined(shards, lambda shard: (shard.bodies, shard.body))
        views, view = _joined(shards, lambda shard: (shard.views, shard.view))
        return cls(bodies, views, body, view)

    def where_body(self, fits: Callable[[BodyRow], bool]) -> NDArray[np.bool_]:
        """Mark the samples whose body's row meets a condition, bool [N]; asked once a body."""
        return np.array([fits(row) for row in self.bodies], np.bool_)[self.body]

    def where_view(self, fits: Callable[[ViewRow], bool]) -> NDArray[np.bool_]:
        """Mark the samples whose view's row meets a condition, bool [N]; asked once a view."""
        return np.array([fits(row) for row in self.views], np.bool_)[self.view]


def _joined(
    shards: list[Descriptions], columns: Callable[[Descriptions], tuple[tuple[Row, ...], tuple[int, ...]]]
) -> tuple[list[Row], NDArray[np.int32]]:
    """One table of the rows of all shards, and the rows' numbers in it, int32 [N]."""
    known: dict[Row, int] = {}
    numbers = []
    for shard in shards:
        rows, column = columns(shard)
        numbers.append(np.array([known.setdefault(row, len(known)) for row in rows], np.int32)[np.array(column)])
    return list(known), np.concatenate(numbers)
