"""What a training reads: images of one size, or of several that take turns, batch by batch."""

import itertools
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bodyseg_data import Mixture, RangeImages
from bodyseg_data.core import BadConfig
from bodyseg_data.loading import Batch, ImageSet, Loader, Shares, loader, read_schedule
from bodyseg_model.training.loss import class_pixels

Weighted = tuple[ImageSet, float]
"""(images, weight) of images that take turns with others."""


class Turns:
    """Images that take turns: each batch is of one of them. The batches of each are in proportion to its weight, to
    within one batch for any number of batches from the first.

    images: one set or mixture, or (images, weight) of several. sets: all sets of shards that are read.

    Raises BadConfig for weights that are negative, not finite or all 0.
    """

    def __init__(self, images: ImageSet | Sequence[Weighted]) -> None:
        parts = [(images, 1.0)] if isinstance(images, ImageSet) else images
        if not isinstance(parts, list | tuple) or not parts or not all(map(_is_weighted, parts)):
            found = type(images).__name__
            raise BadConfig(f"images must be RangeImages, a Mixture or a list of (images, weight), found {found}")
        self.images: tuple[ImageSet, ...] = tuple(part[0] for part in parts)
        self.weights = tuple(part[1] for part in parts)
        self._shares = Shares([*map(read_schedule, self.weights)], 1)  # epochs of one batch
        self.label_map = self.images[0].label_map
        self.sets: tuple[RangeImages, ...] = tuple(one for each in self.images for one in each.sets)
        self.variant = ", ".join(dict.fromkeys(each.variant for each in self.sets))

    def identity(self) -> dict[str, Any]:
        """All that the batches depend on besides their order, as plain JSON."""
        if len(self.images) == 1:
            return dict(self.images[0].identity())
        parts = zip(self.images, self.weights, strict=True)
        return {"turns": [{"weight": weight, **images.identity()} for images, weight in parts]}

    def class_pixels(self) -> NDArray[np.float64]:
        """Pixels of each class, [C], in clean samples spread evenly over all images, each in its share."""
        shares = np.array(self.weights) / sum(self.weights)
        found: NDArray[np.float64] = shares @ np.stack([class_pixels(each) for each in self.images])
        return found

    def loader(self, *args: Any, **options: Any) -> "TurnLoader":
        """Loaders of all images, whose other arguments are those of `loader`."""
        return TurnLoader([loader(each, *args, **options) for each in self.images], self._shares)


def _is_weighted(part: Any) -> bool:
    return isinstance(part, tuple) and len(part) == 2 and isinstance(part[0], ImageSet)


class TurnLoader:
    """Iterates over the batches of several loaders without end, pass after pass of each."""

    def __init__(self, loaders: Sequence[Loader], shares: Shares) -> None:
        self.loaders, self._shares = loaders, shares
        self._taken = 0

    def stats(self) -> dict[str, float]:
        """Times and counts of all loaders together, as of `Loader.stats`."""
        sums: Counter[str] = Counter()
        for each in self.loaders:
            sums.update(each.stats())
        return dict(sums)

    def state_dict(self) -> dict[str, Any]:
        """Progress so far as plain JSON; of one loader, its own."""
        states = [each.state_dict() for each in self.loaders]
        return states[0] if len(states) == 1 else {"taken": self._taken, "loaders": states}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on after the last batch that `state` counts. Raises BadConfig for one of other images."""
        states = state.get("loaders", [state])
        self._taken = state.get("taken", 0)
        for each, own in zip(self.loaders, states, strict=True):
            each.load_state_dict(own)

    def __iter__(self) -> Iterator[Batch]:
        streams = [itertools.chain.from_iterable(itertools.repeat(each)) for each in self.loaders]
        while True:
            before, after = self._shares.before(self._taken), self._shares.before(self._taken + 1)
            self._taken += 1
            yield next(streams[[*map(int.__sub__, after, before)].index(1)])


def mixed(
    sets: Sequence[RangeImages], weights: Sequence[float], samples: int | None, seed: int
) -> ImageSet | list[Weighted]:
    """Return the one set, or a `Mixture` of several, whose samples and seed are those given; of images that differ in
    size, (images, weight) of those of each size, which take turns.

    weights: of the sets; none for the numbers of their samples, so that all samples come equally often. Raises
    BadConfig for another number of weights than of sets, and as `Mixture`.
    """
    if weights and len(weights) != len(sets):
        raise BadConfig(
            f"--weights needs a number for each set by each sensor, {len(sets)} in all, found {len(weights)}"
        )
    parts = [*zip(sets, map(float, weights or map(len, sets)), strict=True)]
    sizes = {images.shape: [part for part in parts if part[0].shape == images.shape] for images in sets}
    sums = [sum(weight for _, weight in same) for same in sizes.values()]
    found = [
        (_of_one_size(same, samples and max(1, round(samples * total / sum(sums))), seed), total)
        for same, total in zip(sizes.values(), sums, strict=True)
    ]
    return found[0][0] if len(found) == 1 else found


def _of_one_size(parts: Sequence[tuple[RangeImages, float]], samples: int | None, seed: int) -> ImageSet:
    mixture = Mixture(parts, samples, seed)  # also of one set, whose weight it checks
    return parts[0][0] if len(parts) == 1 and samples is None else mixture
