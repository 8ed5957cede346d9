"""Cameras and the structured-light rig: frozen, validated, read from a TOML file.

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
        """The same view with `factor` times as many pixels a side."""
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
    """A structured-light rig: what sees and what lights. The rig's frame is the camera's when its pose is the default.

    stand_off_m: the distance the rig is made for, metres; kept for the record, nothing computes with it.
    """

    name: str
    stand_off_m: float
    camera: Camera
    projector: Camera

    def __post_init__(self) -> None:
        if not _NAME.fullmatch(self.name):
            raise BadConfig(f"a rig's name must be one plain word of at most 40 letters, found {self.name[:60]!r}")
        if not (math.isfinite(self.stand_off_m) and self.stand_off_m > 0):
            raise BadConfig(f"a rig's stand-off must be positive, found {self.stand_off_m} m")

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
        """Plain numbers and strings, for manifests."""
        return {"format": RIG_FORMAT, **asdict(self)}

    @property
    def digest(self) -> str:
        """A short hash of everything that shapes an image."""
        return hashlib.sha256(json.dumps(self.to_json(), sort_keys=True).encode()).hexdigest()[:16]


def load_rig(name_or_path: str | Path = "paper") -> Rig:
    """Read a rig by the name of one that ships with the package, or from a TOML file (docs/rig.md).

    Raises BadConfig, naming file and key, for anything missing, unknown or out of range.
    """
    path = Path(name_or_path)
    if path.suffix != ".toml":
        shipped = resources.files(__package__) / "rigs" / f"{name_or_path}.toml"
        if not shipped.is_file():
            raise BadConfig(f"no rig is called {str(name_or_path)!r}: give 'paper' or the path of a .toml file")
        text = shipped.read_text(encoding="utf-8")
    else:
        try:
            text = path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise BadConfig(f"cannot read the rig file {path}: {error}") from error
    return parse_rig(text, str(name_or_path))


def parse_rig(text: str, where: str) -> Rig:
    """A rig from TOML text; `where` names its origin in messages."""
    try:
        tree = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # also numbers and brackets beyond reason
        raise BadConfig(f"rig {where} is not TOML: {error}") from error
    if tree.pop("format", None) != RIG_FORMAT:
        raise BadConfig(f"rig {where}: 'format' must be {RIG_FORMAT!r}")
    table = Table(tree, f"rig {where}")
    name, stand_off = table.text("name"), table.number("stand_off_m")
    camera, projector = (_camera(table.table(device)) for device in ("camera", "projector"))
    table.finish()
    try:
        return Rig(name, stand_off, camera, projector)
    except BadConfig as error:
        raise BadConfig(f"rig {where}: {error}") from None


def rig_from_json(tree: Any) -> Rig:
    """The inverse of `Rig.to_json`. Raises BadConfig."""
    if not isinstance(tree, dict) or tree.get("format") != RIG_FORMAT:
        raise BadConfig(f"a stored rig's 'format' must be {RIG_FORMAT!r}")
    table = Table({key: value for key, value in tree.items() if key != "format"}, "a stored rig")
    name, stand_off = table.text("name"), table.number("stand_off_m")
    camera, projector = (_stored_camera(table.table(device)) for device in ("camera", "projector"))
    table.finish()
    return Rig(name, stand_off, camera, projector)


def _stored_camera(table: Table) -> Camera:
    sides = table.whole("rows"), table.whole("columns")
    lens = table.number("focal_px"), table.numbers("centre_px", 2)
    pose = table.numbers("position_m", 3), table.numbers("aims_at_m", 3)
    table.finish()
    return Camera(*sides, *lens, *pose)


def _camera(table: Table) -> Camera:
    rows, columns = table.whole("rows"), table.whole("columns")
    focal_px = table.positive("focal_length_mm") / table.positive("pixel_pitch_um") * 1000
    # The middle of the image unless a calibration says otherwise.
    centre = table.numbers("centre_px", 2) if table.has("centre_px") else (columns / 2, rows / 2)
    position, aim = table.numbers("position_m", 3), table.numbers("aims_at_m", 3)
    table.finish()
    try:
        return Camera(rows, columns, focal_px, centre, position, aim)
    except BadConfig as error:
        raise BadConfig(f"{table.where}: {error}") from None
