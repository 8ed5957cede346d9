"""One chart's panels, points and limits, and how they are read out of a bench's figures."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from numbers import Real
from pathlib import Path
from typing import Any, Literal

from benches.charts.fronts import Axis, Point
from bodyseg_data.core import BadConfig


@dataclass(frozen=True)
class Limit:
    """A bound that is not one of the methods, drawn as a line across the chart at its x."""

    name: str
    x: float
    label: str


@dataclass(frozen=True)
class Panel:
    """Methods that were measured under the same conditions. default: the name of a point, or None."""

    name: str
    points: tuple[Point, ...]
    default: str | None
    limits: tuple[Limit, ...] = ()


@dataclass(frozen=True)
class Choice:
    """One chart. bench: what measures it. note: what is compared, under the title. read: panels from the figures; none
    if they hold nothing to compare. shared: which axes all panels have in common. results: name of the file of figures,
    without .json; by default the bench's.
    """

    name: str
    bench: str
    title: str
    note: str
    x: Axis
    y: Axis
    read: Callable[[Mapping[str, Any]], tuple[Panel, ...]]
    shared: Literal["xy", "y", ""] = "xy"
    results: str = ""

    @property
    def stem(self) -> str:
        """Name of the file of its figures, without .json."""
        return self.results or self.bench

    def panels(self, figures: Mapping[str, Any], file: Path) -> tuple[Panel, ...]:
        """The panels that `read` finds in the content of a file. Raises BadConfig, naming the file, for figures of
        another kind, if a default is not among the points, or for a figure that is no number, as null is none.
        """
        try:
            found = self.read(figures)
        except (LookupError, TypeError, ValueError, AttributeError, ZeroDivisionError) as error:
            raise BadConfig(f"{file} has not the figures of bench {self.bench}: {error!r}") from error
        for panel in found:
            if panel.default is not None and panel.default not in {point.name for point in panel.points}:
                raise BadConfig(f"{file}: the default {panel.default!r} is not among: {panel.name}")
            for point in panel.points:
                places: tuple[tuple[Axis, Any], ...] = (self.x, point.x), (self.y, point.y)  # of JSON: anything
                for axis, value in places:
                    if not isinstance(value, Real):
                        what = f"{axis.title!r} of {point.name!r}"
                        raise BadConfig(f"{file}: {panel.name}: {what} must be a number, found {value!r}")
        return found
