"""The samples of a mixture's epochs: how many each set gives, and in which order.

The sets are served one after the other: each gets its share of what those before it left, and the last one gets the
rest. A share is rounded over all epochs so far, not in each epoch anew: what a set lacks in one epoch, it gets in the
next. All of it is integer arithmetic, so an epoch gets the same numbers on every machine and in whatever order epochs
are asked for. A set gives its samples pass after pass, each in an order of its own.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bodyseg_data.core import BadConfig, chance, check_epoch
from bodyseg_data.loading.image_set import Requests, Shuffle
from bodyseg_data.loading.range_images import RangeImages
from bodyseg_data.loading.selection import permutation

Weight = float | Sequence[tuple[int, float]]
"""A set's weight: a number, or knots (epoch, weight) with a straight line between them and constants outside."""

_BITS: Final = 53
_HALF: Final = 1 << (_BITS - 1)
_LAST_KNOT: Final = 100_000

_UNIT_BITS: Final = 61  # bits of the sum of all sample weights as integers


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


class SetStream:
    """Endless sequence of one set's samples: passes of `len(images)` samples each.

    Without sample weights a pass has every sample once, in the order that the set itself has in the epoch of that
    number, and the pass is the epoch of its draws.

    sample_weights: float64 [len(images)]. A pass then has a sample floor(c) or ceil(c) times, c in the mean, where c is
    its share of the weights times the length of a pass: systematic sampling (Madow and Madow 1944) along the pass's own
    order. Every occurrence in a pass has an epoch of draws of its own. Raises BadConfig for weights of another number,
    or that are negative, not finite, or all 0.
    """

    def __init__(self, images: RangeImages, sample_weights: ArrayLike | None = None) -> None:
        self.images = images
        self._units = None if sample_weights is None else _checked_units(sample_weights, images)
        self._occurrences = 1 if self._units is None else _most(self._units)
        self._held: tuple[int, Shuffle, Requests] | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_held": None}  # a spawned worker makes no order

    @property
    def digest(self) -> str | None:
        """Digest of the sample weights, up to a common factor; None without any."""
        if self._units is None:
            return None
        return hashlib.blake2b(self._units.astype("<i8").tobytes(), digest_size=16).hexdigest()

    def take(self, start: int, count: int, shuffle: Shuffle) -> Requests:
        """Return `count` samples from position `start` of the sequence. shuffle: False for stored order in a pass."""
        length = len(self.images)
        indices, epochs = np.empty(count, np.int64), np.empty(count, np.int64)
        done = 0
        while done < count:
            number, first = divmod(start + done, length)
            whole = self._pass(number, shuffle)
            end = min(length, first + count - done)
            indices[done : done + end - first] = whole.indices[first:end]
            epochs[done : done + end - first] = whole.epochs[first:end]
            done += end - first
        return Requests(indices, epochs)

    def evenly_sampled(self, count: int) -> NDArray[np.int64]:
        """Return the indices of `count` samples at even distances in stored order, by weight, int64 [count]."""
        if self._units is None:
            return np.linspace(0, len(self.images) - 1, count).astype(np.int64)
        sums = np.cumsum(self._units)
        at: NDArray[np.int64] = ((np.arange(count) + 0.5) / count * sums[-1]).astype(np.int64)
        found: NDArray[np.int64] = np.searchsorted(sums, at, side="right")
        return found

    def _pass(self, number: int, shuffle: Shuffle) -> Requests:
        """Return one pass, whole; the last one is kept, as an epoch may end in the middle of it."""
        if self._held is None or self._held[:2] != (number, shuffle):
            self._held = None
            self._held = (number, shuffle, self._new_pass(number, shuffle))
        return self._held[2]

    def _new_pass(self, number: int, shuffle: Shuffle) -> Requests:
        if self._units is None:
            return self.images.requests(number, shuffle)
        length, seed = len(self.images), self.images.seed
        blocks = shuffle == "blocks"
        order = self.images.order(number, shuffle) if blocks else permutation(length, seed, number)
        sums = np.cumsum(self._units[order])
        start = int(chance(seed, number, "", "sample weights") * int(sums[-1]))
        found = np.searchsorted(sums, _steps(int(sums[-1]), length, start), side="right")
        at = np.arange(length)
        first = np.r_[True, found[1:] != found[:-1]]
        occurrence = at - np.maximum.accumulate(np.where(first, at, 0))
        indices, epochs = order[found], number * self._occurrences + occurrence
        if blocks:
            return Requests(indices, epochs)
        mixed = permutation(length, seed, number, "occurrences") if shuffle else np.argsort(indices, kind="stable")
        return Requests(indices[mixed], epochs[mixed])


def _steps(total: int, count: int, start: int) -> NDArray[np.int64]:
    """Return (start + k * total) // count for k from 0 to count - 1, int64 [count], with no product above 2**63."""
    whole, rest = divmod(total, count)
    begin, begin_rest = divmod(start, count)
    at = np.arange(count)
    found: NDArray[np.int64] = begin + at * whole + (begin_rest + at * rest) // count
    return found


def _most(units: NDArray[np.int64]) -> int:
    """Return the most times that a sample can come in one pass."""
    return -(-len(units) * int(units.max()) // int(units.sum()))


def _checked_units(sample_weights: ArrayLike, images: RangeImages) -> NDArray[np.int64]:
    """Return sample weights as integers whose sum is below 2**62; a weight above 0 stays above 0."""
    try:
        weights = np.asarray(sample_weights, np.float64)
    except (TypeError, ValueError):
        raise BadConfig(f"sample weights must be numbers, found {type(sample_weights).__name__}") from None
    if weights.shape != (len(images),):
        raise BadConfig(f"there must be a sample weight for each of {len(images)} samples, found {weights.shape}")
    if not (np.isfinite(weights).all() and weights.min() >= 0 and weights.max() > 0):
        raise BadConfig(
            f"sample weights must be finite, at least 0 and not all 0, found {weights.min():g} to {weights.max():g}"
        )
    scaled = np.ldexp(weights / weights.max(), _UNIT_BITS - len(weights).bit_length())
    units: NDArray[np.int64] = np.rint(scaled).astype(np.int64)
    units[(units == 0) & (weights > 0)] = 1
    return units
