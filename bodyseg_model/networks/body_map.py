"""Places on the template of the body as networks give them, three coordinates a pixel, and the template's points there.

A place is a position on the template at rest (`bodyseg_data.load_template`), less its middle, in units of half of its
height: so the coordinates are from -1 to 1, and a mirrored person's have the other sign across. Positions on a body at
rest are what others regress, too (Wang et al., "Normalized object coordinate space", 2019, for rigid things; Taylor et
al., "The Vitruvian manifold", 2012, for people).
"""

from functools import cache
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bodyseg_data import load_template
from bodyseg_data.labels import NOWHERE

UNIT_M: Final = 0.9
"""A unit of places, metres."""

_MIDDLE_M: Final = (0.0, 0.9, 0.0)
_CUBE_M: Final = 0.008
_AROUND: Final = 6  # cubes beyond the outermost points


@cache
def place_table() -> NDArray[np.float32]:
    """The place of each point of the template, float32 [P, 3]."""
    return ((load_template().points - _MIDDLE_M) / UNIT_M).astype(np.float32)


class PointGrids(NamedTuple):
    """Boxes of cubes of space around the template's parts, each cube with the number of a point of its part.

    numbers: uint16 [N], of all boxes, one after another. first: int64 [G], where each begins; shape: int64 [G, 3], its
    cubes along each axis; corner: float32 [G, 3], place of its first. side: of a cube, in the unit of places.
    """

    numbers: NDArray[np.uint16]
    first: NDArray[np.int64]
    shape: NDArray[np.int64]
    corner: NDArray[np.float32]
    side: np.float32


@cache
def point_grids(by_part: bool) -> PointGrids:
    """The point nearest to each cube of 8 mm, that of places within it up to so much; those beyond have the outermost
    cubes'. by_part: a grid for each of the 33 parts, in the order of labels; else one for all points.
    """
    from scipy.ndimage import distance_transform_edt

    places, side = place_table(), np.float32(_CUBE_M / UNIT_M)
    parts = load_template().parts if by_part else np.zeros(len(places), np.uint8)
    boxes, corners = [], []
    for label in range(int(parts.max()) + 1):
        own = np.flatnonzero(parts == label)
        corners.append(places[own].min(axis=0) - _AROUND * side)
        cubes = ((places[own] - corners[-1]) / side).astype(np.intp)
        box = np.full(cubes.max(axis=0) + _AROUND + 1, NOWHERE, np.uint16)
        box[tuple(cubes.T)] = own
        nearest = distance_transform_edt(box == NOWHERE, return_distances=False, return_indices=True)
        boxes.append(box[tuple(nearest)])
    first = np.cumsum([0, *(box.size for box in boxes[:-1])])
    shape = np.array([box.shape for box in boxes], np.int64)
    return PointGrids(np.concatenate([box.ravel() for box in boxes]), first, shape, np.array(corners, np.float32), side)
