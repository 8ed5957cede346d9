"""Conditions on the descriptions of samples, like "distance_cm<=255", "subject=B,C" or "azimuth_deg=-90..90"."""

from __future__ import annotations

import fnmatch
import operator
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.splits import motion_of
from bodyseg_data.loading.selection.sample_table import BodyRow, SampleTable
from bodyseg_data.shards.descriptions import BODY_FIELDS, VIEW_FIELDS

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
