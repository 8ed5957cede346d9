"""Floors and walls: the large planes of a range image.

A plane a X + b Y + c Z = 1 is a x + b y + c = 1 / Z in the image, where x = X / Z and y = Y / Z. So a plane is linear
in inverse range, and is fitted there: structured light and stereo measure inverse range with equal accuracy near and
far.

Connected surfaces of a range image, neighbouring pixels of similar range: their pixels, areas and bounding boxes.

Background removal by range: the pixels of a frame that show bodies, divided into bodies.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cache, lru_cache
from importlib import import_module
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig, Draws
from bodyseg_data.machine import of_each, pieces
from bodyseg_data.rigs import Camera

LEAST_AREA_M2: Final = 1.0
"""Least visible area of a floor or wall, square metres: no body has so large a flat surface."""

TOLERANCE_PER_M: Final = 0.008
"""Greatest distance of a pixel from its plane, in inverse range: 5 cm at 2.5 m, along the optical axis. A Kinect
measures a flat wall at 2.6 m as bent by that much."""

_CANDIDATES: Final = 1024  # a plane with a fifth of the pixels is missed in one frame of 4 000
_JUDGES: Final = 512  # pixels that vote on every candidate
_FITTED: Final = 4096  # pixels that the best one is fitted to
_FITS: Final = 3

Points = NDArray[np.float64]


@cache
def _loops() -> Any:
    """The compiled loops, in a module that needs numba."""
    return import_module("bodyseg_model.segmentation.surface_loops")


class Lens(NamedTuple):
    """Principal point, to the right and down, and focal length of a camera, pixels."""

    across: float
    down: float
    focal_px: float


def on_largest_plane(range_m: NDArray[np.float32], pixels: NDArray[np.intp], camera: Camera) -> NDArray[np.bool_]:
    """Find the largest plane; True for those of `pixels` on it, bool [N].

    range_m: [H, W], metres. pixels: flat indices [N]; ranges there must not be 0. All are False if less than
    `LEAST_AREA_M2` of the plane is visible. Each candidate goes through three pixels (Fischler and Bolles, "Random
    sample consensus", 1981); the best is then fitted to the pixels near it. Draws are the same for every frame.
    """
    if not len(pixels):
        return np.zeros(0, np.bool_)
    some = _points(range_m, pixels[_draws() % len(pixels)], camera)
    plane = _best_candidate(some[:_JUDGES], some[_FITTED:].reshape(-1, 3, 3))
    if plane is None:
        return np.zeros(len(pixels), np.bool_)
    x, y, inverse = np.ascontiguousarray(some.T)
    rays = np.stack([x, y, np.ones(len(some))])
    for _ in range(_FITS):
        plane = _fit(rays, inverse, plane)
    near, cubes = _near_plane(range_m, pixels, camera, plane)
    return near if seen_area_m2(cubes, plane, camera) >= LEAST_AREA_M2 else np.zeros(len(pixels), np.bool_)


def seen_area_m2(cubes: float, plane: NDArray[np.float64], camera: Camera) -> float:
    """Area of a plane (a, b, c), 1 / m, visible in some pixels, square metres. cubes: sum of their ranges cubed, m³.

    A pixel at range Z covers (Z / f)² of a surface that faces the camera, and that area over the cosine between ray and
    normal of a slanted one; the cosine is 1 / (Z |(a, b, c)|) for a ray of unit depth.
    """
    return float(np.linalg.norm(plane)) * cubes / camera.focal_px**2


@lru_cache(maxsize=1)
def _draws() -> NDArray[np.uint32]:
    return Draws(0, 0, "").pixels("room planes", _FITTED + 3 * _CANDIDATES, np.uint32)


def _points(range_m: NDArray[np.float32], pixels: NDArray[np.intp], camera: Camera) -> Points:
    """x, y and inverse range of pixels, [N, 3]."""
    rows = pixels // range_m.shape[1]
    columns = pixels - rows * range_m.shape[1]
    x = (columns + 0.5 - camera.centre_px[0]) / camera.focal_px
    y = (rows + 0.5 - camera.centre_px[1]) / camera.focal_px
    return np.stack([x, y, 1 / range_m.ravel()[pixels].astype(np.float64)], axis=1)


def _near_plane(
    range_m: NDArray[np.float32], pixels: NDArray[np.intp], camera: Camera, plane: NDArray[np.float64]
) -> tuple[NDArray[np.bool_], float]:
    """Mark the pixels within the tolerance of a plane, bool [N]; and the sum of their ranges cubed."""
    near = np.empty(len(pixels), np.bool_)
    flat, columns = range_m.ravel(), range_m.shape[1]
    ends = np.searchsorted(pixels, columns * np.arange(len(range_m) + 1))
    lens = Lens(*camera.centre_px, camera.focal_px)
    return near, float(_loops().mark_plane(flat, pixels, ends, columns, lens, plane, TOLERANCE_PER_M, near))


def _fit(rays: Points, inverse: NDArray[np.float64], plane: NDArray[np.float64]) -> NDArray[np.float64]:
    """Fit a plane (a, b, c) by least squares of misfits in inverse range to the points near another one.

    rays: x, y and 1 of points, [3, N]. inverse: their inverse ranges, [N].
    """
    near = rays * (np.abs(plane @ rays - inverse) <= TOLERANCE_PER_M)
    return np.asarray(np.linalg.lstsq(near @ rays.T, near @ inverse, rcond=None)[0], np.float64)


def _best_candidate(judges: Points, corners: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """The plane (a, b, c) through one of the triples of points [N, 3, 3] that explains most of the visible surface.

    judges: points [M, 3] that stand for that surface. None if no candidate explains any of them.
    """
    planes, surface = np.empty((4, len(corners))), np.zeros(len(corners))
    # Three points on a line have a zero normal, which explains no point.
    _loops().explained(judges, corners, TOLERANCE_PER_M, planes, surface)
    best = int(np.argmax(surface))
    if not surface[best]:
        return None
    a, b, c, offset = planes[:, best]
    plane: NDArray[np.float64] = np.array([-a, -b, offset]) / c
    return plane


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


class LevelledFrame(NamedTuple):
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


_JUMP: Final = (np.float32(JUMP_M), np.float32(JUMP_SHARE), np.float32(LIMIT_M))


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
        _loops().write_levels(ranges, logs, first, *_JUMP, level)
    return level


def find_segments(range_m: Floats, level: Floats, focal_px: float, threads: int = 1) -> tuple[Segments, int]:
    """Find the segments of a range image [H, W], metres, and the number of its surfaces.

    Surfaces are numbered from 0, in the order of their first pixels in reading order. level: from `jumps`. threads:
    among which rows are divided; the result does not depend on it.
    """
    rows, columns = range_m.shape
    size = range_m.size
    found = Segments(np.empty((3, size), np.int32), np.empty(size, np.int32), np.empty(size))
    frame = LevelledFrame(range_m, level, np.float32(SHADOW_M * focal_px), focal_px)
    runs = pieces(rows, max(1, min(threads, size // _LEAST_PIXELS, rows // GAP_PIXELS)))
    numbers = np.full((len(runs), 1 + GAP_PIXELS, columns), -1, np.int32)
    ends = np.empty(len(runs), np.int64)

    def find(run: int) -> None:
        steps, marks = np.zeros((2, 4, columns + 1), np.uint8), np.zeros((columns + 7) // 8 * 8, np.uint8)
        room = *steps, marks, marks.view(np.uint64)  # made in the loop, it takes the compiler long
        ends[run] = _loops().find_segments(frame, *runs[run], found, numbers[run], room)

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
        lens = Lens(*self._camera.centre_px, self._camera.focal_px)
        width, height, depth = _loops().extents(flat, columns, lens, self.pixels_of(number))
        return width, height, depth

    def bounding_boxes(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lowest and highest row, column and range (metres) of every surface, float64 [3, N] each."""
        lowest, highest = np.full((3, len(self.area_m2)), np.inf), np.full((3, len(self.area_m2)), -np.inf)
        _loops().bound_surfaces(self._range_m.ravel(), self._range_m.shape[1], self._segments, lowest, highest)
        return lowest, highest


BackgroundMode = Literal["people", "limits", "keep", "frame"]

BODY_AREA_M2: Final = (0.05, 2.0)
"""Least and greatest visible surface of a body, square metres, as if it faced the camera."""

BODY_EXTENT_M: Final = 2.5
"""Greatest width, height or depth of a body, metres."""

BODY_HEIGHT_M: Final = 0.3
"""Least height of a body, metres; less of one cannot be recognised."""

LOOSE_AREA_M2: Final = 0.1
"""Surfaces smaller than this, such as a forearm with its hand, join a body that they overlap in the image, if within
its reach; square metres."""

_MOST_PLANES: Final = 6

Bodies = tuple[NDArray[np.intp], ...]
"""One array for each body: its pixels [N] as row * columns + column, ascending."""


@dataclass(frozen=True)
class Background:
    """Rule for removing the background before a network labels the rest.

    mode: "people" keeps surfaces within the limits that are on no large plane and have the size of a body; "limits"
    keeps every pixel within the limits, as one body; "keep" keeps every measured pixel, as one body, for frames whose
    background was removed before; "frame" has whole frames labelled as they stand, for networks that were trained on
    whole images of such a camera. near_m, far_m: the limits of range, metres. Raises BadConfig for limits in the wrong
    order.
    """

    mode: BackgroundMode = "people"
    near_m: float = 0.5
    far_m: float = 5.0

    def __post_init__(self) -> None:
        if not 0 <= self.near_m < self.far_m < float("inf"):
            raise BadConfig(
                "the near limit must be at least 0 m and less than the far one, found "
                f"{self.near_m:g} and {self.far_m:g} m"
            )

    def to_json(self) -> dict[str, Any]:
        """Mode, and limits where they count, for summary.json."""
        return {"mode": self.mode} if self.mode in ("keep", "frame") else asdict(self)


def find_bodies(range_m: NDArray[np.float32], camera: Camera, background: Background, threads: int = 1) -> Bodies:
    """Find the bodies in a frame, the largest first; a pixel belongs to at most one.

    range_m: [H, W], metres along the optical axis, 0 = nothing measured, as are NaN and infinity. camera: the one that
    took it. threads: among which the work is divided; the bodies do not depend on it. Raises MissingLibrary without
    numba, in mode "people".
    """
    if background.mode in ("keep", "frame"):
        return _all_of((range_m > 0) & (range_m < np.inf))
    near, far = np.float32(background.near_m), np.float32(background.far_m)
    kept = np.where((range_m >= near) & (range_m <= far), range_m, np.float32(0))
    return _all_of(kept > 0) if background.mode == "limits" else _people(kept, camera, threads)


def _all_of(mask: NDArray[np.bool_]) -> Bodies:
    pixels = np.flatnonzero(mask)
    return (pixels,) if len(pixels) else ()


def _people(range_m: NDArray[np.float32], camera: Camera, threads: int) -> Bodies:
    """Surfaces of a body's size, after large planes are removed from `range_m`, in place."""
    surfaces = Surfaces(range_m, camera, threads)
    for _ in range(_MOST_PLANES):
        large = [surfaces.pixels_of(number) for number in surfaces.by_size(LEAST_AREA_M2 / 2)]
        flat = of_each(lambda pixels: on_largest_plane(range_m, pixels, camera), large, threads)
        if not any(map(np.any, flat)):
            break
        surfaces.remove(large, flat)
    lowest, highest = surfaces.bounding_boxes()
    taken = np.zeros(len(surfaces.area_m2), np.bool_)
    bodies = []
    for number in surfaces.by_size(BODY_AREA_M2[0]):
        if taken[number] or not _has_body_size(surfaces, number):
            continue
        taken[number] = True
        pieces = np.flatnonzero(~taken & (surfaces.area_m2 < LOOSE_AREA_M2) & _near(number, lowest, highest))
        taken[pieces] = True
        pixels = [surfaces.pixels_of(piece) for piece in (number, *pieces)]
        bodies.append(np.sort(np.concatenate(pixels), kind="stable") if len(pieces) else pixels[0])
    return tuple(bodies)


def _near(number: int, lowest: NDArray[np.float64], highest: NDArray[np.float64]) -> NDArray[np.bool_]:
    """True for surfaces that overlap one of them in rows and columns, and in range within `REACH_M`, bool [N]."""
    low, high = lowest[:, [number]], highest[:, [number]]
    overlap = (highest[:2] >= low[:2]) & (lowest[:2] <= high[:2])
    within = (lowest[2] >= low[2] - REACH_M[0]) & (highest[2] <= high[2] + REACH_M[1])
    near: NDArray[np.bool_] = overlap.all(axis=0) & within
    return near


def _has_body_size(surfaces: Surfaces, number: int) -> bool:
    if surfaces.area_m2[number] > BODY_AREA_M2[1]:
        return False
    width, height, depth = surfaces.extents_m(number)
    return max(width, height, depth) <= BODY_EXTENT_M and height >= BODY_HEIGHT_M
