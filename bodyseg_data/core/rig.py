"""Cameras and structured-light rigs: frozen, validated, read from TOML files; those in `rigs/` have names.

Axes follow the field's camera convention: x right, y down, z forward, in metres. Pixel (row r, column c) covers
[c, c + 1) × [r, r + 1) in image coordinates, so its centre is at (c + 0.5, r + 0.5). *Range* is the z coordinate in
the frame of the device that sees it (distance along the optical axis), not the length of the ray.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
import tomllib
from dataclasses import asdict, dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.tables import Table
from bodyseg_data.core.views import View

RIG_FORMAT: Final = "bodyseg rig 1"
PAPER: Final = "paper"
"""The default rig."""

RANGE_STEP_MM: Final = 0.1
"""The step of stored ranges where a rig does not say, millimetres."""
FINEST_STEP_MM: Final = 0.01
COARSEST_STEP_MM: Final = 10.0
BODY_REACH_M: Final = 0.5
"""How far behind its centre a body is taken to reach when a rig's step is checked; a view that has more is refused."""

_MAX_STEPS: Final = 65535
_MAX_SIDE: Final = 8192
_MAX_FOCAL_PX: Final = 1e6
_MAX_DISTANCE_M: Final = 100.0
_NAME: Final = re.compile(r"[A-Za-z0-9_+.-]{1,40}")

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Camera:
    """A pinhole camera or, with light going the other way, a projector.

    rows, columns: image size in pixels. focal_px: focal length in pixels (square pixels). centre_px: principal
    point (x, y) in image coordinates. position_m: optical centre in the rig's frame. aims_at_m: the point of the
    rig's frame on the optical axis; the image's x axis stays in the rig's xz plane (no roll).
    """

    rows: int
    columns: int
    focal_px: float
    centre_px: tuple[float, float]
    position_m: Vector
    aims_at_m: Vector

    def __post_init__(self) -> None:
        if not (1 <= self.rows <= _MAX_SIDE and 1 <= self.columns <= _MAX_SIDE):
            raise BadConfig(f"an image side must be 1 to {_MAX_SIDE} pixels, found {self.rows} x {self.columns}")
        if not 0 < self.focal_px <= _MAX_FOCAL_PX:
            raise BadConfig(
                f"a focal length must be positive, at most {_MAX_FOCAL_PX:g} px, found {self.focal_px:g} px"
            )
        if not all(abs(number) <= _MAX_DISTANCE_M for number in (*self.position_m, *self.aims_at_m)):
            raise BadConfig(
                f"a camera's position and aim must lie within {_MAX_DISTANCE_M:g} m, found {self.position_m}, "
                f"{self.aims_at_m}"
            )
        if not all(abs(number) <= _MAX_FOCAL_PX for number in self.centre_px):
            raise BadConfig(f"a principal point must lie near the image, found {self.centre_px}")
        axis = np.subtract(self.aims_at_m, self.position_m)
        if np.hypot(axis[0], axis[2]) < 1e-6:
            raise BadConfig(f"a camera must not look straight up or down, found an axis of {axis.tolist()}")

    @property
    def axes(self) -> NDArray[np.float64]:
        """Rows are this camera's x, y and z axes in the rig's frame, [3, 3]: local = axes @ (point - position)."""
        forward = np.subtract(self.aims_at_m, self.position_m)
        forward = forward / np.linalg.norm(forward)
        right = np.cross((0.0, 1.0, 0.0), forward)
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(forward, right), forward])

    def pixel_rays(self) -> NDArray[np.float64]:
        """Directions through all pixel centres in this camera's own frame, [rows, columns, 3], scaled to z = 1.

        With that scale the parameter of a point on the ray *is* its range.
        """
        rays = np.ones((self.rows, self.columns, 3))
        rays[..., 0] = (np.arange(self.columns) + 0.5 - self.centre_px[0]) / self.focal_px
        rays[..., 1] = ((np.arange(self.rows) + 0.5 - self.centre_px[1]) / self.focal_px)[:, None]
        return rays

    def scaled(self, factor: int) -> Camera:
        """The same view with `factor` times as many pixels a side. Raises BadConfig for a factor below 1."""
        if factor < 1:
            raise BadConfig(f"an image is refined by a whole factor of at least 1, found {factor}")
        return replace(
            self,
            rows=self.rows * factor,
            columns=self.columns * factor,
            focal_px=self.focal_px * factor,
            centre_px=(self.centre_px[0] * factor, self.centre_px[1] * factor),
        )


@dataclass(frozen=True)
class PlacedCamera:
    """A camera in a body's frame: `axes` [3, 3] (rows: its x, y, z), `position` [3], both float64."""

    camera: Camera
    axes: NDArray[np.float64]
    position: NDArray[np.float64]

    def to_local(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points of the body's frame [..., 3] in this camera's frame, metres."""
        return (points - self.position) @ self.axes.T

    def to_body(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points of this camera's frame [..., 3] in the body's frame, metres."""
        return points @ self.axes + self.position

    def project(self, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Image coordinates [..., 2] (x, y) and range [...] of points [..., 3] in front of the camera."""
        local = self.to_local(points)
        return local[..., :2] / local[..., 2:] * self.camera.focal_px + self.camera.centre_px, local[..., 2]


def axes_at(azimuth_deg: int) -> NDArray[np.float64]:
    """Axes [3, 3], rows x, y, z in the body's frame, of an upright camera that looks at the body from an azimuth."""
    turn = math.radians(azimuth_deg)
    right, back = [math.cos(turn), 0.0, -math.sin(turn)], np.array([math.sin(turn), 0.0, math.cos(turn)])
    return np.array([right, [0.0, -1.0, 0.0], -back])


@dataclass(frozen=True)
class Rig:
    """A structured-light rig: a camera and a projector. The rig's frame is the camera's when its pose is the default.

    stand_off_m: the distance for which the rig is made, metres; bodies in other sensors' frames are resampled to it.
    range_step_mm: one step of its stored ranges, millimetres, 0.01 to 10. Raises BadConfig for values out of range.
    """

    name: str
    stand_off_m: float
    camera: Camera
    projector: Camera
    range_step_mm: float = RANGE_STEP_MM

    def __post_init__(self) -> None:
        _check_name(self.name)
        if not (math.isfinite(self.stand_off_m) and self.stand_off_m > 0):
            raise BadConfig(f"a rig's stand-off must be positive, found {self.stand_off_m} m")
        if not FINEST_STEP_MM <= self.range_step_mm <= COARSEST_STEP_MM:
            raise BadConfig(
                f"'range_step_mm' must be {FINEST_STEP_MM:g} to {COARSEST_STEP_MM:g}, found {self.range_step_mm:g}"
            )
        self.check_reach(self.stand_off_m)

    @property
    def range_step_m(self) -> float:
        """One step of the rig's uint16 range images, metres: range in metres = steps * range_step_m."""
        return self.range_step_mm / 1000

    def check_reach(self, distance_m: float) -> None:
        """Raise BadConfig unless 16 bits hold the ranges of a body that far away on the camera's axis, metres.

        Both devices must reach `BODY_REACH_M` behind its centre.
        """
        centre = np.asarray(self.camera.position_m) + distance_m * self.camera.axes[2]
        away = float(self.projector.axes[2] @ (centre - self.projector.position_m))
        needed, reach = max(distance_m, away) + BODY_REACH_M, _MAX_STEPS * self.range_step_m
        if needed > reach:
            raise BadConfig(
                f"{_MAX_STEPS} steps of 'range_step_mm' must reach {BODY_REACH_M:g} m behind a body {distance_m:g} m "
                f"away, {needed:.4g} m: found {self.range_step_mm:g} mm, which reach {reach:.4g} m"
            )

    @property
    def baseline_m(self) -> float:
        """Distance between the optical centres of camera and projector, metres."""
        return math.dist(self.camera.position_m, self.projector.position_m)

    def placed(self, centre: NDArray[np.float64], view: View) -> tuple[PlacedCamera, PlacedCamera]:
        """Camera and projector in the frame of a body whose bounding box is centred on `centre` [3].

        The rig moves and the body stays, so that whatever was built for the body's mesh serves all its views.
        Body frame: x to the subject's left, y up, z to the front, metres.
        """
        camera_axes = axes_at(view.azimuth_deg)
        camera_position = np.asarray(centre, np.float64) - view.distance_cm / 100 * camera_axes[2]
        # Axes of the rig in the body's frame, such that the camera gets exactly the pose above.
        rig_axes = self.camera.axes.T @ camera_axes
        rig_origin = camera_position - np.asarray(self.camera.position_m) @ rig_axes
        projector_axes = self.projector.axes @ rig_axes
        projector_position = np.asarray(self.projector.position_m) @ rig_axes + rig_origin
        return (
            PlacedCamera(self.camera, camera_axes, camera_position),
            PlacedCamera(self.projector, projector_axes, projector_position),
        )

    def camera_to_projector(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Rotation [3, 3] and translation [3] with projector_point = rotation @ camera_point + translation."""
        rotation = self.projector.axes @ self.camera.axes.T
        offset = np.subtract(self.camera.position_m, self.projector.position_m)
        return rotation, self.projector.axes @ offset

    def with_projector_scale(self, factor: int) -> Rig:
        """The same rig with a projector-view image of `factor` times as many pixels a side."""
        return replace(self, projector=self.projector.scaled(factor))

    def to_json(self) -> dict[str, Any]:
        """The rig as plain JSON, for manifests."""
        return {"format": RIG_FORMAT, **asdict(self)}

    @property
    def digest(self) -> str:
        """A short hash of everything that shapes an image."""
        return hashlib.sha256(json.dumps(self.to_json(), sort_keys=True).encode()).hexdigest()[:16]


@dataclass(frozen=True)
class Sensor:
    """The content of a rig file: a camera, with or without the projector that makes a rig of it.

    title: the sensor's name in prose. rig: None for a camera alone. assumed_for_size: whether frames of the camera's
    image size are taken to be this sensor's where nobody names a camera.
    """

    name: str
    title: str
    camera: Camera
    rig: Rig | None
    assumed_for_size: bool

    def __post_init__(self) -> None:
        _check_name(self.name)


def rig_names() -> tuple[str, ...]:
    """Names of the rig files that ship with the package, in alphabetical order."""
    files = (resources.files(__package__) / "rigs").iterdir()
    return tuple(sorted(file.name.removesuffix(".toml") for file in files if file.name.endswith(".toml")))


def load_rig(name_or_path: str | Path = PAPER) -> Rig:
    """Read a rig by the name of one that ships with the package, or from a TOML file (docs/rig.md).

    Raises BadConfig, naming file and key, for anything missing, unknown or out of range, and for a camera alone.
    """
    return parse_rig(_rig_text(name_or_path), str(name_or_path))


def load_sensor(name_or_path: str | Path = PAPER) -> Sensor:
    """Read a rig file as `load_rig`, with or without a projector. Raises BadConfig."""
    return parse_sensor(_rig_text(name_or_path), str(name_or_path))


def _rig_text(name_or_path: str | Path) -> str:
    path = Path(name_or_path)
    if path.suffix != ".toml":
        if str(name_or_path) not in rig_names():
            names = ", ".join(rig_names())
            raise BadConfig(f"no rig is called {str(name_or_path)!r}: give one of {names} or the path of a .toml file")
        return (resources.files(__package__) / "rigs" / f"{name_or_path}.toml").read_text(encoding="utf-8")
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise BadConfig(f"cannot read the rig file {path}: {error}") from error


def parse_rig(text: str, where: str) -> Rig:
    """Parse a rig from TOML text; `where` names its origin in messages. Raises BadConfig as `load_rig`."""
    rig = parse_sensor(text, where).rig
    if rig is None:
        raise BadConfig(f"rig {where} is a camera alone: rendering for it needs 'stand_off_m' and [projector]")
    return rig


def parse_sensor(text: str, where: str) -> Sensor:
    """Parse a rig file's text, with or without a projector; `where` names its origin in messages. Raises BadConfig."""
    try:
        tree = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # also numbers and brackets beyond reason
        raise BadConfig(f"rig {where} is not TOML: {error}") from error
    if tree.pop("format", None) != RIG_FORMAT:
        raise BadConfig(f"rig {where}: 'format' must be {RIG_FORMAT!r}")
    table = Table(tree, f"rig {where}")
    name = table.text("name")
    title = table.text("title") if table.has("title") else name
    assumed = table.flag("assumed_for_size") if table.has("assumed_for_size") else False
    camera, lighting = _camera(table.table("camera"), posed=False), None
    if any(map(table.has, ("projector", "stand_off_m", "range_step_mm"))):
        lighting = table.number("stand_off_m"), _camera(table.table("projector"), posed=True), _range_step_mm(table)
    table.finish()
    try:
        rig = None if lighting is None else Rig(name, lighting[0], camera, *lighting[1:])
        return Sensor(name, title, camera, rig, assumed)
    except BadConfig as error:
        raise BadConfig(f"rig {where}: {error}") from None


def rig_from_json(tree: Any) -> Rig:
    """Rebuild a rig from what `Rig.to_json` gave. Raises BadConfig."""
    if not isinstance(tree, dict) or tree.get("format") != RIG_FORMAT:
        raise BadConfig(f"a stored rig's 'format' must be {RIG_FORMAT!r}")
    table = Table({key: value for key, value in tree.items() if key != "format"}, "a stored rig")
    name, stand_off = table.text("name"), table.number("stand_off_m")
    camera, projector = (_camera(table.table(device), posed=True) for device in ("camera", "projector"))
    step_mm = _range_step_mm(table)
    table.finish()
    return Rig(name, stand_off, camera, projector, step_mm)


def _range_step_mm(table: Table) -> float:
    return table.number("range_step_mm") if table.has("range_step_mm") else RANGE_STEP_MM


def _camera(table: Table, posed: bool) -> Camera:
    """A [camera] or [projector] table; posed: whether it must say where the device is, else its frame is the rig's."""
    rows, columns = table.whole("rows"), table.whole("columns")
    if table.has("focal_px"):
        focal_px = table.positive("focal_px")
    else:
        focal_px = table.positive("focal_length_mm") / table.positive("pixel_pitch_um") * 1000
    # The middle of the image unless a calibration says otherwise.
    centre = table.numbers("centre_px", 2) if table.has("centre_px") else (columns / 2, rows / 2)
    position, aim = (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)
    if posed or table.has("position_m") or table.has("aims_at_m"):
        position, aim = table.numbers("position_m", 3), table.numbers("aims_at_m", 3)
    table.finish()
    try:
        return Camera(rows, columns, focal_px, centre, position, aim)
    except BadConfig as error:
        raise BadConfig(f"{table.where}: {error}") from None


def _check_name(name: str) -> None:
    if not _NAME.fullmatch(name):
        raise BadConfig(f"a rig's name must be one plain word of at most 40 letters, found {name[:60]!r}")
