"""Connected surfaces of a range image, neighbouring pixels of similar range: their pixels, areas and bounding boxes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.rig import Camera
from bodyseg_data.core.system.divided_work import of_each, pieces
from bodyseg_model.segmentation.room_planes import lens_of

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

REACH_M: Final = (0.6, 0.3)
"""Greatest distance of a small surface in front of a body and behind it, metres, that may still belong to it: of an arm
stretched towards the camera or behind the trunk, only the hand may be seen."""

_LEAST_PIXELS: Final = 1 << 17  # of a thread that finds segments, so that starting it pays
_ROWS: Final = 32  # of 1024 pixels: with what is computed of them, a quarter of a megabyte

Floats = NDArray[np.float32]


class Jump(NamedTuple):
    """What divides surfaces, float32: a difference of range of `metres`, or beyond `from_m` of a `share`."""

    metres: np.float32
    share: np.float32
    from_m: np.float32


class Frame(NamedTuple):
    """A range image whose segments are looked for. range_m: float32 [H, W], metres. level: from `jumps`. widest: of a
    shadow that divides no surface, pixels at 1 m. focal_px: of the camera.
    """

    range_m: Floats
    level: Floats
    widest: np.float32
    focal_px: float


class Segments(NamedTuple):
    """Segments of rows, adjacent pixels of one surface, by number. segments: the first flat index, one after the last,
    and the number of the surface of each, int32 [3, N]. parent: a segment of the same surface that comes before it, or
    itself, int32 [N]. area_m2: as if it faced the camera, float64 [N].
    """

    segments: NDArray[np.int32]
    parent: NDArray[np.int32]
    area_m2: NDArray[np.float64]


_JUMP: Final = Jump(np.float32(JUMP_M), np.float32(JUMP_SHARE), np.float32(LIMIT_M))


@cache
def _loops() -> Any:
    """The compiled loops, in a module that needs numba."""
    return import_module("bodyseg_model.segmentation.surface_loops")


def jumps(range_m: Floats) -> Floats:
    """Ranges on a scale on which two of one surface differ by at most 1; inf for range 0.

    float32 [3 + H, 3 + W + 2]: in an empty frame, `GAP_PIXELS` wide above and on the left and one less on the right, so
    that neighbours are a fixed step apart in flat memory, and no row runs into the next.
    """
    rows, columns = range_m.shape
    level: Floats = np.full((GAP_PIXELS + rows, GAP_PIXELS + columns + GAP_PIXELS - 1), np.inf, np.float32)
    beyond = np.empty((_ROWS, columns), np.float32)
    for first in range(0, rows, _ROWS):  # few rows at a time, which stay in a processor's cache
        ranges = range_m[first : first + _ROWS]
        logs = np.maximum(ranges, LIMIT_M, out=beyond[: len(ranges)])
        np.log(np.divide(logs, LIMIT_M, out=logs), out=logs)
        _loops().write_levels(ranges, logs, first, _JUMP, level)
    return level


def find_segments(range_m: Floats, level: Floats, focal_px: float, threads: int = 1) -> tuple[Segments, int]:
    """Find the segments of a range image [H, W], metres, and the number of its surfaces.

    Surfaces are numbered from 0, in the order of their first pixels in reading order. level: from `jumps`. threads:
    among which rows are divided; the result does not depend on it.
    """
    rows, columns = range_m.shape
    size = range_m.size
    found = Segments(np.empty((3, size), np.int32), np.empty(size, np.int32), np.empty(size))
    frame = Frame(range_m, level, np.float32(SHADOW_M * focal_px), focal_px)
    runs = pieces(rows, max(1, min(threads, size // _LEAST_PIXELS, rows // GAP_PIXELS)))
    numbers = np.full((len(runs), 1 + GAP_PIXELS, columns), -1, np.int32)
    ends = np.empty(len(runs), np.int64)

    def find(run: int) -> None:
        ends[run] = _loops().find_segments(frame, *runs[run], found, numbers[run])

    of_each(find, range(len(runs)), len(runs))
    for run in range(1, len(runs)):
        _loops().join_pieces(frame, runs[run][0], ends[run], found, numbers[run - 1])
    firsts = np.array([first * columns for first, _ in runs])
    count, surfaces = _loops().number_surfaces(firsts, ends, found)
    return Segments(found.segments[:, :count], found.parent[:count], found.area_m2[:count]), surfaces


class Surfaces:
    """The connected surfaces of a range image [H, W], float32, metres, taken by `camera`. The image, contiguous, is
    changed by `remove`.

    area_m2: float64 [N], of each as if it faced the camera. threads: among which rows are divided.
    """

    def __init__(self, range_m: Floats, camera: Camera, threads: int = 1) -> None:
        self._range_m, self._camera, self._threads = range_m, camera, threads
        self._level = jumps(range_m)
        self._find()

    def __repr__(self) -> str:
        return f"Surfaces({len(self.area_m2)} of {self._range_m.shape[0]} x {self._range_m.shape[1]} pixels)"

    def _find(self) -> None:
        found, count = find_segments(self._range_m, self._level, self._camera.focal_px, self._threads)
        begins, ends, number = self._segments = found.segments
        self.area_m2 = np.bincount(number, found.area_m2, minlength=count)
        self._counts = np.bincount(number, ends - begins, minlength=count).astype(np.intp)

    def by_size(self, least_m2: float) -> list[int]:
        """The numbers of surfaces of at least this area, the largest first."""
        large = np.flatnonzero(self.area_m2 >= least_m2)
        return [int(number) for number in large[np.argsort(-self.area_m2[large], kind="stable")]]

    def pixels_of(self, number: int) -> NDArray[np.intp]:
        """The pixels of a surface, flat indices, ascending."""
        pixels = np.empty(self._counts[number], np.intp)
        _loops().list_pixels(self._segments, number, pixels)
        return pixels

    def remove(self, pixels: Sequence[NDArray[np.intp]], flat: Sequence[NDArray[np.bool_]]) -> None:
        """Take pixels, ascending flat indices [N], out of the image where `flat`, bool [N], is True; surface by
        surface. What is left is numbered anew.
        """
        for some, gone in zip(pixels, flat, strict=True):
            self._range_m.ravel()[some[gone]] = 0
        self._level[GAP_PIXELS:, GAP_PIXELS : 1 - GAP_PIXELS][self._range_m == 0] = np.inf
        self._find()

    def extents_m(self, number: int) -> tuple[float, float, float]:
        """Width, height and depth of a surface, metres."""
        flat, columns = self._range_m.ravel(), self._range_m.shape[1]
        width, height, depth = _loops().extents(flat, columns, lens_of(self._camera), self.pixels_of(number))
        return width, height, depth

    def bounding_boxes(self) -> BoundingBoxes:
        """The bounding box of every surface."""
        lowest, highest = np.full((3, len(self.area_m2)), np.inf), np.full((3, len(self.area_m2)), -np.inf)
        _loops().bound_surfaces(self._range_m.ravel(), self._range_m.shape[1], self._segments, lowest, highest)
        return BoundingBoxes(lowest, highest)


@dataclass(frozen=True)
class BoundingBoxes:
    """Bounding boxes of surfaces: lowest and highest row, column and range (metres), each float64 [3, N]."""

    lowest: NDArray[np.float64]
    highest: NDArray[np.float64]

    def near(self, number: int) -> NDArray[np.bool_]:
        """True for surfaces that overlap one of them in rows and columns, and in range within `REACH_M`, bool [N]."""
        low, high = self.lowest[:, number].copy(), self.highest[:, number].copy()
        low[2] -= REACH_M[0]
        high[2] += REACH_M[1]
        overlap = (self.highest[:2] >= low[:2, None]) & (self.lowest[:2] <= high[:2, None])
        within = (self.lowest[2] >= low[2]) & (self.highest[2] <= high[2])
        near: NDArray[np.bool_] = overlap.all(axis=0) & within
        return near
