"""Intervals of a mean or an accuracy over people or poses: the bootstrap, drawn by groups that are alike."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

_DRAWS: Final = 1000
_SHARE: Final = 0.95
_SEED: Final = 17


def interval(groups: Sequence[NDArray[Any]], score: Callable[[NDArray[Any]], float]) -> list[float] | None:
    """Return the 95 % interval of `score` of the sum of `groups`, drawn with replacement; None for fewer than two.

    groups: arrays of one shape, such as counts of pixels, one for each person, pose, body or image. The percentile
    method of Efron (1979), 1000 draws, the same ones every time.
    """
    if len(groups) < 2:
        return None
    stacked = np.stack(groups)
    drawn = np.random.default_rng(_SEED).multinomial(len(groups), np.full(len(groups), 1 / len(groups)), _DRAWS)
    scores = [score(np.tensordot(weights, stacked, 1)) for weights in drawn]
    low, high = np.nanquantile(scores, ((1 - _SHARE) / 2, (1 + _SHARE) / 2))
    return [round(float(low), 4), round(float(high), 4)]


def summed(groups: Mapping[Any, NDArray[Any]], name: Callable[[Any], str]) -> dict[str, NDArray[Any]]:
    """Add up the arrays whose keys have one `name`, in the order of the names' first appearance."""
    found: dict[str, NDArray[Any]] = {}
    for key, array in groups.items():
        found[name(key)] = found[name(key)] + array if name(key) in found else array
    return found
