"""Alignment of a mesh file with the body frame: its unit, and its axes that point up and left.

The posture is kept: a body is scaled, and rotated by one of the 24 rotations that take axes to axes. Unit and axes, if
not given, are found from the body's size and its landmarks: the trunk points up, the shoulders lie left and right.
"""

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadMesh
from bodyseg_data.labels import LANDMARKS
from bodyseg_data.meshes import HEIGHT_RANGE_M, METRES

Units = Literal["auto", "m", "cm", "mm", "in"]
UpAxis = Literal["auto", "x", "y", "z", "-x", "-y", "-z"]

UPRIGHT_DEG: Final = 25.0
"""Largest lean of trunk and legs of a body that counts as upright, degrees."""

_TOO_LEANING_DEG: Final = 40.0  # at 45 degrees the next axis is as near
_LARGER, _OTHER_UNIT = 1.4, 9.0  # no body is 1.4 times as large as its landmarks; from 9 on, their units may differ
_FOUND_BY_SIZE: Final = ("m", "cm", "mm")


@dataclass(frozen=True)
class Alignment:
    """Transform of a file's coordinates into the body frame. Made by `find_alignment`.

    scale: metres in the file's unit. rotation: float64 [3, 3], one of the 24; its rows are the directions to the
    subject's left, up and to the front, in the file's axes. lean_deg: angle from upright of the trunk or the legs,
    whichever is larger, of the body that it was found from.
    """

    scale: float
    rotation: NDArray[np.float64]
    lean_deg: float

    def apply(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return points [N, 3] of the file in the body frame, metres."""
        # No matrix product: it would spread values that are not finite.
        from_axis = np.abs(self.rotation).argmax(axis=1)
        placed: NDArray[np.float64] = points[:, from_axis] * (self.scale * self.rotation.sum(axis=1))
        return placed


def find_alignment(
    surface: NDArray[np.float64], landmarks: NDArray[np.float64], units: Units, up: UpAxis, where: str
) -> Alignment:
    """Find the alignment of one body.

    surface: the vertices [N, 3] that its faces use, as the file has them. landmarks: its points [33, 3] in the same
    axes, whatever their unit. where: names the file in messages. Raises BadMesh if no unit gives a body of human
    size, or if the axis that points up is to be found and the trunk points along none.
    """
    try:
        scale = metres_a_unit(surface, units, where)
    except BadMesh as error:
        ratio = np.ptp(surface, axis=0).max() / max(np.ptp(landmarks, axis=0).max(), 1e-9)
        if not _LARGER < ratio < _OTHER_UNIT:
            raise
        raise BadMesh(f"{error} (landmarks span 1 / {ratio:.2g} of it: is a floor or a wall in the mesh?)") from None
    points = dict(zip(LANDMARKS, landmarks, strict=True))
    pelvis = (points["Rt. PSIS"] + points["Lt. PSIS"]) / 2
    feet = (points["Rt. Lateral Malleolus"] + points["Lt. Lateral Malleolus"]) / 2
    trunk = _direction(points["Cervicale"] - pelvis)
    legs = _direction(pelvis - feet)
    left = _direction(points["Lt. Acromion"] - points["Rt. Acromion"])
    upward = _axis(up) if up != "auto" else _nearest_axis(trunk)
    if up == "auto" and _angle(trunk, upward) > _TOO_LEANING_DEG:
        raise BadMesh(f"{where}: the trunk points along {np.round(trunk, 2).tolist()}, between the axes: give --up")
    leftward = _nearest_axis(left, not_along=upward)
    rotation = np.stack([leftward, upward, np.cross(leftward, upward)])
    return Alignment(scale, rotation, max(_angle(trunk, upward), _angle(legs, upward)))


def metres_a_unit(surface: NDArray[np.float64], units: Units, where: str) -> float:
    """Return the metres in the unit of the vertices [N, 3] of a whole body. Raises BadMesh if no unit fits."""
    extents = np.ptp(surface, axis=0)
    extent = float(extents.max())
    shown = " x ".join(f"{value:.4g}" for value in extents)
    low, high = HEIGHT_RANGE_M
    fitting = [unit for unit in METRES if low <= extent * METRES[unit] <= high]
    if units != "auto":
        if units not in fitting:
            fits = f", which would fit in {' or '.join(fitting)}" if fitting else ""
            raise BadMesh(f"{where}: a body must be {low} to {high} m at its largest, found {shown} {units}{fits}")
        return METRES[units]
    if len(fitting) == 1 and fitting[0] in _FOUND_BY_SIZE:
        return METRES[fitting[0]]
    if fitting:
        sizes = " or ".join(f"{extent * METRES[unit]:.3g} m if in {unit}" for unit in fitting)
        raise BadMesh(f"{where}: cannot find the unit: the body is {shown}, that is {sizes}; give it with --units")
    raise BadMesh(f"{where}: a body must be {low} to {high} m at its largest: found {shown}, which fits in no unit")


def upright_rotation(up: UpAxis) -> NDArray[np.float64]:
    """Return the rotation [3, 3] of `Alignment` for a scene, of which only the axis that points up is known.

    The x axis points left; where it points up, -y does. So a scene with z up, as programs of robotics write it, shows
    its side of -y at azimuth 0.
    """
    upward = _axis(up)
    left = _axis("-y" if up.endswith("x") else "x")
    return np.stack([left, upward, np.cross(left, upward)])


def _axis(name: str) -> NDArray[np.float64]:
    axis = np.zeros(3)
    axis["xyz".index(name[-1])] = -1.0 if name.startswith("-") else 1.0
    return axis


def _nearest_axis(direction: NDArray[np.float64], not_along: NDArray[np.float64] | float = 0.0) -> NDArray[np.float64]:
    index = int(np.where(np.equal(not_along, 0), np.abs(direction), -1.0).argmax())
    axis = np.zeros(3)
    axis[index] = -1.0 if direction[index] < 0 else 1.0
    return axis


def _direction(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    length = float(np.linalg.norm(vector))
    return vector / length if length else vector


def _angle(direction: NDArray[np.float64], axis: NDArray[np.float64]) -> float:
    return float(np.degrees(np.arccos(np.clip(direction @ axis, -1.0, 1.0))))
