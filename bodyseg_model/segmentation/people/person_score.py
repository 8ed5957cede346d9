"""A score that tells people from things by the shape of a surface, before a network labels it.

So it goes with any network, whatever classes it has, and no network is shown a thing. A small network of its own judges
the shape; `tools/bench shapes` fits it on made rooms, and `tools/bench things` counts whom it finds in others
(docs/reference/things.md).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.rig import Camera
from bodyseg_model.segmentation.people.shape_network import shipped_shape_network
from bodyseg_model.segmentation.people.surface_shape import SurfaceShape, surface_shape

ByShape = Callable[[SurfaceShape], float]
"""Gives the logarithm of the odds that a surface of this shape is a person."""


@dataclass(frozen=True)
class PersonScore:
    """Probability that a surface is a person, by its shape.

    by_shape: judges shapes. cutoff: least probability of a person, 0 to 1. Raises BadConfig for a cutoff out of range.
    """

    by_shape: ByShape = field(repr=False)
    cutoff: float

    def __post_init__(self) -> None:
        if not 0 <= self.cutoff <= 1:
            raise BadConfig(f"a score of people needs a cutoff from 0 to 1, found {self.cutoff:g}")

    def __call__(self, pixels: NDArray[np.intp], range_m: NDArray[np.float32], camera: Camera) -> float:
        """Score one surface, 0 to 1. Arguments as of `surface_shape`."""
        odds = self.by_shape(surface_shape(pixels, range_m, camera))
        return 1 / (1 + math.exp(-min(max(odds, -700.0), 700.0)))


def shipped_score() -> PersonScore:
    """The score that ships with the package. Raises as `shipped_shape_network`."""
    network = shipped_shape_network()
    return PersonScore(network, network.cutoff)
