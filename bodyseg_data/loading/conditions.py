"""Descriptions of samples as tables, made from a set's records without opening a shard.

Conditions like "distance_cm<=255", "subject=B,C" or "azimuth_deg=-90..90" are asked of them.
"""

from __future__ import annotations

import fnmatch
import operator
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig, check_choice
from bodyseg_data.rigs import Rig
from bodyseg_data.samples import Value, holds_motions
from bodyseg_data.shards import RIG_FIELD, Fields, Row, ShardRecord

_ORDERS: Final[dict[str, Callable[[float, float], bool]]] = {
    "<=": operator.le,
    ">=": operator.ge,
    "<": operator.lt,
    ">": operator.gt,
}
_CONDITION: Final = re.compile(r"\s*(\w+)\s*(<=|>=|!=|=|<|>)(.*)", re.DOTALL)
_NUMBER: Final = r"[+-]?[0-9]{1,40}(?:\.[0-9]{1,40})?(?:[eE][+-]?[0-9]{1,3})?"
_RANGE: Final = re.compile(rf"({_NUMBER})(?:\.\.({_NUMBER}))?")
_FULL_TURN_DEG: Final = 360
_SHOWN: Final = 9  # rigs that a message names
_FORM: Final = "FIELD, one of = != < <= > >=, and values, like 'distance_cm<=255'"


@dataclass(frozen=True)
class SampleTable:
    """Descriptions of N samples, in stored order.

    samples: N. fields: of the set. tables: for each of its tables the rows, each once. rows: for each table int32 [N],
    the number of a sample's row.
    """

    fields: Fields
    tables: list[list[Row]]
    rows: list[NDArray[np.int32]]
    samples: int

    @classmethod
    def of(cls, fields: Fields, shards: Iterable[ShardRecord]) -> SampleTable:
        """Join the descriptions of shards, of which one at a time is in memory."""
        joined: list[dict[Row, int]] = [{} for _ in fields.tables]
        parts: list[list[NDArray[np.int32]]] = [[] for _ in fields.tables]
        samples = 0
        for shard in shards:
            samples += len(shard)
            described = shard.descriptions
            for known, own, table, rows in zip(joined, parts, described.tables, described.rows, strict=True):
                numbers = np.array([known.setdefault(row, len(known)) for row in table], np.int32)
                own.append(numbers[np.array(rows)])
        return cls(fields, [list(known) for known in joined], [np.concatenate(own) for own in parts], samples)

    def where(self, field: str, fits: Callable[[Any], bool]) -> NDArray[np.bool_]:
        """Mark the samples whose value of a field meets a condition, bool [N]; asked once a row of its table."""
        table, column = self.fields.places[field]
        return np.array([fits(row[column]) for row in self.tables[table]], np.bool_)[self.rows[table]]


@dataclass(frozen=True)
class Condition:
    """A condition on one field of samples' descriptions; see `parse_condition`.

    patterns: of a text's values. ranges: of a number's values, least and greatest.
    """

    field: str
    comparison: str
    values: tuple[str, ...]
    patterns: tuple[re.Pattern[str], ...] = ()
    ranges: tuple[tuple[float, float], ...] = ()

    @property
    def text(self) -> str:
        """The condition as text without spaces."""
        return f"{self.field}{self.comparison}{','.join(self.values)}"

    def marks(self, table: SampleTable) -> NDArray[np.bool_]:
        """Mark the samples that meet the condition, bool [N]."""
        if self.ranges:
            return table.where(self.field, self._holds_number)
        own = self.field in table.fields.places
        found = table.where(self.field if own else "pose", self._matches)
        if not own:
            found &= table.where("subset", holds_motions)
        return found if self.comparison == "=" else ~found

    def _matches(self, value: Any) -> bool:
        text = str(value).lower() if isinstance(value, bool) else value
        return bool(text) and any(pattern.match(text) for pattern in self.patterns)

    def _holds_number(self, value: Any) -> bool:
        if value is None:
            return self.comparison == "!="
        if self.comparison in _ORDERS:
            return _ORDERS[self.comparison](value, self.ranges[0][0])
        if self.field == "azimuth_deg":
            found = any((value - low) % _FULL_TURN_DEG <= high - low for low, high in self.ranges)
        else:
            found = any(low <= value <= high for low, high in self.ranges)
        return found == (self.comparison == "=")


def parse_condition(text: str, fields: Fields, rigs: Sequence[Rig] = ()) -> Condition:
    """Read a condition: FIELD=VALUES, FIELD!=VALUES, or of a number FIELD<NUMBER, <=, >, >=.

    VALUES are one or several with commas between them, of which any may be met: patterns as for file names, or numbers
    and ranges a..b, both ends included, or true and false. Azimuths a..b are the directions from a to b, and -90 is
    270. The field "motion", unless a set has one, is the pose of frames of a motion, the subsets B and C; no pattern
    matches the motion of other samples. fields, rigs: of the set. A sample without the field meets FIELD!=VALUES alone.

    Raises BadConfig for an unknown field, a comparison that it does not have, or other values.
    """
    parts = _CONDITION.fullmatch(text)
    if parts is None:
        raise BadConfig(f"a condition is {_FORM}, found {text!r}")
    name, comparison = parts[1], parts[2]
    values = tuple(word.strip() for word in parts[3].split(","))
    kinds = {name: kind for name, kind in fields.kinds.items() if kind != "numbers"}
    if kinds.get("subset") == kinds.get("pose") == "text" and "motion" not in fields.kinds:
        kinds["motion"] = "text"
    if name not in kinds:
        known = f"is on one of {', '.join(kinds)}" if kinds else "needs descriptions, and this set's have no fields"
        raise BadConfig(f"a condition {known}, found {name!r} in {text!r}")
    if kinds[name] in ("int", "float"):
        numbered = ", ".join(f"{number} {rig.name}" for number, rig in enumerate(rigs[:_SHOWN]))
        known = f" ({numbered}{' ...' if len(rigs) > _SHOWN else ''})" if name == RIG_FIELD and rigs else ""
        ranges = tuple(_range_of(text, f"{name}{known}", value) for value in values)
        if comparison in _ORDERS and (len(ranges) > 1 or ".." in values[0]):
            raise BadConfig(f"{name}{comparison} takes one number, found {text!r}")
        return Condition(name, comparison, values, ranges=ranges)
    if comparison in _ORDERS:
        raise BadConfig(f"{name} is {kinds[name]} and has no order: use = or !=, found {text!r}")
    if kinds[name] == "flag":
        values = tuple(check_choice(f"{name} in {text!r}", value.lower(), ("true", "false")) for value in values)
    if not all(values):
        raise BadConfig(f"{name} needs a value after {comparison} and after each comma, found {text!r}")
    return Condition(name, comparison, values, tuple(re.compile(fnmatch.translate(value)) for value in values))


def named_fields(where: Any) -> list[str]:
    """Names of the fields in conditions, which `parse_condition` checks. Raises as `texts_of`."""
    return [parts[1] for parts in map(_CONDITION.fullmatch, texts_of("where", where)) if parts is not None]


def texts_of(option: str, value: Any) -> tuple[str, ...]:
    """Return one text, or a sequence of texts, as a tuple. option: its name. Raises BadConfig for anything else."""
    texts = (value,) if isinstance(value, str) else value
    if not isinstance(texts, Sequence) or not all(isinstance(text, str) for text in texts):
        raise BadConfig(f"{option} must be text or a list of texts, found {value!r}")
    if not all(text.strip() for text in texts):
        raise BadConfig(f"{option} must hold no empty text, found {value!r}")
    return tuple(texts)


def _range_of(text: str, name: str, word: str) -> tuple[float, float]:
    ends = _RANGE.fullmatch(word)
    if ends is None:
        raise BadConfig(f"{name} is compared with numbers, or ranges like -90..90, found {text!r}")
    low, high = float(ends[1]), float(ends[2] or ends[1])
    if low > high:
        raise BadConfig(f"a range goes from the least to the greatest number, found {text!r}")
    return low, high


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
        whole = isinstance(array, np.ma.MaskedArray) and not array.mask.any()  # all chosen samples have a value
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
