"""Pareto fronts: of several ways to do a thing, those that no other beats in cost and quality together."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TypeVar

_T = TypeVar("_T")


@dataclass(frozen=True)
class Axis:
    """What is measured. title: with its unit, as drawn; noun: one word for it; factor: from values to what is drawn."""

    title: str
    noun: str
    more_is_better: bool = False
    factor: float = 1.0

    def gain(self, value: float, other: float) -> float:
        """By how much `value` is better than `other`, in the axis' unit; negative if it is worse."""
        return value - other if self.more_is_better else other - value


@dataclass(frozen=True)
class Point:
    """One way to do it. label: what stands beside it, where it is named; named: whether it is, even off the front.

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


def unbeaten(things: Iterable[_T], costs: Callable[[_T], Sequence[float]]) -> list[_T]:
    """Those that no other beats, by rising costs. costs: of one thing, as many of each, all better if smaller.

    Of several with the same costs, all stay or none.
    """
    priced = [(thing, tuple(costs(thing))) for thing in things]
    kept = [(mine, thing) for thing, mine in priced if not any(beats(other, mine) for _, other in priced)]
    return [thing for _, thing in sorted(kept, key=lambda pair: pair[0])]


def beats(costs: Sequence[float], others: Sequence[float]) -> bool:
    """Whether costs are nowhere larger than others, as many and in the same order, and somewhere smaller."""
    pairs = [*zip(costs, others, strict=True)]
    return all(a <= b for a, b in pairs) and any(a < b for a, b in pairs)


def front(points: Sequence[Point], x: Axis, y: Axis) -> tuple[Point, ...]:
    """The points that no other beats, by rising x. Of points in one place, all or none."""
    kept = unbeaten(points, lambda point: _costs(point, x, y))
    return tuple(sorted(kept, key=lambda point: (point.x, point.y)))


def shortfalls(point: Point, points: Sequence[Point], x: Axis, y: Axis) -> tuple[Shortfall, ...]:
    """What of the front beats `point`, the largest sum of shares first; nothing if it is on the front."""
    found = [
        Shortfall(one, _share(x.gain(one.x, point.x), point.x), _share(y.gain(one.y, point.y), point.y))
        for one in front(points, x, y)
        if beats(_costs(one, x, y), _costs(point, x, y))
    ]
    return tuple(sorted(found, key=lambda fall: -(fall.x_share + fall.y_share)))


def _costs(point: Point, x: Axis, y: Axis) -> tuple[float, float]:
    return -x.gain(point.x, 0.0), -y.gain(point.y, 0.0)


def _share(gain: float, of: float) -> float:
    """0 of nothing: what costs nothing cannot be beaten."""
    return gain / of if of else 0.0
