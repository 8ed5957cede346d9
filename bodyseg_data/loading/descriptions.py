"""Descriptions of samples as a table: one array a field, made from a set's records without opening a shard."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.loading.conditions import SampleTable
from bodyseg_data.samples import Value
from bodyseg_data.shards import Fields, ShardRecord

_TYPES: Final[dict[str, tuple[type, Value]]] = {
    "text": (np.str_, ""),
    "int": (np.int64, 0),
    "float": (np.float64, 0.0),
    "flag": (np.bool_, False),
    "numbers": (np.object_, ()),
}
"""Kind of a field -> type of its array, and what stands in it where a sample has none."""


def table_of(fields: Fields, chosen: Sequence[tuple[ShardRecord, Sequence[int]]]) -> dict[str, NDArray[Any]]:
    """Key, split and fields of chosen samples: name -> array [N], masked where some have no value.

    fields: of the set. chosen: shards, each with the numbers of its chosen samples.
    """
    shards = [shard for shard, _ in chosen]
    starts = accumulate(map(len, shards[:-1]), initial=0)
    own = np.concatenate(
        [np.array(numbers, np.int64) + start for start, (_, numbers) in zip(starts, chosen, strict=True)]
    )
    table = SampleTable.of(fields, shards)
    found: dict[str, NDArray[Any]] = {
        "key": np.array([shard.keys[number] for shard, numbers in chosen for number in numbers], np.str_),
        "split": np.array([shard.split for shard, numbers in chosen for _ in numbers], np.str_),
    }
    for name, (at, column) in fields.places.items():
        array = _array([row[column] for row in table.tables[at]], fields.kinds[name])[table.rows[at][own]]
        whole = isinstance(array, np.ma.MaskedArray) and not array.mask.any()  # none without it is among the chosen
        found[name] = array.data if whole else array
    return found


def _array(values: Sequence[Value | None], kind: str) -> NDArray[Any]:
    """The values of a table's rows [R] as an array, masked if one is None."""
    dtype, nothing = _TYPES[kind]
    array = np.empty(len(values), object)
    array[:] = [nothing if value is None else value for value in values]
    lacking = np.array([value is None for value in values])
    found: NDArray[Any] = array.astype(dtype)
    return np.ma.array(found, mask=lacking) if lacking.any() else found
