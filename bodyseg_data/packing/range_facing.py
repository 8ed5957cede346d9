"""Facing: surfaces turned towards a projector, from normals or from the range image alone.

A plane is linear in the image as inverse range: with a pixel's ray r = (x, y, 1) and its range z, 1 / z = m . r, where
m is the plane's normal divided by its distance. The camera, at the origin, is on the side of m . p < 1, so a projector
at p is on the camera's side of the surface seen exactly where m . p < 1. The slope of 1 / z is taken between
neighbouring pixels: over both sides where they agree, over the flatter one where the other crosses an edge.
"""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.rigs import Rig

Masks = list[NDArray[np.bool_]]
Image = NDArray[np.floating[Any]]

_ONE_SURFACE: Final = 1.5  # largest ratio of the slopes on both sides of a pixel that are of one surface
_LEVEL: Final = 1e-6
"""Slopes below this, 1 / m a pixel, count as 0: they are the last bits of a surface that is square to the axis."""

_REACH: Final = 2  # pixels to each side that a slope depends on
_ROWS: Final = 48  # rows that are computed at once, so that arrays stay in the cache
_BENT: Final = 4.0  # largest ratio of the slope beyond a neighbour to the slope up to it, on one side


def projector_places(rig: Rig) -> list[NDArray[np.float64]]:
    """The optical centres [3] of a rig's projectors in the camera's frame (x right, y down, z forward), metres."""
    poses = [single.camera_to_projector() for single in rig.by_projector()]
    return [-rotation.T @ shift for rotation, shift in poses]


def facing_from_range(rig: Rig, range_m: Image) -> Masks:
    """For each projector, the pixels whose surface is turned towards it, bool [H, W], False where range is 0.

    range_m: float [H, W], metres along the camera's axis, 0 where nothing was measured. A pixel without neighbours is
    taken to lie square to the camera's axis.
    """
    places = projector_places(rig)
    answers = [np.zeros(range_m.shape, np.bool_) for _ in places]
    for start in range(0, len(range_m), _ROWS):
        first, end = max(start - _REACH, 0), min(start + _ROWS, len(range_m))
        found = _facing(rig, places, range_m[first : end + _REACH], first)
        for answer, rows in zip(answers, found, strict=True):
            answer[start:end] = rows[start - first : end - first]
    return answers


def _facing(rig: Rig, places: list[NDArray[np.float64]], range_m: Image, first: int) -> Masks:
    """As `facing_from_range`, of rows from `first` on, which are taken for the whole image."""
    camera, measured = rig.camera, range_m > 0
    inverse = np.zeros(range_m.shape, np.float32)
    np.divide(np.float32(1), range_m, out=inverse, where=measured, casting="same_kind")
    across = _slopes(inverse, measured, 1) * np.float32(camera.focal_px)
    down = _slopes(inverse, measured, 0) * np.float32(camera.focal_px)
    x, y = (slopes.astype(np.float32) for slopes in camera.slopes)
    answers = []
    for px, py, pz in np.array(places, np.float32):
        inclined = across * (px - x * pz) + down * (py - y[first : first + len(down)] * pz)[:, None] + inverse * pz
        answers.append(measured & (inclined < 1))
    return answers


def _slopes(inverse: NDArray[np.float32], measured: NDArray[np.bool_], axis: int) -> NDArray[np.float32]:
    """The change of inverse range from pixel to pixel along an axis, float32 [H, W]; 0 without a measured neighbour.

    The mean of both sides where they are of one surface; else that of the flatter side. As surfaces bend away towards
    their outline, half of the difference to the slope beyond it is added.
    """
    ahead, behind = _along(axis, 1, None), _along(axis, None, -1)
    rows, columns = inverse.shape
    # Steps to the next pixel, infinite where one of the two is not measured, with two more infinite ones at either end.
    steps = np.full((rows + 3 * (axis == 0), columns + 3 * (axis == 1)), np.inf, np.float32)
    inner = steps[_along(axis, 2, -2)]
    np.subtract(inverse[ahead], inverse[behind], out=inner, where=measured[ahead] & measured[behind])
    sizes = np.abs(steps)
    flat, steep = (sizes[_along(axis, start, start - 3)] for start in (1, 2))
    flat, steep = np.minimum(flat, steep), np.maximum(flat, steep)
    flat *= np.float32(_ONE_SURFACE)
    flat += np.float32(_LEVEL)
    slopes = steps[_along(axis, 1, -2)] + steps[_along(axis, 2, -1)]
    slopes *= np.float32(0.5)
    # Elsewhere, at few pixels, the flatter side and the step beyond it.
    edges = np.flatnonzero(~(steep < flat) & measured)
    at, stride = (edges, columns) if axis == 0 else (edges + 3 * (edges // columns), 1)
    outer, before, after, other = (steps.ravel()[at + place * stride] for place in range(4))
    first = np.abs(before) <= np.abs(after)
    near, beyond = np.where(first, before, after), np.where(first, outer, other)
    with np.errstate(invalid="ignore"):  # inf - inf, which is not used
        near = np.where(np.abs(beyond) <= _BENT * np.abs(near), 1.5 * near - 0.5 * beyond, near)
    slopes.ravel()[edges] = np.where(np.isfinite(near), near, 0)
    slopes[~measured] = 0
    return slopes


def _along(axis: int, start: int | None, end: int | None) -> tuple[slice, slice]:
    """A part of the rows, axis 0, or of the columns."""
    part = slice(start, end)
    return (part, slice(None)) if axis == 0 else (slice(None), part)


def facing_from_normals(rig: Rig, range_m: Image, normals: Image) -> Masks:
    """As `facing_from_range`, from outward normals [H, W, 3] of the surfaces in the camera's frame, of any length."""
    points = rig.camera.pixel_rays() * range_m[..., None]
    measured = range_m > 0
    return [measured & (np.einsum("ijk,ijk->ij", normals, place - points) > 0) for place in projector_places(rig)]
