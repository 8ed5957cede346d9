"""What a training reads: images of one size, or of several that take turns, batch by batch."""

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bodyseg_data import Mixture, RangeImages
from bodyseg_data.core import BadConfig
from bodyseg_data.loading import Batch, ImageSet, Loader, loader
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
        pairs = isinstance(parts, list | tuple) and all(isinstance(part, tuple) and len(part) == 2 for part in parts)
        if not pairs or not parts or not all(isinstance(part[0], ImageSet) for part in parts):
            found = type(images).__name__
            raise BadConfig(f"images must be RangeImages, a Mixture or a list of (images, weight), found {found}")
        self.images: tuple[ImageSet, ...] = tuple(part[0] for part in parts)
        self.weights = tuple(part[1] for part in parts)
        if not (all(0 <= weight < math.inf for weight in self.weights) and any(self.weights)):
            rule = "must be finite, at least 0 and not all 0"
            raise BadConfig(f"weights of images that take turns {rule}, found {self.weights}")
        self._shares = np.array(self.weights) / sum(self.weights)
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
        """Mean number of pixels of each class, [C], in clean samples of all images, each in its share."""
        found: NDArray[np.float64] = self._shares @ np.stack([class_pixels(each) for each in self.images])
        return found

    def loader(self, *args: Any, **options: Any) -> "TurnLoader":
        """Loaders of all images, whose other arguments are those of `loader`."""
        return TurnLoader([loader(each, *args, **options) for each in self.images], self._shares)


class TurnLoader:
    """Iterates over the batches of several loaders without end, pass after pass of each."""

    def __init__(self, loaders: Sequence[Loader], shares: NDArray[np.float64]) -> None:
        self.loaders, self._shares = loaders, shares
        self._given = np.zeros(len(loaders), np.int64)

    def stats(self) -> dict[str, float]:
        """Times and counts of all loaders together, as of `Loader.stats`."""
        every = [each.stats() for each in self.loaders]
        return {name: sum(each[name] for each in every) for name in every[0]}

    def state_dict(self) -> dict[str, Any]:
        """Progress so far as plain JSON."""
        return {"given": self._given.tolist(), "loaders": [each.state_dict() for each in self.loaders]}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on after the last batch that `state` counts. Raises BadConfig for one of other images."""
        self._given = np.array(state["given"])
        for each, own in zip(self.loaders, state["loaders"], strict=True):
            each.load_state_dict(own)

    def __iter__(self) -> Iterator[Batch]:
        streams = [itertools.chain.from_iterable(itertools.repeat(each)) for each in self.loaders]
        while True:
            behind = int(np.argmax(self._shares * (self._given.sum() + 1) - self._given))
            self._given[behind] += 1
            yield next(streams[behind])


def mixed(
    sets: Sequence[RangeImages], weights: Sequence[float], samples: int | None, seed: int
) -> ImageSet | list[Weighted]:
    """Return the one set, or a `Mixture` of several, whose samples and seed are those given; of images that differ in
    size, (images, weight) of those of each size, which take turns.

    weights: of the sets; none for the numbers of their samples, so that all samples come equally often. Raises
    BadConfig for another number of weights than of sets, and as `Mixture`.
    """
    if weights and len(weights) != len(sets):
        raise BadConfig(f"--weights needs a number for each set by each sensor, {len(sets)}, found {len(weights)}")
    parts = [*zip(sets, map(float, weights or map(len, sets)), strict=True)]
    total, found = sum(weight for _, weight in parts), list[Weighted]()
    for size in dict.fromkeys(images.shape for images in sets):
        same = [part for part in parts if part[0].shape == size]
        weight = sum(weight for _, weight in same)
        if total > 0 and not any(weight for _, weight in same):
            continue
        mixture = Mixture(same, samples and max(1, round(samples * weight / (total or 1))), seed)  # checks all weights
        found.append((same[0][0] if len(same) == 1 and samples is None else mixture, weight))
    return found[0][0] if len(found) == 1 else found
