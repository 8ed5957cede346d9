"""Images of a training: those of one set, or a mixture of several."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from bodyseg_data import Mixture, RangeImages
from bodyseg_data.core.errors import BadConfig
from bodyseg_data.loading.image_set import ImageSet


def open_data(
    addresses: Sequence[str],
    weights: Sequence[float],
    samples: int | None,
    seed: int,
    open_set: Callable[[str], RangeImages],
) -> ImageSet:
    """Return the one set that `addresses` name, or a mixture of several.

    weights: of the sets in a mixture; none for the numbers of their samples, so that all samples come equally often.
    samples: in an epoch of a mixture, None for the sum of the sets' lengths. seed: of the order in which sets are
    mixed. open_set: opens one set. Raises BadConfig for another number of weights than of sets, and as `Mixture`.
    """
    if weights and len(weights) != len(addresses):
        raise BadConfig(f"--weights needs a number for each of {len(addresses)} sets in --data, found {len(weights)}")
    sets = [open_set(address) for address in addresses]
    if len(sets) == 1 and samples is None:
        return sets[0]
    parts = zip(sets, weights or [len(images) for images in sets], strict=True)
    return Mixture([(images, float(weight)) for images, weight in parts], samples, seed)
