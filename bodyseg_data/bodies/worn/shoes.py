"""Shoes: a closed solid around each foot, with a sole."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.bodies.contacts.limbs import Side
from bodyseg_data.bodies.worn.shells import hull_radius, ringed
from bodyseg_data.bodies.worn.wearer import Wearer
from bodyseg_data.core.errors import BadConfig
from bodyseg_data.meshes.solids import Solid

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Shoes:
    """A pair of shoes. upper_m: distance of their outside from the foot, metres. sole_m: thickness of the sole, metres.

    Raises BadConfig for a number out of its range.
    """

    upper_m: float
    sole_m: float

    def __post_init__(self) -> None:
        for name, high in (("upper_m", 0.02), ("sole_m", 0.05)):
            if not 0.002 <= getattr(self, name) <= high:
                raise BadConfig(f"the {name} of shoes must be 0.002 to {high:g}, found {getattr(self, name)!r}")


_SLICE_M: Final = 0.012
_BAND_M: Final = 0.018  # to each side of a slice
_FLAT_M: Final = 0.03  # above the ground at rest, below which skin is on the sole
_COLUMNS: Final = 40


def shoe(wearer: Wearer, shoes: Shoes, side: Side) -> Solid:
    """The shoe of one foot: convex slices from heel to toes, so that toes do not show."""
    from scipy.ndimage import gaussian_filter1d

    foot = wearer.of("foot", "toe", side=side)
    ankle = wearer.landmark(f"{side}t. Lateral Malleolus")[1]
    frame = wearer.frame(foot)
    foot &= wearer.rest[:, 1] < ankle
    rest = (wearer.points[foot] - frame.shift) @ frame.turn
    flat = rest[wearer.rest[foot][:, 1] < wearer.rest[foot][:, 1].min() + _FLAT_M]
    points = np.concatenate([rest, flat - np.array([0, shoes.sole_m, 0])])
    toes = rest[rest[:, 2] > np.quantile(rest[:, 2], 0.9)].mean(axis=0)
    heel = rest[rest[:, 2] < np.quantile(rest[:, 2], 0.1)].mean(axis=0)
    ahead = (toes - heel) * [1, 0, 1] / np.linalg.norm((toes - heel) * [1, 0, 1])
    axes = np.stack([np.cross([0.0, 1.0, 0.0], ahead), [0.0, 1.0, 0.0], ahead])
    local = points @ axes.T
    low, high = local[:, 2].min(), local[:, 2].max()
    angles = np.arange(_COLUMNS) * (2 * np.pi / _COLUMNS)
    ways = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    slices = np.arange(low + _BAND_M / 2, high, _SLICE_M)
    centres, radii = [], []
    for at in slices:
        section = local[np.abs(local[:, 2] - at) < _BAND_M, :2]
        centres.append((section.min(axis=0) + section.max(axis=0)) / 2)
        radii.append(hull_radius(section - centres[-1], ways) + shoes.upper_m)
    along = np.concatenate([[low - shoes.upper_m], slices, [high + shoes.upper_m]])
    middles = gaussian_filter1d(np.array([centres[0], *centres, centres[-1]]), 1.0, axis=0, mode="nearest")
    wide = gaussian_filter1d(np.array([0.6 * radii[0], *radii, 0.6 * radii[-1]]), 0.7, axis=0, mode="nearest")
    rings = np.concatenate(
        [middles[:, None] + wide[..., None] * ways, np.broadcast_to(along[:, None, None], (*wide.shape, 1))], axis=2
    )
    return ringed(frame(rings @ axes))
