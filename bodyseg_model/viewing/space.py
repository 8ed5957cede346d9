"""Points and devices in the space of the page, and a drawing: all that a page shows at one moment.

x is to the right and y up as the sensor's camera looks, z towards it. Units are metres. Of a set, the origin is the
body's middle, which stands upright; of a recording, it is the camera.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.rig import Camera, PlacedCamera, Rig
from bodyseg_data.core.views import View
from bodyseg_model.viewing.pictures import Legend

Viewpoint = Literal["points", "sensor", "camera"]
VIEWPOINTS: Final[tuple[Viewpoint, ...]] = get_args(Viewpoint)
"""What a window can look at: the points, the sensor with them, and both as the sensor's camera sees them."""

_DIRECTIONS: Final = {"points": (0.42, 0.16, 0.9), "sensor": (1.0, 0.35, 0.5), "camera": (0.0, 0.0, 1.0)}
_AROUND: Final = 1.35
"""A window takes in so many times what it looks at."""

_GAP_M: Final = 0.01
_NAME_M: Final = 0.13
"""Distance of a device and its name."""

_OPENCV: Final = np.diag([1.0, -1.0, -1.0])
"""Axes of a camera that looks along -z, rows: to its right, down, forward."""


@dataclass(frozen=True)
class Points:
    """Coloured points. xyz: float32 [N, 3], metres; colours: sRGB uint8 [N, 3]."""

    xyz: NDArray[np.float32] = field(repr=False)
    colours: NDArray[np.uint8] = field(repr=False)


@dataclass(frozen=True)
class Device:
    """A camera or projector to draw as a pyramid. wxyz: rotation to the space of the page, a unit quaternion.

    fov_rad: its vertical field of view; aspect: width over height.
    """

    name: str
    wxyz: tuple[float, float, float, float]
    position_m: tuple[float, float, float]
    fov_rad: float
    aspect: float


def points_at(range_m: NDArray[np.float32], placed: PlacedCamera) -> NDArray[np.float32]:
    """Points of the pixels that measured something, in reading order, float32 [N, 3].

    range_m: [H, W], metres along the optical axis, 0 = nothing measured.
    """
    seen = range_m > 0
    rays = placed.camera.pixel_rays()[seen]
    found: NDArray[np.float32] = placed.to_body(rays * range_m[seen, None].astype(np.float64)).astype(np.float32)
    return found


def point_gap_m(range_m: NDArray[np.float32], camera: Camera) -> float:
    """Distance of points of neighbouring pixels at the median of the ranges measured, metres; 1 cm if there is none.

    range_m: of the camera's pixels, metres, 0 = nothing measured.
    """
    seen = range_m[range_m > 0]
    return float(np.median(seen)) / camera.focal_px if len(seen) else _GAP_M


def rig_before(rig: Rig, view: View) -> tuple[PlacedCamera, ...]:
    """Camera and projectors of a view, seen from in front: the body is turned instead of the rig."""
    ahead = replace(view, azimuth_deg=0)
    one = [single.placed(np.zeros(3), ahead) for single in rig.by_projector()]
    return (one[0][0], *(projector for _, projector in one))


def camera_alone(camera: Camera) -> PlacedCamera:
    """A camera in the origin that looks along -z."""
    return PlacedCamera(camera, _OPENCV, np.zeros(3))


def device(name: str, placed: PlacedCamera) -> Device:
    """A placed camera or projector as a device to draw."""
    camera = placed.camera
    x, y, z = np.asarray(placed.position, np.float64).tolist()
    fov = 2 * math.atan(camera.rows / 2 / camera.focal_px)
    return Device(name, quaternion(placed.axes.T), (x, y, z), fov, camera.columns / camera.rows)


def viewpoint(
    xyz: NDArray[np.float32], devices: Sequence[Device], kind: Viewpoint, fov_rad: float, aspect: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A place to look from and a point to look at, metres, float64 [3] each, that take in what `kind` says.

    xyz: of the points, float32 [N, 3]. fov_rad: vertical field of view of the window; aspect: its width over its
    height. "points": before them, a little beside and above the sensor's camera. "sensor": from the side, the points
    and all devices. "camera": the sensor's.
    """
    low, high = np.full(3, -1.0), np.full(3, 1.0)
    if len(xyz):
        low, high = np.quantile(xyz, (0.01, 0.99), axis=0).astype(np.float64)
    middle = (low + high) / 2
    if kind == "camera" and devices:
        place = np.asarray(devices[0].position_m)
        return place, np.array([*place[:2], middle[2]])
    if kind == "sensor":
        places = np.array([low, high, *(each.position_m for each in devices)])
        low, high = places.min(0), places.max(0)
        middle = (low + high) / 2
    width, height = max(high[0] - low[0], high[2] - low[2]), max(0.3, float(high[1] - low[1]))
    span = max(height, width / aspect)
    away = _AROUND * span / 2 / np.tan(fov_rad / 2)
    towards = np.array(_DIRECTIONS[kind])
    return middle + away * towards / np.linalg.norm(towards), middle


def name_heights(devices: Sequence[Device]) -> list[float]:
    """Height of each device's name above the device, metres: names of devices that nearly coincide lie apart.

    The highest device has its name above it, of equally high ones the leftmost; the next ones have theirs below them.
    """
    order = sorted(devices, key=lambda each: (-round(each.position_m[1], 1), each.position_m[0]))
    return [_NAME_M if each is order[0] else -_NAME_M * order.index(each) for each in devices]


def quaternion(rotation: NDArray[np.float64]) -> tuple[float, float, float, float]:
    """Unit quaternion (w, x, y, z), w at least 0, of a rotation matrix, float64 [3, 3].

    It is the eigenvector of the largest eigenvalue of a symmetric 4 x 4 matrix: Bar-Itzhack, "New method for
    extracting the quaternion from a rotation matrix", Journal of Guidance, Control, and Dynamics 23(6), 2000.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation
    symmetric = np.array(
        [
            [xx + yy + zz, zy - yz, xz - zx, yx - xy],
            [zy - yz, xx - yy - zz, xy + yx, xz + zx],
            [xz - zx, xy + yx, yy - xx - zz, yz + zy],
            [yx - xy, xz + zx, yz + zy, zz - xx - yy],
        ]
    )
    w, x, y, z = np.linalg.eigh(symmetric)[1][:, -1].tolist()
    sign = -1.0 if w < 0 else 1.0
    return sign * w, sign * x, sign * y, sign * z


@dataclass(frozen=True)
class Drawing:
    """Points, devices, a picture of panels, sRGB uint8 [H, W, 3], and facts in lines of plain text.

    gap_m: distance of neighbouring points, metres, which their size on the page follows. bodies: number of the first
    points, which are of bodies, and to which a window is turned. legend: of the colours of the points.
    """

    points: Points
    devices: tuple[Device, ...]
    picture: NDArray[np.uint8] = field(repr=False)
    facts: tuple[str, ...]
    gap_m: float
    bodies: int
    legend: Legend = field(repr=False)
