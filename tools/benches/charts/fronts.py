"""Pareto fronts: the methods that no other beats in cost and quality together."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TypeVar

_T = TypeVar("_T")


@dataclass(frozen=True)
class Axis:
    """A measured quantity. title: with its unit; noun: one word for it; factor: from measured to drawn values."""

    title: str
    noun: str
    more_is_better: bool = False
    factor: float = 1.0

    def gain(self, value: float, other: float) -> float:
        """Amount by which `value` is better than `other`, in the axis' unit; negative if it is worse."""
        return value - other if self.more_is_better else other - value


@dataclass(frozen=True)
class Point:
    """One method. label: text beside its point; named: whether the label is drawn even off the front.

    y_sd: standard deviation of y over repetitions, None if there is one only.
    """

    name: str
    x: float
    y: float
    label: str
    family: str = ""
    named: bool = False
    y_sd: float | None = None


@dataclass(frozen=True)
class Shortfall:
    """A point of the front that beats another, and by what shares of the other's own values."""

    better: Point
    x_share: float
    y_share: float


def pareto_front(items: Iterable[_T], costs: Callable[[_T], Sequence[float]]) -> list[_T]:
    """The Pareto front of some items, by rising costs. costs: of one item, as many of each, all better if smaller.

    Items with the same costs stay or go together.
    """
    priced = [(item, tuple(costs(item))) for item in items]
    kept = [(mine, item) for item, mine in priced if not any(dominates(other, mine) for _, other in priced)]
    return [item for _, item in sorted(kept, key=lambda pair: pair[0])]


def dominates(costs: Sequence[float], others: Sequence[float]) -> bool:
    """Pareto dominance: True if no cost is larger than the other one of its index, and one is smaller."""
    pairs = [*zip(costs, others, strict=True)]
    return all(a <= b for a, b in pairs) and any(a < b for a, b in pairs)


def front(points: Sequence[Point], x: Axis, y: Axis) -> tuple[Point, ...]:
    """The Pareto front of some points, by rising x. Points with the same x and y stay or go together."""
    kept = pareto_front(points, lambda point: _costs(point, x, y))
    return tuple(sorted(kept, key=lambda point: (point.x, point.y)))


def shortfalls(point: Point, points: Sequence[Point], x: Axis, y: Axis) -> tuple[Shortfall, ...]:
    """Points of the front that beat `point`, the largest sum of shares first; empty if it is on the front."""
    found = [
        Shortfall(one, _share(x.gain(one.x, point.x), point.x), _share(y.gain(one.y, point.y), point.y))
        for one in front(points, x, y)
        if dominates(_costs(one, x, y), _costs(point, x, y))
    ]
    return tuple(sorted(found, key=lambda fall: -(fall.x_share + fall.y_share)))


def _costs(point: Point, x: Axis, y: Axis) -> tuple[float, float]:
    return -x.gain(point.x, 0.0), -y.gain(point.y, 0.0)


def _share(gain: float, of: float) -> float:
    """Share of a value; 0 if the value is 0, which nothing beats."""
    return gain / of if of else 0.0
