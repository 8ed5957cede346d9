"""Shares of sets in the epochs of a mixture, in whole samples.

The sets are served one after the other: each gets its share of what those before it left, and the last one gets the
rest. A share is rounded over all epochs so far, not in each epoch anew: what a set lacks in one epoch, it gets in the
next. All of it is integer arithmetic, so an epoch gets the same numbers on every machine and in whatever order epochs
are asked for.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.randomness import check_epoch

Weight = float | Sequence[tuple[int, float]]
"""A set's weight: a number, or knots (epoch, weight) with a straight line between them and constants outside."""

_BITS: Final = 53
_HALF: Final = 1 << (_BITS - 1)
_LAST_KNOT: Final = 100_000


@dataclass(frozen=True)
class Schedule:
    """A weight over the epochs. knots: (epoch, weight), by rising epochs; linear between them, constant outside."""

    knots: tuple[tuple[int, float], ...]

    def at(self, epoch: int) -> float:
        """Return the weight in an epoch."""
        before, value = self.knots[0]
        if epoch <= before:
            return value
        for knot, weight in self.knots[1:]:
            if epoch < knot:
                return value + (weight - value) * ((epoch - before) / (knot - before))
            before, value = knot, weight
        return value

    def to_json(self) -> Any:
        """Return the weight if it is constant, else the knots, as plain JSON."""
        return self.knots[0][1] if len(self.knots) == 1 else [list(knot) for knot in self.knots]


def read_schedule(weight: Weight) -> Schedule:
    """Check a weight. Raises BadConfig for a negative or infinite one, and for knots whose epochs do not rise."""
    if isinstance(weight, list | tuple):
        if not weight or any(not isinstance(knot, list | tuple) or len(knot) != 2 for knot in weight):
            raise BadConfig(f"a weight must be a number or knots (epoch, weight), found {weight!r}")
        knots = tuple((check_epoch(epoch), _number(value)) for epoch, value in weight)
        epochs = [epoch for epoch, _ in knots]
        if epochs != sorted(set(epochs)) or epochs[-1] > _LAST_KNOT:
            raise BadConfig(f"epochs of a weight's knots must rise, up to {_LAST_KNOT}, found {epochs}")
        return Schedule(knots)
    return Schedule(((0, _number(weight)),))


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        raise BadConfig(f"a weight must be a number or knots (epoch, weight), found {value!r}")
    if not (math.isfinite(value) and value >= 0):
        raise BadConfig(f"a weight must be finite and at least 0, found {value!r}")
    return float(value)


class Shares:
    """Numbers of samples that each of K sets gives to epochs of `samples` samples.

    Raises BadConfig if all weights are 0 in some epoch, or too large to be added up.
    """

    def __init__(self, schedules: Sequence[Schedule], samples: int) -> None:
        self.schedules, self.samples = tuple(schedules), samples
        knots = sorted({epoch for each in self.schedules for epoch, _ in each.knots})
        for epoch in knots:  # between two knots a sum of straight lines is 0 only if it is 0 at both
            total = sum(self._weights(epoch))
            if not 0 < total < math.inf:
                raise BadConfig(
                    f"weights of a mixture must have a sum above 0 and finite, found {total:g} in epoch {epoch}"
                )
        self.constant_from = knots[-1]
        """The epoch from which on weights stay as they are."""
        self._reached = (0, self._beginning())

    def _weights(self, epoch: int) -> list[float]:
        return [each.at(epoch) for each in self.schedules]

    def _beginning(self) -> tuple[list[int], list[int]]:
        return [0] * len(self.schedules), [0] * len(self.schedules)

    def before(self, epoch: int) -> list[int]:
        """Return the number of samples that each set has given before `epoch`, K numbers.

        Takes a step for every epoch up to the last knot of a schedule and one for all epochs after it.
        """
        reached, (sums, given) = self._reached
        if reached > epoch:
            reached, (sums, given) = 0, self._beginning()
        sums, given = sums.copy(), given.copy()
        while reached < min(epoch, self.constant_from):
            self._add(sums, given, reached, 1)
            reached += 1
        self._reached = reached, (sums.copy(), given.copy())
        if epoch > reached:
            self._add(sums, given, reached, epoch - reached)
        return given

    def _add(self, sums: list[int], given: list[int], epoch: int, epochs: int) -> None:
        """Divide the samples of `epochs` epochs with the weights of `epoch`.

        sums: exact shares so far, in units of 2**-53 samples. given: these rounded; the last set has what is left.
        """
        weights = self._weights(epoch)
        left = self.samples * epochs
        for number in range(len(weights) - 1):
            rest = math.fsum(weights[number:])
            share = round(weights[number] / rest * 2**_BITS) if rest else 0
            sums[number] += left * share
            whole = (sums[number] + _HALF) >> _BITS
            left -= whole - given[number]
            given[number] = whole
        given[-1] += left
