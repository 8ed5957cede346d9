"""Which pixels of a range image lie on one surface: neighbours whose ranges do not jump."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

GAP_PIXELS: Final = 3
"""Pixels this far apart in a row or column are neighbours, so that single missing ones part nothing."""

JUMP_M: Final = 0.1
"""Neighbours are on one surface if their ranges differ by no more than this."""

JUMP_SHARE: Final = 0.04
"""Or, beyond 2.5 m, by no more than about this share of them: sensors are coarser the farther they look."""


SHADOW_M: Final = 0.15
"""Pixels of a row are neighbours, too, if nothing was measured between them and they are no farther apart than this at
the nearer one's range: an arm's shadow does not part the trunk that it falls on."""


def connected_surfaces(range_m: NDArray[np.float32], focal_px: float) -> NDArray[np.int32]:
    """The surface that each pixel of a range image [H, W], metres, lies on, int32 [H, W], -1 where range is 0.

    Surfaces are numbered from 0 by their first pixel in reading order. focal_px: of the camera that took the image.
    """
    # A frame of nothing on the right and below, so that no neighbour is sought in the next row.
    level = np.pad(_jumps(range_m), ((0, GAP_PIXELS), (0, GAP_PIXELS)), constant_values=np.inf)
    stride, level = level.shape[1], level.ravel()
    pixels = np.flatnonzero(level < np.inf)
    # What follows each other in a row makes runs; what is joined afterwards is runs, which are few.
    reach = np.maximum(SHADOW_M * focal_px / range_m[range_m > 0], GAP_PIXELS)
    begins = np.ones(len(pixels), np.bool_)
    begins[1:] = (
        (np.diff(pixels // stride) > 0)
        | (np.abs(np.diff(level[pixels])) > 1)
        | (np.diff(pixels) > np.maximum(reach[1:], reach[:-1]))
    )
    run = np.full(level.size, -1, np.int32)
    run[pixels] = np.cumsum(begins, dtype=np.int32) - 1
    shifts = [*range(2, GAP_PIXELS + 1), *range(stride, GAP_PIXELS * stride + 1, stride)]
    pairs = np.concatenate([_touching(level, run, shift) for shift in shifts])
    surfaces = np.full(level.size, -1, np.int32)
    surfaces[pixels] = _joined(int(np.count_nonzero(begins)), pairs)[run[pixels]]
    return surfaces.reshape(-1, stride)[: range_m.shape[0], : range_m.shape[1]]


def _jumps(range_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """How many jumps away ranges are, inf for 0: two are on one surface if their answers differ by at most one."""
    far = JUMP_M / JUMP_SHARE
    with np.errstate(divide="ignore"):
        near = np.where(range_m > 0, range_m / JUMP_M, np.inf)
        jumps = np.where(range_m <= far, near, (1 + np.log(range_m / far)) / JUMP_SHARE)
    return np.asarray(jumps, np.float32)


def _touching(level: NDArray[np.float32], run: NDArray[np.int32], shift: int) -> NDArray[np.int32]:
    """Pairs of runs [N, 2] that hold pixels `shift` apart on one surface; most doubles are left out."""
    with np.errstate(invalid="ignore"):  # nothing less nothing
        near = np.flatnonzero(np.abs(level[shift:] - level[:-shift]) <= 1)
    first, second = run[near], run[near + shift]
    new = first != second
    new[1:] &= (first[1:] != first[:-1]) | (second[1:] != second[:-1])
    return np.stack([first[new], second[new]], axis=1)


def _joined(count: int, pairs: NDArray[np.integer[Any]]) -> NDArray[np.int32]:
    """Which group each of `count` things is in once all `pairs` [N, 2] are joined, int32 [count].

    Groups are numbered by their lowest member. Every round hooks each group's root to the lowest root it touches and
    then lets everything point at its root, so that rounds are few however long the chains.
    """
    root = np.arange(count)
    lower, upper = pairs[:, 0], pairs[:, 1]
    while len(lower):
        a, b = root[lower], root[upper]
        apart = a != b
        lower, upper, a, b = lower[apart], upper[apart], a[apart], b[apart]
        np.minimum.at(root, np.maximum(a, b), np.minimum(a, b))
        while not np.array_equal(higher := root[root], root):
            root = higher
    number = np.cumsum(root == np.arange(count), dtype=np.int32) - np.int32(1)
    return np.asarray(number[root], np.int32)
