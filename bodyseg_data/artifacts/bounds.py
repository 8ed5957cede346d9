"""Bounds of artifacts' strengths, declared with a dataclass's fields and checked by `check_fields`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Bounds:
    """Numbers from `low` to `high` that a field may hold; above: without `low` itself; below: without `high`.

    values: the only ones that it may hold, if not any between the ends.
    """

    low: float
    high: float
    above: bool = False
    below: bool = False
    values: tuple[float, ...] = ()

    def take(self, number: float) -> bool:
        """Return whether a number lies within. NaN never does."""
        if self.values:
            return number in self.values
        return (self.low < number if self.above else self.low <= number) and (
            number < self.high if self.below else number <= self.high
        )

    def __str__(self) -> str:
        if self.values:
            return f"one of {', '.join(f'{value:g}' for value in self.values)}"
        if self.above:
            return f"above {self.low:g} and {'below' if self.below else 'at most'} {self.high:g}"
        return f"from {self.low:g} to {'below ' if self.below else ''}{self.high:g}"


def bounded(default: Any, low: float, high: float, *, above: bool = False, below: bool = False) -> Any:
    """Declare a dataclass's field whose number, or each number of a tuple, lies within `Bounds`; None may stand."""
    return field(default=default, metadata={"bounds": Bounds(low, high, above, below)})


def one_of(default: float, values: tuple[float, ...]) -> Any:
    """Declare a dataclass's field that holds one of some numbers."""
    return field(default=default, metadata={"bounds": Bounds(min(values), max(values), values=values)})
