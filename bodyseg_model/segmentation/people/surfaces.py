"""Connected surfaces of a range image: neighbouring pixels of similar range."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from importlib import import_module
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.kernels import use_compiled
from bodyseg_data.core.system.divided_work import of_each, pieces

GAP_PIXELS: Final = 3
"""Greatest distance of neighbours in a row or column, pixels, so that single missing pixels divide no surface."""

JUMP_M: Final = 0.1
"""Greatest difference of range between neighbours on one surface, metres."""

JUMP_SHARE: Final = 0.04
"""The same beyond 2.5 m, as a share of the range, about: sensors are coarser at a distance."""

LIMIT_M: Final = JUMP_M / JUMP_SHARE
"""Range from which on `JUMP_SHARE` counts, metres."""

SHADOW_M: Final = 0.15
"""Widest shadow that does not divide a surface, metres: pixels of a row are also neighbours if nothing was measured
between them and they are no farther apart than this at the nearer one's range. An arm's shadow falls on the trunk."""

_LEAST_PIXELS: Final = 1 << 17  # of a thread that finds segments, so that starting it pays
_ROWS: Final = 32  # of 1024 pixels: with what is computed of them, a quarter of a megabyte

Floats = NDArray[np.float32]
Mask = NDArray[np.bool_]
Indices = NDArray[np.intp]


def connected_surfaces(range_m: NDArray[np.float32], focal_px: float) -> NDArray[np.int32]:
    """Number the connected surfaces of a range image [H, W], metres; int32 [H, W], -1 where range is 0.

    Numbers start from 0, in the order of the surfaces' first pixels in reading order. focal_px: of the camera.
    """
    range_m = np.ascontiguousarray(range_m)  # loops are compiled for this alone
    level = jumps(range_m)
    if not use_compiled():
        return joined_surfaces(range_m, level, focal_px)
    surface = np.full(range_m.shape, -1, np.int32)
    loops().paint_surfaces(find_segments(range_m, level, focal_px)[0], surface.ravel())
    return surface


@cache
def loops() -> Any:
    """The compiled loops, in a module that needs numba."""
    return import_module("bodyseg_model.segmentation.people.surface_loops")


def jumps(range_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """Ranges on a scale on which two of one surface differ by at most 1; inf for range 0.

    float32 [3 + H, 3 + W + 2]: in an empty frame, `GAP_PIXELS` wide above and on the left and one less on the right, so
    that neighbours are a fixed step apart in flat memory, and no row runs into the next.
    """
    rows, columns = range_m.shape
    level: Floats = np.full((GAP_PIXELS + rows, GAP_PIXELS + columns + GAP_PIXELS - 1), np.inf, np.float32)
    form, beyond = loops() if use_compiled() else _NumpyForm, np.empty((_ROWS, columns), np.float32)
    for first in range(0, rows, _ROWS):  # few rows at a time, which stay in a processor's cache
        ranges = range_m[first : first + _ROWS]
        logs = np.maximum(ranges, LIMIT_M, out=beyond[: len(ranges)])
        np.log(np.divide(logs, LIMIT_M, out=logs), out=logs)
        form.write_levels(ranges, logs, first, level)
    return level


class _NumpyForm:
    """A function of `surface_loops`, with the same bits."""

    @staticmethod
    def write_levels(ranges: Floats, logs: Floats, first: int, level: Floats) -> None:
        far = np.divide(np.add(logs, 1, out=logs), JUMP_SHARE, out=logs)
        levels = np.where(ranges > LIMIT_M, far, ranges / JUMP_M)
        within(level)[first : first + len(ranges)] = np.where(ranges > 0, levels, np.inf)


def within(framed: Floats) -> Floats:
    """The image [H, W] in a frame like that of `jumps`, a view."""
    return framed[GAP_PIXELS:, GAP_PIXELS : 1 - GAP_PIXELS]


def find_segments(
    range_m: NDArray[np.float32], level: Floats, focal_px: float, threads: int = 1
) -> tuple[NDArray[np.int32], NDArray[np.float64], int]:
    """Find the segments of rows, adjacent pixels of one surface, by the compiled loops.

    Returns the first flat index, one after the last, and the number of the surface of each, int32 [3, N]; areas as if
    they faced the camera, float64 [N], m²; and the number of surfaces. level: from `jumps`. threads: among which rows
    are divided; the result does not depend on it.
    """
    rows, columns = range_m.shape
    segments, parent = np.empty((3, range_m.size), np.int32), np.empty(range_m.size, np.int32)
    area_m2, widest = np.empty(range_m.size), np.float32(SHADOW_M * focal_px)
    runs = pieces(rows, max(1, min(threads, range_m.size // _LEAST_PIXELS, rows // GAP_PIXELS)))
    numbers = np.full((len(runs), 1 + GAP_PIXELS, columns), -1, np.int32)
    ends = np.empty(len(runs), np.int64)

    def find(run: int) -> None:
        ends[run] = loops().find_segments(
            range_m, level, widest, focal_px, *runs[run], segments, parent, area_m2, numbers[run]
        )

    of_each(find, range(len(runs)), len(runs))
    for run in range(1, len(runs)):
        loops().join_pieces(level, columns, runs[run][0], segments, parent, ends[run], numbers[run - 1])
    firsts = np.array([first * columns for first, _ in runs])
    count, surfaces = loops().number_surfaces(firsts, ends, parent, segments, area_m2)
    return segments[:, :count], area_m2[:count], surfaces


def joined_surfaces(range_m: NDArray[np.float32], level: Floats, focal_px: float) -> NDArray[np.int32]:
    """The NumPy form of `connected_surfaces`. level: from `jumps`."""
    framed = np.zeros(level.shape, np.float32)
    within(framed)[:] = range_m
    stride, level = level.shape[1], level.ravel()
    measured = level < np.inf
    # Adjacent pixels of a row and surface make a run; only runs, which are few, are joined afterwards.
    begins = measured.copy()
    begins[1:] &= ~_near(level, 1)
    begins[_ends_of_shadows(framed.ravel(), level, stride, focal_px)] = False
    run = np.cumsum(begins, dtype=np.int32) - np.int32(1)
    pairs = [*_pairs_in_rows(level, begins), *_pairs_in_columns(level, begins, stride)]
    joined = np.concatenate([_without_doubles(run[pixels]) for pixels in pairs], axis=1)
    surface = np.append(_joined(int(np.count_nonzero(begins)), joined), np.int32(-1))
    run[~measured] = -1
    surfaces: NDArray[np.int32] = surface[run].reshape(-1, stride)
    return surfaces[GAP_PIXELS:, GAP_PIXELS : 1 - GAP_PIXELS]


def _near(level: Floats, shift: int) -> Mask:
    """Compare pixels `shift` apart: True if they are on one surface, bool [N - shift]; level: [N], from `_jumps`."""
    with np.errstate(invalid="ignore"):  # inf - inf
        near: Mask = np.abs(level[shift:] - level[:-shift]) <= 1
    return near


def _ends_of_shadows(range_m: Floats, level: Floats, stride: int, focal_px: float) -> Indices:
    """The first pixels to the right of holes that do not divide a surface, flat indices."""
    measured = range_m > 0
    # Starts and ends of measured stretches alternate; a hole is between an end and the next start.
    changes = np.flatnonzero(measured[1:] != measured[:-1])
    before, behind = changes[1:-1:2], changes[2::2] + 1
    hole = before // stride == behind // stride
    before, behind = before[hole], behind[hole]
    widest = np.maximum(SHADOW_M * focal_px / np.minimum(range_m[before], range_m[behind]), GAP_PIXELS)
    joined: Indices = behind[(behind - before <= widest) & (np.abs(level[behind] - level[before]) <= 1)]
    return joined


def _pairs_in_rows(level: Floats, begins: Mask) -> Iterator[Indices]:
    """Pairs of pixels 2 to `GAP_PIXELS` apart in a row, on one surface but in different runs, [2, N]."""
    starts = np.flatnonzero(begins)
    for shift in range(2, GAP_PIXELS + 1):
        first = (starts[:, None] - np.arange(1, shift + 1)).ravel()
        with np.errstate(invalid="ignore"):  # inf - inf
            first = first[np.abs(level[first + shift] - level[first]) <= 1]
        yield np.stack([first, first + shift])


def _pairs_in_columns(level: Floats, begins: Mask, stride: int) -> Iterator[Indices]:
    """Pairs of pixels 1 to `GAP_PIXELS` apart in a column and on one surface, [2, N].

    Pairs in the same two runs as the pair to their left are left out, and so are pairs that smaller steps join.
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
    """Pairs [2, N] without those equal to the previous one."""
    new = np.ones(pairs.shape[1], np.bool_)
    new[1:] = (pairs[:, 1:] != pairs[:, :-1]).any(axis=0)
    return pairs[:, new]


def _joined(count: int, pairs: NDArray[np.int32]) -> NDArray[np.int32]:
    """Union-find: the group of each of `count` elements after all `pairs` [2, N] are joined, int32 [count].

    Groups are numbered in the order of their lowest elements. Every round links each group's root to the lowest root it
    touches, then compresses all paths, so that few rounds suffice however long the chains.
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
