"""Cameras and projectors of rigs, their poses, and lens distortion; axes as in `rig.py`.

Distortion is the Brown-Conrady model, with OpenCV's coefficients in OpenCV's order.

D. C. Brown, "Decentering distortion of lenses", Photogrammetric Engineering 32(3), 1966; the form is that of OpenCV's
`calibrateCamera` with five coefficients (https://docs.opencv.org/4.x/d9/d0c/group__calib3d.html). For a point (x, y, 1)
of the camera's frame and r^2 = x^2 + y^2, the lens draws it at

    x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)
    y' = y (1 + k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 y^2) + 2 p2 x y
"""

from __future__ import annotations

import math
from dataclasses import MISSING, asdict, dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig, Checked, bounded, check_fields, reported
from bodyseg_data.files import Table

MODEL: Final = "brown_conrady"

_MOST: Final = 1e6

Floats = NDArray[np.float64]

MAX_SIDE: Final = 8192
"""Longest side of an image, pixels."""

_MAX_FOCAL_PX: Final = 1e6
_FOCAL_SHARES: Final = (0.2, 50.0)  # of the longer side: 136 degrees and 1 degree of it are seen
_FAR_M: Final = 100.0
_MAX_ROLL_DEG: Final = 180.0
_LEAST_ACROSS: Final = 1e-6
_CHECKED_NODES: Final = 65  # nodes a side at which distortion is checked

Vector = tuple[float, float, float]

_UP: Final = (0.0, -1.0, 0.0)  # of a rig's frame, whose y points down


@dataclass(frozen=True)
class Camera:
    """A pinhole camera or, with light going the other way, a projector.

    rows, columns: image size in pixels. focal_px: focal length in pixels (square pixels).
    centre_px: principal point (x, y) in image coordinates.
    position_m, aims_at_m: optical centre, and a point on the optical axis before it, in the rig's frame, metres.
    up: a direction of the rig's frame, up in the image; without roll, the image's x axis is at right angles to it.
    roll_deg: rotation about the optical axis, -180 to 180, clockwise as seen from behind the camera; what is seen turns
    the other way.
    distortion: of the frames that the camera takes; all else here, and all that is rendered, is of the ideal image
    without it. Raises BadConfig for a value out of range.
    """

    rows: int = bounded(MISSING, 1, MAX_SIDE)
    columns: int = bounded(MISSING, 1, MAX_SIDE)
    focal_px: float = bounded(MISSING, 0, _MAX_FOCAL_PX, above=True)
    centre_px: tuple[float, float] = bounded(MISSING, -_MAX_FOCAL_PX, _MAX_FOCAL_PX)
    position_m: tuple[float, float, float] = bounded(MISSING, -_FAR_M, _FAR_M)
    aims_at_m: tuple[float, float, float] = bounded(MISSING, -_FAR_M, _FAR_M)
    up: tuple[float, float, float] = bounded(_UP, -_FAR_M, _FAR_M)
    roll_deg: float = bounded(0.0, -_MAX_ROLL_DEG, _MAX_ROLL_DEG)
    distortion: Distortion | None = None

    def __post_init__(self) -> None:
        check_fields(self)
        axis = np.subtract(self.aims_at_m, self.position_m)
        if not axis.any():
            raise BadConfig(f"a camera must not aim at its own position, found {self.aims_at_m}")
        if not np.linalg.norm(np.cross(self.up, axis)) >= _LEAST_ACROSS:
            raise BadConfig(f"a camera must not look straight up or down, along its 'up', found {axis.tolist()}")
        if self.distortion is not None:
            across = (np.linspace(0, self.columns, _CHECKED_NODES) - self.centre_px[0]) / self.focal_px
            down = (np.linspace(0, self.rows, _CHECKED_NODES) - self.centre_px[1]) / self.focal_px
            if not self.distortion.is_one_to_one(*np.meshgrid(across, down)):
                raise BadConfig(f"lens distortion must not fold the image over, found {self.distortion}")

    @property
    def axes(self) -> Floats:
        """Rows are this camera's x, y and z axes in the rig's frame, [3, 3]: local = axes @ (point - position)."""
        forward = np.subtract(self.aims_at_m, self.position_m)
        forward = forward / np.linalg.norm(forward)
        right = np.cross(0.0 - np.array(self.up), forward)  # 0 - 0 has no sign
        right /= np.linalg.norm(right)
        return rolled(np.stack([right, np.cross(forward, right), forward]), self.roll_deg)

    def pixel_rays(self) -> Floats:
        """Rays through all pixel centres in this camera's frame, [rows, columns, 3], z = 1: point = range * ray."""
        rays = np.ones((self.rows, self.columns, 3))
        rays[..., 0], rays[..., 1] = self.slopes[0], self.slopes[1][:, None]
        return rays

    def points(self, range_m: NDArray[Any], rows: NDArray[np.intp], columns: NDArray[np.intp]) -> Floats:
        """The points [N, 3] of this camera's frame that the given pixels of a range image [H, W] see, metres."""
        x, y = self.slopes
        points: Floats = np.stack([x[columns], y[rows], np.ones(len(rows))], axis=1) * range_m[rows, columns, None]
        return points

    @property
    def slopes(self) -> tuple[Floats, Floats]:
        """The x of the rays through each column [columns] and the y of those through each row [rows], at z = 1."""
        across = np.divide(np.arange(self.columns) + 0.5 - self.centre_px[0], self.focal_px)
        return across, np.divide(np.arange(self.rows) + 0.5 - self.centre_px[1], self.focal_px)

    def turned(self, quarters: int) -> Camera:
        """The camera of images that are turned clockwise by so many right angles, `np.rot90(image, -quarters)`.

        Its roll is less by as much: a camera that was mounted turned clockwise becomes an upright one.
        """
        camera = self
        for _ in range(quarters % 4):
            (x, y), roll = camera.centre_px, camera.roll_deg - 90
            camera = replace(
                camera,
                rows=camera.columns,
                columns=camera.rows,
                centre_px=(camera.rows - y, x),
                roll_deg=roll if roll > -_MAX_ROLL_DEG else roll + 360,
                distortion=None if camera.distortion is None else camera.distortion.turned(),
            )
        return camera

    def to_json(self) -> dict[str, Any]:
        """The camera as plain JSON; `up`, roll and distortion only where they are not the default."""
        tree = asdict(self)
        for field, default in (("up", _UP), ("roll_deg", 0.0), ("distortion", None)):
            if getattr(self, field) == default:
                del tree[field]
        if self.distortion is not None:
            tree["distortion"] = self.distortion.to_json()
        return tree

    def scaled(self, factor: float) -> Camera:
        """The same view with `factor` times as many pixels a side, rounded up."""
        return replace(
            self,
            rows=math.ceil(self.rows * factor),
            columns=math.ceil(self.columns * factor),
            focal_px=self.focal_px * factor,
            centre_px=(self.centre_px[0] * factor, self.centre_px[1] * factor),
        )


@dataclass(frozen=True)
class PlacedCamera:
    """A camera in a body's frame: `axes` [3, 3] (rows: its x, y, z), `position` [3], both float64."""

    camera: Camera
    axes: Floats
    position: Floats

    def to_local(self, points: Floats) -> Floats:
        """Points of the body's frame [..., 3] in this camera's frame, metres."""
        return (points - self.position) @ self.axes.T

    def to_body(self, points: Floats) -> Floats:
        """Points of this camera's frame [..., 3] in the body's frame, metres."""
        return points @ self.axes + self.position

    def points(self, range_m: NDArray[Any], rows: NDArray[np.intp], columns: NDArray[np.intp]) -> Floats:
        """As `Camera.points`, in the body's frame."""
        return self.to_body(self.camera.points(range_m, rows, columns))

    def project(self, points: Floats) -> tuple[Floats, Floats]:
        """Image coordinates [..., 2] (x, y) and range [...] of points [..., 3] in front of the camera."""
        local = self.to_local(points)
        return local[..., :2] / local[..., 2:] * self.camera.focal_px + self.camera.centre_px, local[..., 2]


def axes_at(azimuth_deg: int, pitch_deg: float = 0.0, roll_deg: float = 0.0) -> Floats:
    """Axes [3, 3], rows x, y, z in the body's frame, of a camera that looks at the body from an azimuth.

    pitch_deg: angle of the optical axis above the horizontal; negative looks down. roll_deg: as of `rolled`.
    """
    turn, pitch = math.radians(azimuth_deg), math.radians(pitch_deg)
    right, down = [math.cos(turn), 0.0, -math.sin(turn)], np.array([0.0, -1.0, 0.0])
    forward = np.array([-math.sin(turn), 0.0, -math.cos(turn)])
    cos, sin = math.cos(pitch), math.sin(pitch)
    return rolled(np.array([right, cos * down + sin * forward, cos * forward - sin * down]), roll_deg)


def rolled(axes: Floats, roll_deg: float) -> Floats:
    """Axes [3, 3] of a camera turned about its optical axis, clockwise as seen from behind it."""
    right, down, forward = axes
    cos, sin = math.cos(math.radians(roll_deg)), math.sin(math.radians(roll_deg))
    return np.array([cos * right + sin * down, cos * down - sin * right, forward])


@dataclass(frozen=True)
class Distortion(Checked):
    """Distortion of a lens by radial coefficients k1, k2, k3 and tangential p1, p2, without unit.

    aspect: factor by which images are stretched across, and its inverse down: the root of fx / fy where pixels are not
    square. Raises BadConfig beyond 1e6.
    """

    k1: float = bounded(0.0, -_MOST, _MOST)
    k2: float = bounded(0.0, -_MOST, _MOST)
    p1: float = bounded(0.0, -_MOST, _MOST)
    p2: float = bounded(0.0, -_MOST, _MOST)
    k3: float = bounded(0.0, -_MOST, _MOST)
    aspect: float = bounded(1.0, 0, _MOST, above=True)

    def apply(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        """Return where the lens draws the directions (x, y, 1), at z = 1; all float64 of one shape."""
        squared = x * x + y * y
        radial = 1 + squared * (self.k1 + squared * (self.k2 + squared * self.k3))
        return (
            (x * radial + 2 * self.p1 * x * y + self.p2 * (squared + 2 * x * x)) * self.aspect,
            (y * radial + self.p1 * (squared + 2 * y * y) + 2 * self.p2 * x * y) / self.aspect,
        )

    def turned(self) -> Distortion:
        """The same lens in images turned clockwise by a right angle: (p2, p1) is a direction in them."""
        return replace(self, p1=self.p2, p2=-self.p1, aspect=1 / self.aspect)

    def is_one_to_one(self, x: Floats, y: Floats) -> bool:
        """True if the lens keeps the order of neighbouring directions (x, y, 1) everywhere in a lattice.

        That is where the derivative of `apply`, a matrix of two by two, has a positive determinant and trace.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            squared = x * x + y * y
            radial = 1 + squared * (self.k1 + squared * (self.k2 + squared * self.k3))
            growth = 2 * (self.k1 + squared * (2 * self.k2 + squared * 3 * self.k3))  # of radial, along x by x
            mixed = x * y * growth + 2 * (self.p1 * x + self.p2 * y)
            along_x = radial + x * x * growth + 2 * self.p1 * y + 6 * self.p2 * x
            along_y = radial + y * y * growth + 6 * self.p1 * y + 2 * self.p2 * x
            determinant, trace = along_x * along_y - mixed * mixed, along_x + along_y
        return bool(((determinant > 0) & (trace > 0)).all())

    def to_json(self) -> dict[str, Any]:
        """Model and coefficients as plain JSON, as in a rig file; the aspect where it is not 1."""
        tree = {"model": MODEL, **asdict(self)}
        if self.aspect == 1:
            del tree["aspect"]
        return tree


def distortion_from_table(table: Table) -> Distortion:
    """Read what `Distortion.to_json` gives; a coefficient that is left out is 0. Raises BadConfig."""
    model = table.text("model")
    if model != MODEL:
        raise BadConfig(f"{table.where}: 'model' must be {MODEL!r}, found {model!r}")
    names = Distortion.__dataclass_fields__
    coefficients = {name: table.number(name) for name in names if name in table}
    table.finish()
    with reported(table.where, BadConfig):
        return Distortion(**coefficients)


def check_intrinsics(focal_px: float, centre_px: tuple[float, float], shape: tuple[int, int], where: str) -> None:
    """Raise BadConfig for a focal length that no camera of images of `shape` (rows, columns) has, as in another unit.

    centre_px: principal point (x, y), pixels; shares of the image are refused, and points 79 degrees beside it. where:
    the camera, for messages. What is no length at all is left to `Camera`.
    """
    rows, columns = shape
    least, most = (share * max(shape) for share in _FOCAL_SHARES)
    if 0 < focal_px < least or most < focal_px <= _MAX_FOCAL_PX:
        hint = "a share of the image" if focal_px <= 2 else "in millimetres" if focal_px < least else "in another unit"
        raise BadConfig(
            f"{where}: a focal length must be in pixels, {least:.4g} to {most:.5g} for images of {rows} x {columns}, "
            f"found {focal_px:.5g}: is it {hint}?"
        )
    shares = min(shape) > 16 and all(0 < value <= 1.5 for value in centre_px)
    if shares or max(map(abs, centre_px)) > max(shape) + 5 * abs(focal_px):
        raise BadConfig(
            f"{where}: a principal point must be in pixels, found {centre_px[0]:g} and {centre_px[1]:g} for images of "
            f"{rows} x {columns}: are they {'shares of the image' if shares else 'in another unit'}?"
        )


def camera_from_table(table: Table, posed: bool, lens: bool = False) -> Camera:
    """Read a [camera] or [projector] table. Raises BadConfig, naming the table, for anything missing or out of range.

    posed: whether it must say where the device is, else its frame is the rig's. lens: whether it may hold distortion.
    """
    rows, columns = table.whole("rows"), table.whole("columns")
    if ("focal_px" in table) == ("focal_length_mm" in table):
        raise BadConfig(f"{table.where}: give either 'focal_px' or 'focal_length_mm' with 'pixel_pitch_um'")
    if "focal_px" in table:
        focal_px = table.positive("focal_px")
    else:
        focal_px = table.positive("focal_length_mm") / table.positive("pixel_pitch_um") * 1000
    # The middle of the image unless a calibration says otherwise.
    centre = table.numbers("centre_px", 2) if "centre_px" in table else (columns / 2, rows / 2)
    position, aim = (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)
    if posed or "position_m" in table or "aims_at_m" in table:
        position, aim = table.numbers("position_m", 3), table.numbers("aims_at_m", 3)
    up = table.numbers("up", 3) if "up" in table else _UP
    roll_deg = table.number("roll_deg") if "roll_deg" in table else 0.0
    distortion = distortion_from_table(table.table("distortion")) if lens and "distortion" in table else None
    table.finish()
    with reported(table.where, BadConfig):
        return Camera(rows, columns, focal_px, centre, position, aim, up, roll_deg, distortion)
