"""Lens distortion as drivers give it, brought to the five coefficients of `Distortion` by one fit.

Names and formulas are those of OpenCV and ROS (plumb_bob, rational_polynomial, equidistant) and of `rs2_distortion` in
librealsense (https://github.com/IntelRealSense/librealsense, src/rs.cpp). A direction is (x, y, 1), r^2 = x^2 + y^2.
"""

import re
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig
from bodyseg_data.rigs import Distortion
from bodyseg_model.recordings.cameras import Intrinsics

MODELS: Final = {  # name of a model -> the form of it, and how many coefficients it may have
    "plumb_bob": ("plain", (4, 5)),
    "brown_conrady": ("plain", (4, 5)),
    "modified_brown_conrady": ("modified", (4, 5)),
    "inverse_brown_conrady": ("inverse", (4, 5)),
    "rational_polynomial": ("rational", (4, 5, 8, 12)),
    "equidistant": ("fisheye", (4, 5)),
    "fisheye": ("fisheye", (4, 5)),
    "kannala_brandt4": ("fisheye", (4, 5)),
}
"""Names in small letters, words joined by _."""

_MOST_OFF_PX: Final = 1.0
_LATTICE: Final = 40

Floats = NDArray[np.float64]


def driver_camera(
    model: str,
    coefficients: Sequence[float],
    camera: tuple[float, float, float, float],
    size: tuple[int, int] | None,
    where: str,
) -> Intrinsics:
    """A camera whose lens is given by the name of its model and its coefficients in that model's order.

    They become a `Distortion`, none where all are 0: exact for plumb_bob, else fitted over the whole image. camera: fx,
    fy, cx and cy of `Intrinsics`. Raises BadConfig as that, for a model or a number of coefficients that is not known,
    and for a lens that five coefficients follow no nearer than to a pixel.
    """
    fx, fy, cx, cy = camera
    if not any(coefficients):
        return Intrinsics(*camera, None, size, where)
    name = re.sub(r"[^a-z0-9]+", "_", model.lower())
    form, counts = MODELS.get(name, ("", ()))
    given = list(coefficients)
    while len(given) > 4 and not given[-1]:  # zeros behind say nothing
        given.pop()
    count = next((count for count in counts if count >= len(given)), 0)
    if not count:
        raise BadConfig(
            f"{where}: distortion must be plumb_bob, of 4 or 5 coefficients, or one of "
            f"{', '.join(list(MODELS)[1:])}, found {model!r} of {len(coefficients)}: undistort the "
            "recording, or give --focal or --rig"
        )
    given += [0.0] * (12 - len(given))
    if form == "plain" or (form == "rational" and not any(given[5:])):
        return Intrinsics(*camera, Distortion(*given[:5]), size, where)
    rows, columns = size or (2 * cy + 1, 2 * cx + 1)
    across, down = (np.linspace(0, side - 1, _LATTICE) for side in (columns, rows))
    with np.errstate(all="ignore"):  # numbers beyond reason
        x, y = (each.ravel() for each in np.meshgrid((across - cx) / fx, (down - cy) / fy))
        if form == "inverse":  # the formula gives the direction of what the lens draws
            (x, y), drawn = Distortion(*given[:5]).apply(x, y), (x, y)
        else:
            drawn = _drawn(form, given, x, y)
        found, off = _fitted(x, y, drawn)
    if found is None or not off * max(fx, fy) <= _MOST_OFF_PX:
        raise BadConfig(
            f"{where}: five coefficients must follow the lens to {_MOST_OFF_PX:g} pixel, found "
            f"{off * max(fx, fy):.3g} for {model!r}: undistort the recording, or give --focal or --rig"
        )
    return Intrinsics(*camera, found, size, where)


def _drawn(form: str, given: list[float], x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Places at z = 1 where a lens draws directions (x, y, 1)."""
    squared = x * x + y * y
    r = np.sqrt(squared)
    if form == "fisheye":
        theta2 = np.arctan(r) ** 2
        k1, k2, k3, k4 = given[:4]
        drawn = np.arctan(r) * (1 + theta2 * (k1 + theta2 * (k2 + theta2 * (k3 + theta2 * k4))))
        factor = np.where(r > 0, drawn / np.where(r > 0, r, 1), 1.0)
        return x * factor, y * factor
    k1, k2, p1, p2, k3, k4, k5, k6, *prism = given
    factor = 1 + squared * (k1 + squared * (k2 + squared * k3))
    factor = factor / (1 + squared * (k4 + squared * (k5 + squared * k6)))
    u, v = (x * factor, y * factor) if form == "modified" else (x, y)  # where the lens is off centre by p1 and p2
    squared_there = u * u + v * v
    across = x * factor + 2 * p1 * u * v + p2 * (squared_there + 2 * u * u)
    down = y * factor + p1 * (squared_there + 2 * v * v) + 2 * p2 * u * v
    s1, s2, s3, s4 = prism
    return across + squared * (s1 + squared * s2), down + squared * (s3 + squared * s4)


def _fitted(x: Floats, y: Floats, drawn: tuple[Floats, Floats]) -> tuple[Distortion | None, float]:
    """The five coefficients that draw directions (x, y, 1) nearest to `drawn`; and the largest error, at z = 1."""
    squared, mixed = x * x + y * y, 2 * x * y
    radial = [squared, squared**2, squared**3]
    rows = [
        np.stack([x * radial[0], x * radial[1], mixed, squared + 2 * x * x, x * radial[2]], 1),
        np.stack([y * radial[0], y * radial[1], squared + 2 * y * y, mixed, y * radial[2]], 1),
    ]
    matrix, wanted = np.concatenate(rows), np.concatenate([drawn[0] - x, drawn[1] - y])
    if not (np.isfinite(matrix).all() and np.isfinite(wanted).all()):
        return None, np.inf
    solved, *_ = np.linalg.lstsq(matrix, wanted, rcond=None)
    left = (matrix @ solved - wanted).reshape(2, -1)
    return Distortion(*map(float, solved)), float(np.hypot(*left).max())
