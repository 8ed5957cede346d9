"""Surfaces in a clean range image: where they are, how they lie to the camera, and where one ends before another."""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts.constants import ARCCOS, FAR, STEEPEST
from bodyseg_data.machine import if_ready, loops
from bodyseg_data.rigs import Camera

Box = tuple[slice, slice]

_RIGHT_ANGLE: Final = np.float32(np.pi / 2)


def box_of(image: NDArray[Any], margin: int = 0) -> Box | None:
    """The rows and columns that all of an image of whole numbers or a mask [H, W] but 0 reaches over; None if all is 0.

    margin: pixels more on every side, where the image has them. By the bits of whole rows, which takes three fifths of
    the time that `any` takes for 16-bit ranges.
    """
    rows = np.flatnonzero(np.bitwise_or.reduce(image, axis=1))
    if not len(rows):
        return None
    columns = np.flatnonzero(np.bitwise_or.reduce(image[rows[0] : rows[-1] + 1], axis=0))
    top, left = max(int(rows[0]) - margin, 0), max(int(columns[0]) - margin, 0)
    return slice(top, int(rows[-1]) + 1 + margin), slice(left, int(columns[-1]) + 1 + margin)


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
    cosine = np.maximum(one / np.sqrt(np.maximum(slant, one)), STEEPEST)
    constant, linear, square, cube = ARCCOS
    cubic = constant + cosine * (linear + cosine * (square + cosine * cube))
    found: NDArray[np.float32] = np.sqrt(one - cosine) * cubic
    return found


def incidence(range_image: NDArray[np.uint16], camera: Camera, pixels: NDArray[np.intp]) -> NDArray[np.float32]:
    """The angle of incidence at each pixel of the foreground, radians, float32 [N]; see `angles`.

    range_image: clean, uint16 [H, W], 0 is background. pixels: flat indices of the foreground in reading order, [N].
    """
    with if_ready:
        found: NDArray[np.float32] = compiled_forms().incidence(range_image, camera, pixels)
        return found
    box = box_of(range_image)
    if box is None:
        return np.zeros(0, np.float32)
    return angles(slants(range_image, camera, box)[range_image[box] != 0])


def grazing(angle: NDArray[np.float32]) -> NDArray[np.float32]:
    """Theta / (pi/2 - theta) of angles of incidence theta, radians: 0 facing the camera, 17 at 85 degrees.

    The measure of Nguyen, Izadi and Lovell, "Modeling Kinect sensor noise for improved 3D reconstruction and
    tracking", 3DIMPVT 2012.
    """
    found: NDArray[np.float32] = angle / (_RIGHT_ANGLE - angle)
    return found


def silhouettes(range_image: NDArray[np.uint16], jump: float) -> NDArray[np.bool_]:
    """Mark the pixels of the foreground beside background or beside a range that differs by more than `jump`, [H, W].

    range_image: uint16 [H, W], 0 is background; jump: in its steps. Neighbours are those above, below, left and right;
    the image's border is none.
    """
    with if_ready:
        found: NDArray[np.bool_] = compiled_forms().silhouettes(range_image, jump)
        return found
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
    with if_ready:
        compiled: NDArray[np.bool_] = compiled_forms().widened(marked, pixels)
        return compiled
    found = marked.copy()
    for _ in range(pixels):
        before = found.copy()
        found[1:] |= before[:-1]
        found[:-1] |= before[1:]
        before = found.copy()
        found[:, 1:] |= before[:, :-1]
        found[:, :-1] |= before[:, 1:]
    return found


def compiled_forms() -> Any:
    """The compiled forms, for `if_ready`."""
    return loops("bodyseg_data.artifacts.sensor_loops")
