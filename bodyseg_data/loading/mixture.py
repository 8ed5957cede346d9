"""Mixture of several sets of shards with weights, read by the same loader as one set (docs/how-to/mixtures.md).

The sets are served one after the other: each gets its share of what those before it left, and the last one gets the
rest. A share is rounded over all epochs so far, not in each epoch anew: what a set lacks in one epoch, it gets in the
next. All of it is integer arithmetic, so an epoch gets the same numbers on every machine and in whatever order epochs
are asked for. A set gives its samples pass after pass, each in an order of its own.
"""

import bisect
import hashlib
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bodyseg_data.artifacts import RangeImage
from bodyseg_data.core import BadConfig, BadShard, Draws, check_epoch, check_int, check_seed
from bodyseg_data.loading.image_set import ImageSet, Labels, Range, Request, Requests, Shuffle, check_index
from bodyseg_data.loading.range_images import RangeImages
from bodyseg_data.loading.selection import permutation
from bodyseg_data.samples import Sample
from bodyseg_data.shards import Place

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

    def _weights(self, epoch: int) -> list[float]:
        return [each.at(epoch) for each in self.schedules]

    def before(self, epoch: int) -> list[int]:
        """Return the number of samples that each set has given before `epoch`, K numbers.

        Takes a step for every epoch up to the last knot of a schedule and one for all epochs after it.
        """
        sums, given = [0] * len(self.schedules), [0] * len(self.schedules)
        for each in range(min(epoch, self.constant_from)):
            self._add(sums, given, each, 1)
        if epoch > self.constant_from:
            self._add(sums, given, self.constant_from, epoch - self.constant_from)
        return given

    def _add(self, sums: list[int], given: list[int], epoch: int, epochs: int) -> None:
        """Divide the samples of `epochs` epochs with the weights of `epoch`.

        sums: exact shares so far, in units of 2**-53 samples. given: these rounded; the last set has what is left.
        """
        weights = self._weights(epoch)
        left = self.samples * epochs
        for number, weight in enumerate(weights):
            rest = math.fsum(weights[number:])
            share = round(weight / rest * 2**_BITS) if rest else 0
            sums[number] += left * share
            whole = (sums[number] + _HALF) >> _BITS
            left -= whole - given[number]
            given[number] = whole


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
        self._units: NDArray[np.int64] | None = None
        self.digest: str | None = None
        """Digest of the sample weights, up to a common factor; None without any."""
        self._occurrences = 1  # of a sample in one pass, at most
        if sample_weights is not None:
            self._units = _checked_units(sample_weights, images)
            self.digest = hashlib.blake2b(self._units.astype("<i8").tobytes(), digest_size=16).hexdigest()
            self._occurrences = -(-len(images) * int(self._units.max()) // int(self._units.sum()))
        self._held: tuple[int, Shuffle, Requests] | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_held": None}  # a spawned worker makes no order

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
        return np.searchsorted(sums, at, side="right")

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
        start = int(Draws(seed, number, "").chance("sample weights") * int(sums[-1]))
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
    return begin + at * whole + (begin_rest + at * rest) // count


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


Part = tuple[RangeImages, Weight] | tuple[RangeImages, Weight, ArrayLike]
"""(images, weight) or (images, weight, sample weights) of one set of a mixture."""

_AGREEING: Final = {"shape": "images of one size", "step_m": "one step of range", "planes": "the same planes"}


class Mixture(ImageSet):
    """Several sets as one: every epoch has `samples` samples, and each set gives its share of them. `len()` is exact.

    sets: (images, weight) of each set, or (images, weight, sample weights). A weight is a number, or knots (epoch,
    weight), between which it changes along straight lines; before the first and after the last it is constant. Sample
    weights, float [len(images)], say how often samples come in comparison with each other.
    samples: number in an epoch; None for the sum of the sets' lengths. epoch: the first epoch.
    seed: of the order in which the sets are mixed; the order within a set, and all draws, have the seed of its images.

    Shares of an epoch are whole samples with an exact sum, rounded over all epochs so far: with constant weights, one
    of K sets has given samples * weight / sum of weights for each epoch so far, to within (K - 1) / 2 samples.

    A set gives its samples pass after pass, each in another order, and goes on in an epoch where it stopped in the one
    before. So over the epochs all its samples come equally often, or as their weights say. The number of the pass is
    the epoch of the draws: a set that is passed several times in one epoch has other draws each time. With sample
    weights, a sample comes in each pass floor or ceil of its expected number of times, always with other draws.

    Indices are those of the stored samples, one set after the other. `mixture[i]` is the sample at position i of the
    epoch last set, in the order of a loader.

    Raises BadConfig for sets whose images differ in size, step, planes or classes (`labels` can make classes the same),
    for weights that are negative, not finite or all 0 in some epoch, and for sample weights that do not fit.
    """

    def __init__(self, sets: Sequence[Part], samples: int | None = None, seed: int = 0, epoch: int = 0) -> None:
        parts = _checked_parts(sets)
        self._sets: tuple[RangeImages, ...] = tuple(part[0] for part in parts)
        first, self.seed = self.sets[0], check_seed(seed)
        self.step_m, self.shape, self.label_map, self.planes = first.step_m, first.shape, first.label_map, first.planes
        """As of all sets; label maps of others have the same classes."""
        self._streams = [SetStream(part[0], *part[2:]) for part in parts]
        self._starts = list(itertools.accumulate(map(len, self.sets), initial=0))
        self._samples = self._starts[-1] if samples is None else check_int("samples", samples, 1)
        self._shares = Shares([read_schedule(part[1]) for part in parts], self._samples)
        self._held: tuple[int, Shuffle, Requests] | None = None
        self.variant = ", ".join(dict.fromkeys(images.variant for images in self.sets))
        splits = {images.split for images in self.sets}
        self.split = splits.pop() if len(splits) == 1 else None
        self.set_epoch(epoch)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_held": None}  # workers get requests, and need no order

    @property
    def sets(self) -> tuple[RangeImages, ...]:
        """The sets, in their order."""
        return self._sets

    @property
    def keys(self) -> list[str]:
        """Keys of all stored samples, the sets one after the other."""
        return [key for images in self.sets for key in images.keys]

    def __len__(self) -> int:
        return self._samples

    def __repr__(self) -> str:
        sets = ", ".join(
            f"({images!r}, {weight.to_json()!r}{', sample weights' if stream.digest else ''})"
            for images, weight, stream in zip(self.sets, self._shares.schedules, self._streams, strict=True)
        )
        return f"Mixture([{sets}], samples={len(self)}, seed={self.seed}, epoch={self.epoch})"

    def counts(self, epoch: int) -> list[int]:
        """Return the number of samples that each set gives to an epoch."""
        before, after = self._shares.before(check_epoch(epoch)), self._shares.before(epoch + 1)
        return [end - start for start, end in zip(before, after, strict=True)]

    def requests(self, epoch: int, shuffle: Shuffle = True) -> Requests:
        """Return the samples of an epoch in the order of a pass: a function of the seeds and the epoch alone.

        shuffle: False gives one set after the other, each in stored order; "blocks" mixes the sets and leaves the
        samples of each in its order by blocks. No other epoch is computed: every epoch takes the same time, but for a
        few microseconds for each epoch before the last knot of a schedule.
        """
        if self._held is None or self._held[:2] != (epoch, shuffle):
            self._held = None
            self._held = (epoch, shuffle, self._new_requests(check_epoch(epoch), shuffle))
        return self._held[2]

    def _new_requests(self, epoch: int, shuffle: Shuffle) -> Requests:
        starts, counts = self._shares.before(epoch), self.counts(epoch)
        indices, epochs = np.empty(len(self), np.int64), np.empty(len(self), np.int64)
        end = 0
        for stream, start, count, offset in zip(self._streams, starts, counts, self._starts[:-1], strict=True):
            given = stream.take(start, count, shuffle)
            np.add(given.indices[:], offset, out=indices[end : end + count])
            epochs[end : end + count] = given.epochs
            end += count
        if not shuffle:
            return Requests(indices, epochs)
        mixed = permutation(len(self), self.seed, epoch, "mixture")
        if shuffle == "blocks":  # sets take the same turns as without blocks
            mixed[np.argsort(np.searchsorted(np.cumsum(counts), mixed, side="right"), kind="stable")] = np.arange(end)
        return Requests(indices[mixed], epochs[mixed])

    def evenly_sampled(self, count: int) -> NDArray[np.int64]:
        """Return indices of about `count` samples that stand for the whole, int64 [M]: from each set in its share.

        The share is that of all epochs up to the last knot of a schedule.
        """
        given = self._shares.before(self._shares.constant_from + 1)
        total = sum(given)
        numbers = [max(1, round(count * each / total)) if each else 0 for each in given]
        parts = zip(self._streams, numbers, self._starts, strict=False)
        return np.concatenate([stream.evenly_sampled(n) + offset for stream, n, offset in parts])

    def clean(self, index: int) -> Sample:
        """Return the stored sample, without artifacts."""
        images, within = self._where(index)
        return images.clean(within)

    def image(self, index: int, epoch: int) -> RangeImage:
        """Return a stored sample with artifacts and transforms as its set draws them in `epoch`, as 16-bit arrays."""
        images, within = self._where(index)
        return images.image(within, epoch)

    def write(self, index: int, epoch: int, image: Range, labels: Labels, planes: Sequence[NDArray[Any]] = ()) -> None:
        """Write the arrays of `image` into given ones [H, W]. Raises BadShard, naming the set, for a bad sample."""
        images, within = self._where(index)
        given = dict(zip(self.planes, planes, strict=False))  # a set may have been asked for them in another order
        try:
            images.write(within, epoch, image, labels, [given[name] for name in images.planes] if planes else ())
        except BadShard as error:
            raise BadShard(f"{images.path}/{error}") from error

    def __getitem__(self, index: int | Request) -> dict[str, Any]:
        """Return one sample: range float32 [1, H, W] in metres, labels uint8 [H, W], key.

        index: a position in the epoch last set in this process, or (epoch of the draws, index) as `batches` yields.
        """
        if isinstance(index, tuple) and len(index) == 2:
            epoch, stored = index
        else:
            position = check_index(index, len(self))
            ((epoch, stored),) = self.requests(self.epoch, self.split == "train").part(position, position + 1)
        images, within = self._where(stored)
        return images[epoch, within]

    def location(self, index: int) -> tuple[str, str, int]:
        """Return (path of the set and name of the shard, key, byte offset in the shard) of a stored sample."""
        images, within = self._where(index)
        shard, key, offset = images.location(within)
        return f"{images.path}/{shard}", key, offset

    def places(self, index: int) -> list[Place]:
        images, within = self._where(index)
        return images.places(within)

    def _where(self, index: int) -> tuple[RangeImages, int]:
        """Return the set of a stored sample, and its index there."""
        number = check_index(index, self._starts[-1])
        which = bisect.bisect_right(self._starts, number) - 1
        return self.sets[which], number - self._starts[which]

    def identity(self) -> dict[str, Any]:
        """Return all that batches depend on besides their order, as plain JSON."""
        sets = zip(self.sets, self._shares.schedules, self._streams, strict=True)
        return {
            "mixture": [
                {
                    "weight": weight.to_json(),
                    **({"sample_weights": stream.digest} if stream.digest else {}),
                    **images.identity(),
                }
                for images, weight, stream in sets
            ],
            "seed": self.seed,
        }


def _checked_parts(sets: Any) -> list[tuple[Any, ...]]:
    """Return the parts of a mixture, whose images agree in all that a batch needs. Raises BadConfig."""
    if not isinstance(sets, Sequence) or isinstance(sets, str) or not sets:
        raise BadConfig(f"a mixture needs a list of (images, weight), found {sets!r}")
    for part in sets:
        if not isinstance(part, tuple) or len(part) not in (2, 3):
            raise BadConfig(
                f"a set of a mixture must be (images, weight) or (images, weight, sample weights), found {part!r}"
            )
        if not isinstance(part[0], RangeImages):
            raise BadConfig(f"a set of a mixture must be RangeImages, found {type(part[0]).__name__}")
    first = sets[0][0]
    for images, *_ in sets[1:]:
        for name, what in _AGREEING.items():
            one, other = getattr(first, name), getattr(images, name)
            if one != other:
                raise BadConfig(f"a mixture needs {what}: {first.path} has {one!r}, {images.path} has {other!r}")
        differing = first.label_map.difference(images.label_map)
        if differing is not None:
            raise BadConfig(f"a mixture needs one label map: {first.path} and {images.path} have {differing}")
    return list(sets)
