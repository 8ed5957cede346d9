"""Places on the template of the body as networks give them, three coordinates a pixel, and the template's points there.

A place is a position on the template at rest (`bodyseg_data.load_template`), less its middle, in units of half of its
height: so the coordinates are from -1 to 1, and a mirrored person's have the other sign across. Positions on a body at
rest are what others regress, too (Wang et al., "Normalized object coordinate space", 2019, for rigid things; Taylor et
al., "The Vitruvian manifold", 2012, for people).
"""

from __future__ import annotations

from functools import cache
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bodyseg_data import load_template
from bodyseg_data.bodies import NOWHERE

UNIT_M: Final = 0.9
"""A unit of places, metres."""

_MIDDLE_M: Final = (0.0, 0.9, 0.0)
_CUBE_M: Final = 0.008
_AROUND: Final = 6  # cubes beyond the outermost points


@cache
def place_table() -> NDArray[np.float32]:
    """The place of each point of the template, float32 [P, 3]."""
    found: NDArray[np.float32] = ((load_template().points - _MIDDLE_M) / UNIT_M).astype(np.float32)
    return found


class PointGrid(NamedTuple):
    """Cubes of space around the template, each with the number of a point: numbers, uint16 [X, Y, Z]; first: place of
    the corner of cube (0, 0, 0), float32 [3]; side: of a cube, in the unit of places.
    """

    numbers: NDArray[np.uint16]
    first: NDArray[np.float32]
    side: np.float32


@cache
def point_grid() -> PointGrid:
    """The point nearest to each cube of 8 mm, that of places within it up to so much; those beyond have the outermost
    cubes'.
    """
    from scipy.ndimage import distance_transform_edt

    places, side = place_table(), np.float32(_CUBE_M / UNIT_M)
    first = places.min(axis=0) - _AROUND * side
    cubes = ((places - first) / side).astype(np.intp)
    numbers = np.full(cubes.max(axis=0) + _AROUND + 1, NOWHERE, np.uint16)
    numbers[tuple(cubes.T)] = np.arange(len(places))
    nearest = distance_transform_edt(numbers == NOWHERE, return_distances=False, return_indices=True)
    return PointGrid(numbers[tuple(nearest)], first.astype(np.float32), side)
