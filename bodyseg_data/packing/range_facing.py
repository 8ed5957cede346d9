"""Whether surfaces are turned towards a projector, from normals or from the range image alone.

A plane is linear in the image as inverse range: with a pixel's ray r = (x, y, 1) and its range z, 1 / z = m . r, where
m is the plane's normal divided by its distance. The camera, at the origin, is on the side of m . p < 1, so a projector
at p is on the camera's side of the surface seen exactly where m . p < 1. The slope of 1 / z is taken between
neighbouring pixels: over both sides where they agree, over the flatter one where the other crosses an edge.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.rigs import Rig

_ONE_SURFACE: Final = 1.5
"""Slopes on both sides of a pixel that differ by more than this factor are not of one surface."""

_BENT: Final = 4.0
"""The same for slopes of one side, at the pixel and beyond."""


def projector_places(rig: Rig) -> list[NDArray[np.float64]]:
    """The optical centres [3] of a rig's projectors in the camera's frame (x right, y down, z forward), metres."""
    poses = [single.camera_to_projector() for single in rig.by_projector()]
    return [-rotation.T @ shift for rotation, shift in poses]


def facing_from_range(rig: Rig, range_m: NDArray[np.floating[Any]]) -> list[NDArray[np.bool_]]:
    """For each projector, the pixels whose surface is turned towards it, bool [H, W], False where range is 0.

    range_m: float [H, W], metres along the camera's axis, 0 where nothing was measured. A pixel without neighbours is
    taken to lie square to the camera's axis.
    """
    measured = range_m > 0
    inverse = np.zeros(range_m.shape, np.float32)
    np.divide(np.float32(1), range_m, out=inverse, where=measured, casting="same_kind")
    camera = rig.camera
    across = _slopes(inverse, measured, 1) * np.float32(camera.focal_px)
    down = _slopes(inverse, measured, 0) * np.float32(camera.focal_px)
    x = ((np.arange(camera.columns) + 0.5 - camera.centre_px[0]) / camera.focal_px).astype(np.float32)
    y = ((np.arange(camera.rows) + 0.5 - camera.centre_px[1]) / camera.focal_px).astype(np.float32)[:, None]
    answers = []
    for place in projector_places(rig):
        px, py, pz = place.astype(np.float32)
        answers.append(measured & (across * (px - x * pz) + down * (py - y * pz) + inverse * pz < 1))
    return answers


def _slopes(inverse: NDArray[np.float32], measured: NDArray[np.bool_], axis: int) -> NDArray[np.float32]:
    """The change of inverse range from pixel to pixel along an axis, float32 [H, W]; 0 where no neighbour is.

    The mean of both sides where they are of one surface; else that of the flatter side, carried on by half of its own
    change from the pixel beyond, as surfaces bend away towards their outline.
    """
    values, known = np.moveaxis(inverse, axis, 0), np.moveaxis(measured, axis, 0)
    steps = np.diff(values, axis=0)
    steps[~(known[1:] & known[:-1])] = np.inf
    edge = np.full((1, values.shape[1]), np.inf, np.float32)
    before, after = np.concatenate([edge, steps]), np.concatenate([steps, edge])
    first = np.abs(before) <= np.abs(after)
    near, other = np.where(first, before, after), np.where(first, after, before)
    beyond = np.where(first, np.concatenate([edge, before[:-1]]), np.concatenate([after[1:], edge]))
    with np.errstate(invalid="ignore"):  # infinite less infinite, which is not chosen below
        bent = np.where(np.abs(beyond) <= _BENT * np.abs(near), 1.5 * near - 0.5 * beyond, near)
        slopes = np.where(np.abs(other) <= _ONE_SURFACE * np.abs(near), (near + other) / 2, bent)
    slopes[~np.isfinite(slopes)] = 0
    return np.moveaxis(slopes, 0, axis)


def facing_from_normals(
    rig: Rig, range_m: NDArray[np.floating[Any]], normals: NDArray[np.floating[Any]]
) -> list[NDArray[np.bool_]]:
    """As `facing_from_range`, from outward normals [H, W, 3] of the surfaces in the camera's frame, of any length."""
    points = rig.camera.pixel_rays() * range_m[..., None]
    measured = range_m > 0
    places = projector_places(rig)
    return [measured & (np.einsum("ijk,ijk->ij", normals, place - points) > 0) for place in places]
