"""Floors and walls: the large planes of a range image.

A plane a X + b Y + c Z = 1 is a x + b y + c = 1 / Z in the image, where x = X / Z and y = Y / Z. So a plane is linear
in inverse range, and is fitted there: structured light and stereo measure inverse range with equal accuracy near and
far.
"""

from __future__ import annotations

from functools import cache, lru_cache
from importlib import import_module
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.kernels import use_compiled
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
    for _ in range(_FITS):
        plane = _fit(some, plane)
    near, cubes = _near_plane(range_m, pixels, camera, plane)
    return near if seen_area_m2(cubes, plane, camera) >= LEAST_AREA_M2 else np.zeros(len(pixels), np.bool_)


@cache
def _loops() -> Any:
    """The compiled loops, in a module that needs numba."""
    return import_module("bodyseg_model.segmentation.people.plane_loops")


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
    if use_compiled():
        points, lens = np.empty((len(pixels), 3)), lens_of(camera)
        _loops().place_points(range_m.ravel(), pixels, range_m.shape[1], lens, points)
        return points
    rows, columns = np.divmod(pixels, range_m.shape[1])
    x = (columns + 0.5 - camera.centre_px[0]) / camera.focal_px
    y = (rows + 0.5 - camera.centre_px[1]) / camera.focal_px
    return np.stack([x, y, 1 / range_m.ravel()[pixels].astype(np.float64)], axis=1)


def lens_of(camera: Camera) -> NDArray[np.float64]:
    """Principal point and focal length, pixels, [3]."""
    return np.array([*camera.centre_px, camera.focal_px])


def _misfit(points: Points, plane: NDArray[np.float64]) -> NDArray[np.float64]:
    """Signed distance of points [N, 3] from a plane (a, b, c) in inverse range, [N]."""
    a, b, c = (float(number) for number in plane)
    return points[:, 0] * a + points[:, 1] * b + c - points[:, 2]


def _near_plane(
    range_m: NDArray[np.float32], pixels: NDArray[np.intp], camera: Camera, plane: NDArray[np.float64]
) -> tuple[NDArray[np.bool_], float]:
    """Mark the pixels within the tolerance of a plane, bool [N]; and the sum of their ranges cubed."""
    if use_compiled():
        near, lens = np.empty(len(pixels), np.bool_), lens_of(camera)
        flat, columns = range_m.ravel(), range_m.shape[1]
        return near, float(_loops().mark_plane(flat, pixels, columns, lens, plane, TOLERANCE_PER_M, near))
    rows, columns = np.divmod(pixels, range_m.shape[1])
    z, (across, down) = range_m.ravel()[pixels].astype(np.float64), camera.centre_px
    a, b, c = plane[0] / camera.focal_px, plane[1] / camera.focal_px, plane[2]
    inverse = (columns + 0.5 - across) * a + ((rows + 0.5 - down) * b + c)
    near = np.abs(inverse * z - 1) <= TOLERANCE_PER_M * z  # the same as of misfits, without a division for each pixel
    z = z[near]
    return near, _sum_in_order(z * z * z)


def _fit(points: Points, plane: NDArray[np.float64]) -> NDArray[np.float64]:
    """Fit a plane (a, b, c) by least squares of misfits to the points [N, 3] near another one."""
    xx, xy, x, yy, y, count, x_inverse, y_inverse, inverse = _moments(points, plane)
    normal = np.array([[xx, xy, x], [xy, yy, y], [x, y, count]])
    return np.asarray(np.linalg.lstsq(normal, np.array([x_inverse, y_inverse, inverse]), rcond=None)[0], np.float64)


def _moments(points: Points, plane: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sums of xx, xy, x, yy, y, 1, x / Z, y / Z and 1 / Z over the points [N, 3] near a plane, [9]."""
    if use_compiled():
        sums = np.zeros(9)
        _loops().moments(points, plane, TOLERANCE_PER_M, sums)
        return sums
    x, y, inverse = points[np.abs(_misfit(points, plane)) <= TOLERANCE_PER_M].T
    terms = (x * x, x * y, x, y * y, y, np.ones(len(x)), x * inverse, y * inverse, inverse)
    return np.array([_sum_in_order(term) for term in terms])


def _sum_in_order(terms: NDArray[np.float64]) -> float:
    """Sum from the first term to the last, as a loop adds them; `np.sum` adds in another order."""
    return float(np.cumsum(terms)[-1]) if len(terms) else 0.0


def _best_candidate(judges: Points, corners: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """The plane (a, b, c) through one of the triples of points [N, 3, 3] that explains most of the visible surface.

    judges: points [M, 3] that stand for that surface. None if no candidate explains any of them.
    """
    surface = np.zeros(len(corners))
    # Three points on a line have a zero normal, which explains no point.
    if use_compiled():
        normals, offsets = np.empty((3, len(corners))), np.empty(len(corners))
        _loops().span_planes(corners, normals, offsets)
        a, b, c = normals
        _loops().explained(judges, normals, offsets, TOLERANCE_PER_M, surface)
    else:
        a, b, c = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).T
        offsets = a * corners[:, 0, 0] + b * corners[:, 0, 1] + c * corners[:, 0, 2]
        for x, y, inverse in judges:
            away = x * a + y * b + inverse * c - offsets
            surface += np.where(np.abs(away) < TOLERANCE_PER_M * np.abs(c), np.square(1 / inverse), 0.0)
    best = int(np.argmax(surface))
    if not surface[best]:
        return None
    plane: NDArray[np.float64] = np.array([-a[best], -b[best], offsets[best]]) / c[best]
    return plane
