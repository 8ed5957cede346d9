"""Floors and walls: the large planes of a range image.

A plane a X + b Y + c Z = 1 is a x + b y + c = 1 / Z in the image, where x = X / Z and y = Y / Z. So a plane is linear
in inverse range, and is fitted there: structured light and stereo measure inverse range with equal accuracy near and
far.
"""

from __future__ import annotations

from functools import cache, lru_cache
from importlib import import_module
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.randomness import pixel_draws, stream
from bodyseg_data.core.rig import Camera

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


class Lens(NamedTuple):
    """Principal point, to the right and down, and focal length of a camera, pixels."""

    across: float
    down: float
    focal_px: float


def lens_of(camera: Camera) -> Lens:
    """The numbers of a camera that loops need."""
    return Lens(*camera.centre_px, camera.focal_px)


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


@cache
def _loops() -> Any:
    """The compiled loops, in a module that needs numba."""
    return import_module("bodyseg_model.segmentation.surface_loops")


def seen_area_m2(cubes: float, plane: NDArray[np.float64], camera: Camera) -> float:
    """Area of a plane (a, b, c), 1 / m, visible in some pixels, square metres. cubes: sum of their ranges cubed, m³.

    A pixel at range Z covers (Z / f)² of a surface that faces the camera, and that area over the cosine between ray and
    normal of a slanted one; the cosine is 1 / (Z |(a, b, c)|) for a ray of unit depth.
    """
    return float(np.linalg.norm(plane)) * cubes / camera.focal_px**2


@lru_cache(maxsize=1)
def _draws() -> NDArray[np.uint32]:
    return pixel_draws(stream(0, 0, "", "room planes"), _FITTED + 3 * _CANDIDATES, np.uint32)


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
    return near, float(_loops().mark_plane(flat, pixels, columns, lens_of(camera), plane, TOLERANCE_PER_M, near))


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
