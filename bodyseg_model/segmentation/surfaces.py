"""Connected surfaces of a range image: neighbouring pixels whose ranges do not jump."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

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

Floats = NDArray[np.float32]
Mask = NDArray[np.bool_]
Indices = NDArray[np.intp]


def connected_surfaces(range_m: NDArray[np.float32], focal_px: float) -> NDArray[np.int32]:
    """The surface that each pixel of a range image [H, W], metres, lies on, int32 [H, W], -1 where range is 0.

    Surfaces are numbered from 0 by their first pixel in reading order. focal_px: of the camera that took the image.
    """
    rows, columns = range_m.shape
    # With an empty margin on the left and below, neighbours are a fixed step apart in flat memory, and no row runs into
    # the next.
    framed = np.zeros((rows + GAP_PIXELS, GAP_PIXELS + columns), np.float32)
    framed[:rows, GAP_PIXELS:] = range_m
    stride, level = framed.shape[1], _jumps(framed).ravel()
    measured = level < np.inf
    # Pixels that follow each other in a row make runs; what is joined afterwards is runs, which are few.
    begins = measured.copy()
    begins[1:] &= ~_near(level, 1)
    begins[_ends_of_shadows(framed.ravel(), level, stride, focal_px)] = False
    run = np.cumsum(begins, dtype=np.int32) - np.int32(1)
    pairs = [*_pairs_in_rows(level, begins), *_pairs_in_columns(level, begins, stride)]
    joined = np.concatenate([_without_doubles(run[pixels]) for pixels in pairs], axis=1)
    surface = np.append(_joined(int(np.count_nonzero(begins)), joined), np.int32(-1))
    run[~measured] = -1
    surfaces: NDArray[np.int32] = surface[run].reshape(-1, stride)[:rows, GAP_PIXELS:]
    return surfaces


def _jumps(range_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """Distances of ranges in jumps, inf for 0: two are on one surface if their answers differ by at most one."""
    far = JUMP_M / JUMP_SHARE
    with np.errstate(divide="ignore"):
        near = np.where(range_m > 0, range_m / JUMP_M, np.inf)
        jumps = np.where(range_m <= far, near, (1 + np.log(range_m / far)) / JUMP_SHARE)
    return np.asarray(jumps, np.float32)


def _near(level: Floats, shift: int) -> Mask:
    """Compare pixels `shift` apart: True if they are on one surface, bool [N - shift]; level: [N], of `_jumps`."""
    with np.errstate(invalid="ignore"):  # nothing less nothing
        near: Mask = np.abs(level[shift:] - level[:-shift]) <= 1
    return near


def _ends_of_shadows(range_m: Floats, level: Floats, stride: int, focal_px: float) -> Indices:
    """The first pixels to the right of holes that do not part a surface, flat indices."""
    measured = range_m > 0
    # Measured pixels begin and end in turns: holes lie between an end and the next beginning.
    changes = np.flatnonzero(measured[1:] != measured[:-1])
    before, behind = changes[1:-1:2], changes[2::2] + 1
    hole = before // stride == behind // stride
    before, behind = before[hole], behind[hole]
    widest = np.maximum(SHADOW_M * focal_px / np.minimum(range_m[before], range_m[behind]), GAP_PIXELS)
    joined: Indices = behind[(behind - before <= widest) & (np.abs(level[behind] - level[before]) <= 1)]
    return joined


def _pairs_in_rows(level: Floats, begins: Mask) -> Iterator[Indices]:
    """Pixels 2 to `GAP_PIXELS` apart in a row, on one surface and not of one run, [2, N]."""
    starts = np.flatnonzero(begins)
    for shift in range(2, GAP_PIXELS + 1):
        first = (starts[:, None] - np.arange(1, shift + 1)).ravel()
        with np.errstate(invalid="ignore"):  # nothing less nothing
            first = first[np.abs(level[first + shift] - level[first]) <= 1]
        yield np.stack([first, first + shift])


def _pairs_in_columns(level: Floats, begins: Mask, stride: int) -> Iterator[Indices]:
    """Pixels 1 to `GAP_PIXELS` apart in a column and on one surface, [2, N].

    Pixels whose runs are those of the pixels before them are left out, and so are those that single steps join.
    """
    steps = _near(level, stride)
    stairs = steps
    for shift in range(stride, GAP_PIXELS * stride + 1, stride):
        if shift == stride:
            near = steps
        else:
            stairs = stairs[:-stride] & steps[shift - stride :]
            near = _near(level, shift) & ~stairs
        new = near.copy()
        new[1:] &= ~near[:-1] | begins[1:-shift] | begins[shift + 1 :]
        first = np.flatnonzero(new)
        yield np.stack([first, first + shift])


def _without_doubles(pairs: NDArray[np.int32]) -> NDArray[np.int32]:
    """Pairs [2, N] without those that are equal to the one before."""
    new = np.ones(pairs.shape[1], np.bool_)
    new[1:] = (pairs[:, 1:] != pairs[:, :-1]).any(axis=0)
    return pairs[:, new]


def _joined(count: int, pairs: NDArray[np.int32]) -> NDArray[np.int32]:
    """The group of each of `count` things once all `pairs` [2, N] are joined, int32 [count].

    Groups are numbered by their lowest member. Every round hooks each group's root to the lowest root it touches and
    then lets everything point at its root, so that rounds are few however long the chains.
    """
    root = np.arange(count)
    lower, upper = pairs
    while len(lower):
        a, b = root[lower], root[upper]
        apart = a != b
        lower, upper, a, b = lower[apart], upper[apart], a[apart], b[apart]
        np.minimum.at(root, np.maximum(a, b), np.minimum(a, b))
        while not np.array_equal(higher := root[root], root):
            root = higher
    number = np.cumsum(root == np.arange(count), dtype=np.int32) - np.int32(1)
    return np.asarray(number[root], np.int32)
