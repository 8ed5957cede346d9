"""Floors and walls: the large planes of a range image.

A plane a X + b Y + c Z = 1 is a x + b y + c = 1 / Z in the image, where x = X / Z and y = Y / Z. So a plane is linear
in inverse range, and is fitted there: structured light and stereo measure inverse range with equal accuracy near and
far.
"""

from __future__ import annotations

from typing import Final

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


def on_largest_plane(range_m: NDArray[np.float32], pixels: NDArray[np.intp], camera: Camera) -> NDArray[np.bool_]:
    """Find the largest plane; True for those of `pixels` on it, bool [N].

    range_m: [H, W], metres. pixels: flat indices [N]; ranges there must not be 0. All are False if less than
    `LEAST_AREA_M2` of the plane is visible. Each candidate goes through three pixels (Fischler and Bolles, "Random
    sample consensus", 1981); the best is then fitted to the pixels near it. Draws are the same for every frame.
    """
    if not len(pixels):
        return np.zeros(0, np.bool_)
    draws = pixel_draws(stream(0, 0, "", "room planes"), _FITTED + 3 * _CANDIDATES, np.uint32) % len(pixels)
    some = _points(range_m, pixels[draws], camera)
    plane = _best_candidate(some[:_JUDGES], some[_FITTED:].reshape(-1, 3, 3))
    if plane is None:
        return np.zeros(len(pixels), np.bool_)
    for _ in range(_FITS):
        near = some[np.abs(_misfit(some, plane)) <= TOLERANCE_PER_M]
        plane = _fit(near)
    points = _points(range_m, pixels, camera)
    on_plane = np.abs(_misfit(points, plane)) <= TOLERANCE_PER_M
    return on_plane & (seen_area_m2(points[on_plane, 2], plane, camera) >= LEAST_AREA_M2)


def seen_area_m2(inverse_range: NDArray[np.float64], plane: NDArray[np.float64], camera: Camera) -> float:
    """Area of a plane (a, b, c) visible in pixels of given inverse ranges [N], 1 / m; square metres.

    A pixel at range Z covers (Z / f)² of a surface that faces the camera, and that area over the cosine between ray and
    normal of a slanted one; the cosine is 1 / (Z |(a, b, c)|) for a ray of unit depth.
    """
    return float(np.linalg.norm(plane) * (inverse_range**-3.0).sum() / camera.focal_px**2)


def _points(range_m: NDArray[np.float32], pixels: NDArray[np.intp], camera: Camera) -> Points:
    """x, y and inverse range of pixels, [N, 3]."""
    rows, columns = np.divmod(pixels, range_m.shape[1])
    x = (columns + 0.5 - camera.centre_px[0]) / camera.focal_px
    y = (rows + 0.5 - camera.centre_px[1]) / camera.focal_px
    return np.stack([x, y, 1 / range_m.ravel()[pixels].astype(np.float64)], axis=1)


def _misfit(points: Points, plane: NDArray[np.float64]) -> NDArray[np.float64]:
    """Signed distance of points [N, 3] from a plane (a, b, c) in inverse range, [N]."""
    a, b, c = (float(number) for number in plane)
    return points[:, 0] * a + points[:, 1] * b + c - points[:, 2]


def _fit(points: Points) -> NDArray[np.float64]:
    """Fit a plane (a, b, c) by least squares of misfits, from the normal equations."""
    flat = np.column_stack([points[:, :2], np.ones(len(points))])
    normal, right = np.einsum("ki,kj->ij", flat, flat), np.einsum("ki,k->i", flat, points[:, 2])
    return np.asarray(np.linalg.lstsq(normal, right, rcond=None)[0], np.float64)


def _best_candidate(judges: Points, corners: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """The plane (a, b, c) through one of the triples of points [N, 3, 3] that explains most of the visible surface.

    judges: points [M, 3] that stand for that surface. None if no candidate explains any of them.
    """
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    # No matrix products: for so few numbers, starting threads takes longer on a busy machine than all the rest.
    offsets = np.einsum("ij,ij->i", normals, corners[:, 0])
    away = np.einsum("ij,kj->ik", judges, normals) - offsets
    # Three points on a line have a zero normal, which explains no point.
    explained = np.abs(away) < TOLERANCE_PER_M * np.abs(normals[:, 2])
    surface = np.einsum("i,ij->j", judges[:, 2] ** -2, explained)
    best = int(np.argmax(surface))
    if not surface[best]:
        return None
    a, b, w = normals[best]
    plane: NDArray[np.float64] = np.array([-a, -b, offsets[best]]) / w
    return plane
