"""One chart's panels, points and limits, and how they are read out of a bench's figures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from benches.charts.fields import Field
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
    read: Callable[[Field], tuple[Panel, ...]]
    shared: Literal["xy", "y", ""] = "xy"
    results: str = ""

    @property
    def stem(self) -> str:
        """Name of the file of its figures, without .json."""
        return self.results or self.bench

    def panels(self, figures: Field) -> tuple[Panel, ...]:
        """The panels that `read` finds. Raises BadConfig, naming the file, if a default is not among the points."""
        found = self.read(figures)
        for panel in found:
            if panel.default is not None and panel.default not in {point.name for point in panel.points}:
                raise BadConfig(f"{figures.file}: the default {panel.default!r} is not among: {panel.name}")
        return found
