"""Shapes of masks: growing and shrinking by squares, and filling of holes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]


def dilated(mask: Mask, radius: int) -> Mask:
    """Grow a mask by a square of 2 radius + 1 pixels a side, bool [H, W]."""
    grown: Mask = _counts(mask, radius) > 0
    return grown


def eroded(mask: Mask, radius: int) -> Mask:
    """Shrink a mask by such a square; the world outside the image counts as empty."""
    shrunk: Mask = _counts(mask, radius) == (2 * radius + 1) ** 2
    return shrunk


def closing(mask: Mask, radius: int) -> Mask:
    """Fill gaps narrower than such a square, bool [H, W]; nothing set is lost, also at the image's border."""
    padded = np.pad(mask, radius)
    return eroded(dilated(np.pad(padded, radius), radius), radius)[2 * radius : -2 * radius, 2 * radius : -2 * radius]


def opening(mask: Mask, radius: int) -> Mask:
    """Keep what such a square fits into, bool [H, W]."""
    return dilated(eroded(mask, radius), radius)


def box_sums(image: NDArray[np.float64], radius: int) -> NDArray[np.float64]:
    """Sums over squares of 2 radius + 1 pixels a side, float64 [H, W]; the world outside the image is 0."""
    padded = np.pad(image, ((radius + 1, radius), (radius + 1, radius)))
    total = padded.cumsum(0).cumsum(1)
    side = 2 * radius + 1
    sums: NDArray[np.float64] = (
        total[side:, side:] - total[:-side, side:] - total[side:, :-side] + total[:-side, :-side]
    )
    return sums


def holes(mask: Mask, outside: Mask) -> Mask:
    """The empty pixels that neither the image's border nor a pixel of `outside` reaches through empty ones.

    mask, outside: bool [H, W]. Steps go to the four neighbours.
    """
    free = np.pad(~mask, 1, constant_values=True)
    reached = np.zeros_like(free)
    reached[0] = reached[-1] = reached[:, 0] = reached[:, -1] = True
    reached[1:-1, 1:-1] |= outside & ~mask
    return ~_spread(reached, free)[1:-1, 1:-1] & ~mask


def connected(mask: Mask, pixel: int) -> Mask:
    """The pixels of a mask that steps to the four neighbours reach from one of them, a flat index; bool [H, W]."""
    reached = np.zeros_like(mask)
    reached.ravel()[pixel] = True
    return _spread(reached, mask)


def _spread(reached: Mask, free: Mask) -> Mask:
    """Grow `reached` in place through free pixels until nothing changes."""
    while True:
        before = np.count_nonzero(reached)
        for axis in (0, 1):
            for order in (slice(None), slice(None, None, -1)):
                view = (order, slice(None)) if axis == 0 else (slice(None), order)
                _flood(reached[view], free[view], axis)
        if np.count_nonzero(reached) == before:
            return reached


def _flood(reached: Mask, free: Mask, axis: int) -> None:
    """Carry `reached` along one axis, upwards in index, through free pixels as far as they go, in place."""
    count = reached.shape[axis]
    index = np.arange(1, count + 1).reshape((-1, 1) if axis == 0 else (1, -1))
    last_reached = np.maximum.accumulate(np.where(reached, index, 0), axis)
    last_wall = np.maximum.accumulate(np.where(free, 0, index), axis)
    reached |= free & (last_reached > last_wall)


def _counts(mask: Mask, radius: int) -> NDArray[np.int64]:
    return np.rint(box_sums(mask.astype(np.float64), radius)).astype(np.int64)
