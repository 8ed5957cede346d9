"""Conditions on the descriptions of samples, like "distance_cm<=255", "subject=B,C" or "azimuth_deg=-90..90".

They are asked of a table of the descriptions, made from a set's records without opening a shard.
"""

from __future__ import annotations

import fnmatch
import operator
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig
from bodyseg_data.samples import motion_of
from bodyseg_data.shards import BODY_FIELDS, VIEW_FIELDS, ShardRecord

Row = TypeVar("Row")

BodyRow = tuple[str, ...]
"""Row of `bodyseg_data.shards.BODY_FIELDS`."""

ViewRow = tuple[int, ...]
"""Row of `bodyseg_data.shards.VIEW_FIELDS`."""

FIELDS: Final = (*BODY_FIELDS, "motion", *VIEW_FIELDS)
"""The fields that conditions may name."""

_ORDERS: Final[dict[str, Callable[[float, float], bool]]] = {
    "<=": operator.le,
    ">=": operator.ge,
    "<": operator.lt,
    ">": operator.gt,
}
_CONDITION: Final = re.compile(r"\s*(\w+)\s*(<=|>=|!=|=|<|>)(.*)", re.DOTALL)
_NUMBER: Final = r"[+-]?[0-9]{1,6}(?:\.[0-9]{1,6})?"
_RANGE: Final = re.compile(rf"({_NUMBER})(?:\.\.({_NUMBER}))?")
_FULL_TURN_DEG: Final = 360
_FORM: Final = "FIELD, one of = != < <= > >=, and values, like 'distance_cm<=255'"


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
        if self.field in VIEW_FIELDS:
            column = VIEW_FIELDS.index(self.field)
            return table.where_view(lambda row: self._holds_number(row[column]))
        return table.where_body(lambda row: self._holds_text(body_field(row, self.field)))

    def _holds_text(self, value: str) -> bool:
        found = bool(value) and any(pattern.match(value) for pattern in self.patterns)
        return found == (self.comparison == "=")

    def _holds_number(self, value: int) -> bool:
        if self.comparison in _ORDERS:
            return _ORDERS[self.comparison](value, self.ranges[0][0])
        if self.field == "azimuth_deg":
            found = any((value - low) % _FULL_TURN_DEG <= high - low for low, high in self.ranges)
        else:
            found = any(low <= value <= high for low, high in self.ranges)
        return found == (self.comparison == "=")


def parse_condition(text: str) -> Condition:
    """Read a condition: FIELD=VALUES, FIELD!=VALUES, or of a number FIELD<NUMBER, <=, >, >=.

    VALUES are one or several with commas between them, of which any may be met: patterns as for file names, or numbers
    and ranges a..b, both ends included. Azimuths a..b are the directions from a to b, and -90 is 270. The field
    "motion" is the pose of frames of a motion, the subsets B and C; no pattern matches the motion of other samples.

    Raises BadConfig for an unknown field, a comparison that it does not have, or other values.
    """
    parts = _CONDITION.fullmatch(text)
    if parts is None:
        raise BadConfig(f"a condition is {_FORM}, found {text!r}")
    name, comparison = parts[1], parts[2]
    values = tuple(word.strip() for word in parts[3].split(","))
    if name not in FIELDS:
        raise BadConfig(f"a condition is on one of {', '.join(FIELDS)}, found {name!r} in {text!r}")
    if name in VIEW_FIELDS:
        ranges = tuple(_range_of(text, name, value) for value in values)
        if comparison in _ORDERS and (len(ranges) > 1 or ".." in values[0]):
            raise BadConfig(f"{name}{comparison} takes one number, found {text!r}")
        return Condition(name, comparison, values, ranges=ranges)
    if comparison in _ORDERS:
        raise BadConfig(f"{name} is text and has no order: use = or !=, found {text!r}")
    if not all(values):
        raise BadConfig(f"{name} needs a value after {comparison} and after each comma, found {text!r}")
    return Condition(name, comparison, values, tuple(re.compile(fnmatch.translate(value)) for value in values))


def body_field(row: BodyRow, name: str) -> str:
    """Return a field of a body: one of `BODY_FIELDS`, or its "motion"."""
    if name == "motion":
        return motion_of(row[BODY_FIELDS.index("subset")], row[BODY_FIELDS.index("pose")])
    return row[BODY_FIELDS.index(name)]


def parse_conditions(where: Any) -> tuple[Condition, ...]:
    """Read one condition or several. Raises BadConfig for anything that is not text or a sequence of texts."""
    return tuple(parse_condition(text) for text in texts_of("where", where))


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
