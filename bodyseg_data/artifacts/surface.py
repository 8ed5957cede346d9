"""Surfaces in a clean range image: how they lie to the camera, and where one ends before another."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts.constants import FAR
from bodyseg_data.artifacts.lost_pixels import Box
from bodyseg_data.rigs import Camera

_ARCCOS: Final = tuple(map(np.float32, (1.5707288, -0.2121144, 0.0742610, -0.0187293)))
_STEEPEST: Final = np.float32(0.0871557)  # cosine of 85 degrees: the slopes of a range image end there


def slants(range_image: NDArray[np.uint16], camera: Camera, box: Box) -> NDArray[np.float32]:
    """The slant of each surface to the camera: 1 / cos**2 of the angle between normal and ray, float32 [h, w].

    A surface z(u, v) seen by a pinhole camera with rays (x, y, 1) has the normal (-f z_u, -f z_v, z + f x z_u +
    f y z_v), whose product with the ray is z. Slopes are differences to the neighbour whose range differs less, so that
    no wall is seen between an edge and the surface behind it. box: the part of the image to compute, beyond which all
    is background; values on background mean nothing.
    """
    rows, columns = box
    focal = np.float32(camera.focal_px)
    x = ((np.arange(camera.columns, dtype=np.float32)[columns] + 0.5) - np.float32(camera.centre_px[0])) / focal
    y = (((np.arange(camera.rows, dtype=np.float32)[rows] + 0.5) - np.float32(camera.centre_px[1])) / focal)[:, None]
    z = range_image[box].astype(np.float32)
    z[z == 0] = FAR
    across, down = _slope(z, 1), _slope(z, 0)
    across *= focal
    down *= focal
    slant: NDArray[np.float32] = (z + x * across + y * down) ** 2
    slant += across**2
    slant += down**2
    slant *= (x**2 + 1) + y**2
    slant /= z**2
    return slant


def _slope(z: NDArray[np.float32], axis: int) -> NDArray[np.float32]:
    """The smaller one of the differences to a pixel's two neighbours along an axis."""
    step = np.diff(z, axis=axis, prepend=FAR, append=FAR)
    backward, forward = (step[:-1], step[1:]) if axis == 0 else (step[:, :-1], step[:, 1:])
    smaller: NDArray[np.float32] = np.where(np.abs(forward) <= np.abs(backward), forward, backward)
    return smaller


def angles(slant: NDArray[np.float32]) -> NDArray[np.float32]:
    """The angle of incidence, radians, 0 facing the camera, at most 85 degrees; slant: of `slants`, any shape.

    arccos(x) = sqrt(1 - x) times a cubic, within 0.00007 (Abramowitz and Stegun, Handbook of Mathematical Functions,
    1964, 4.4.45): sums, products and roots alone, so every machine gives the same bits.
    """
    one = np.float32(1)
    cosine = np.maximum(one / np.sqrt(np.maximum(slant, one)), _STEEPEST)
    constant, linear, square, cube = _ARCCOS
    cubic = constant + cosine * (linear + cosine * (square + cosine * cube))
    found: NDArray[np.float32] = np.sqrt(one - cosine) * cubic
    return found


def silhouettes(range_image: NDArray[np.uint16], jump: float) -> NDArray[np.bool_]:
    """Mark the pixels of the foreground beside background or beside a range that differs by more than `jump`, [H, W].

    range_image: uint16 [H, W], 0 is background; jump: in its steps. Neighbours are those above, below, left and right;
    the image's border is none.
    """
    z = range_image.astype(np.int32)
    marked = np.zeros(z.shape, np.bool_)
    for first, second, near, far in (
        (marked[1:], marked[:-1], z[1:], z[:-1]),
        (marked[:, 1:], marked[:, :-1], z[:, 1:], z[:, :-1]),
    ):
        ends = (np.abs(near - far) > jump) | ((near == 0) != (far == 0))
        first |= ends
        second |= ends
    marked &= z > 0
    return marked


def widened(marked: NDArray[np.bool_], pixels: int) -> NDArray[np.bool_]:
    """Mark all pixels at most `pixels` rows and columns away from a marked one, [H, W]."""
    found = marked.copy()
    for _ in range(pixels):
        before = found.copy()
        found[1:] |= before[:-1]
        found[:-1] |= before[1:]
        before = found.copy()
        found[:, 1:] |= before[:, :-1]
        found[:, :-1] |= before[:, 1:]
    return found
