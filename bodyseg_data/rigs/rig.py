"""Cameras and structured-light rigs: frozen, validated, read from TOML files; those in `rigs/` have names.

Axes follow the field's camera convention: x right, y down, z forward, in metres. Pixel (row r, column c) covers
[c, c + 1) × [r, r + 1) in image coordinates, so its centre is at (c + 0.5, r + 0.5). *Range* is the z coordinate in
the frame of the device that sees it (distance along the optical axis), not the length of the ray.
"""

from __future__ import annotations

import math
import re
from dataclasses import asdict, dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig, bounded, check_choice, check_fields, reported
from bodyseg_data.files import Table, TomlFiles
from bodyseg_data.rigs.camera import MAX_SIDE, Camera, PlacedCamera, axes_at, camera_from_table, check_intrinsics
from bodyseg_data.samples import View

RIG_FORMAT: Final = "bodyseg rig 1"
PAPER: Final = "paper"
"""The default rig."""
_FILES: Final = TomlFiles("rig", resources.files(__package__), RIG_FORMAT)

RANGE_STEP_MM: Final = 0.1
"""The step of stored ranges where a rig does not say, millimetres."""
FINEST_STEP_MM: Final = 0.01
COARSEST_STEP_MM: Final = 10.0
BODY_REACH_M: Final = 0.5
"""Depth of a body behind its centre with which a step is checked, metres; ranges beyond 16 bits fail when rendered."""

_MAX_STEPS: Final = 65535
_NAME: Final = re.compile(r"[A-Za-z0-9_+.-]{1,40}")


@dataclass(frozen=True)
class Rig:
    """A structured-light rig: a camera with one or two projectors. The rig's frame is the camera's if that has no pose.

    stand_off_m: the distance for which the rig is made, metres; bodies in other sensors' frames are resampled to it.
    range_step_mm: one step of its stored ranges, millimetres, 0.01 to 10. second_projector: with it, shadow is where
    neither projector lights; its image has as many columns as the first's. Raises BadConfig for values out of range.
    """

    name: str
    stand_off_m: float
    camera: Camera
    projector: Camera
    range_step_mm: float = bounded(RANGE_STEP_MM, FINEST_STEP_MM, COARSEST_STEP_MM)
    second_projector: Camera | None = None

    def __post_init__(self) -> None:
        check_fields(self)
        _check_name(self.name)
        if not (math.isfinite(self.stand_off_m) and self.stand_off_m > 0):
            raise BadConfig(f"a rig's stand-off must be positive, found {self.stand_off_m} m")
        for projector in self.projectors:
            if projector.distortion is not None:
                raise BadConfig(f"a projector has no lens distortion, found {projector.distortion}")
        if len({projector.columns for projector in self.projectors}) > 1:
            found = " and ".join(str(projector.columns) for projector in self.projectors)
            raise BadConfig(f"the images of two projectors must have equally many columns, found {found}")
        if (rows := self.projector_shape[0]) > MAX_SIDE:
            raise BadConfig(f"the images of two projectors must have at most {MAX_SIDE} rows together, found {rows}")
        self.check_reach(self.stand_off_m)

    @property
    def range_step_m(self) -> float:
        """One step of the rig's uint16 range images, metres: range in metres = steps * range_step_m."""
        return self.range_step_mm / 1000

    @property
    def projectors(self) -> tuple[Camera, ...]:
        """The one or two projectors, the first one first."""
        return (self.projector,) if self.second_projector is None else (self.projector, self.second_projector)

    @property
    def projector_shape(self) -> tuple[int, int]:
        """Rows and columns of a sample's projector range: that of all projectors, one below the other."""
        return sum(projector.rows for projector in self.projectors), self.projector.columns

    def by_projector(self) -> tuple[Rig, ...]:
        """A rig with one projector for each of this rig's, in order."""
        return tuple(replace(self, projector=projector, second_projector=None) for projector in self.projectors)

    def check_reach(self, distance_m: float) -> None:
        """Raise BadConfig unless 16 bits hold the ranges of a body so far away on the camera's axis, metres.

        All devices must reach `BODY_REACH_M` behind its centre.
        """
        centre = np.asarray(self.camera.position_m) + distance_m * self.camera.axes[2]
        away = (float(projector.axes[2] @ (centre - projector.position_m)) for projector in self.projectors)
        needed, reach = max(distance_m, *away) + BODY_REACH_M, _MAX_STEPS * self.range_step_m
        if needed > reach:
            raise BadConfig(
                f"{_MAX_STEPS} steps of 'range_step_mm' must reach {BODY_REACH_M:g} m behind a body {distance_m:g} m "
                f"away, {needed:.4g} m: found {self.range_step_mm:g} mm, which reach {reach:.4g} m"
            )

    @property
    def baseline_m(self) -> float:
        """Distance between the optical centres of camera and first projector, metres."""
        return math.dist(self.camera.position_m, self.projector.position_m)

    def placed(self, centre: NDArray[np.float64], view: View) -> tuple[PlacedCamera, PlacedCamera]:
        """Camera and first projector in the frame of a body whose bounding box is centred on `centre` [3].

        The rig moves and the body stays, so that whatever was built for the body's mesh serves all its views. The
        camera gets the pose that `View` describes and its own roll besides; the projector keeps its place beside the
        camera. Body frame: x to the subject's left, y up, z to the front, metres.
        """
        aim = np.add(centre, (0.0, view.height_cm / 100, 0.0))
        camera_axes = axes_at(view.azimuth_deg, view.pitch_deg, view.roll_deg + self.camera.roll_deg)
        camera_position = aim - view.distance_cm / 100 * camera_axes[2]
        # Axes of the rig in the body's frame, such that the camera gets exactly the pose above.
        rig_axes = self.camera.axes.T @ camera_axes
        rig_origin = camera_position - np.asarray(self.camera.position_m) @ rig_axes
        projector_position = np.asarray(self.projector.position_m) @ rig_axes + rig_origin
        projector = PlacedCamera(self.projector, self.projector.axes @ rig_axes, projector_position)
        return PlacedCamera(self.camera, camera_axes, camera_position), projector

    def camera_to_projector(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Rotation R [3, 3] and translation t [3] from the camera's frame to the first projector's: R @ point + t."""
        rotation = self.projector.axes @ self.camera.axes.T
        offset = np.subtract(self.camera.position_m, self.projector.position_m)
        return rotation, self.projector.axes @ offset

    def to_json(self) -> dict[str, Any]:
        """The rig as plain JSON, for manifests; a second projector only where there is one."""
        tree = {"format": RIG_FORMAT, **asdict(self)}
        tree |= {"camera": self.camera.to_json(), "projector": self.projector.to_json()}
        if self.second_projector is None:
            del tree["second_projector"]
        else:
            tree["second_projector"] = self.second_projector.to_json()
        return tree


@dataclass(frozen=True)
class Sensor:
    """The content of a rig file: a camera, with or without the projectors that make a rig of it.

    title: the sensor's name in prose. rig: None for a camera alone. assumed_for_size: whether frames of the camera's
    image size are taken to be this sensor's where nobody names a camera.
    """

    name: str
    title: str
    camera: Camera
    rig: Rig | None
    assumed_for_size: bool


def rig_names() -> tuple[str, ...]:
    """Names of the rig files that ship with the package, in alphabetical order."""
    return _FILES.names()


def load_rig(name_or_path: str | Path = PAPER) -> Rig:
    """Load a rig by the name of one that ships with the package, or from a TOML file (docs/how-to/rig.md).

    Raises BadConfig, naming file and key, for anything missing, unknown or out of range, and for a camera alone.
    """
    rig = load_sensor(name_or_path).rig
    if rig is None:
        raise BadConfig(f"rig {name_or_path} is a camera alone: rendering for it needs 'stand_off_m' and [projector]")
    return rig


def load_sensor(name_or_path: str | Path = PAPER) -> Sensor:
    """Read a rig file as `load_rig`, with or without a projector. Raises BadConfig."""
    return parse_sensor(_FILES.read(name_or_path), str(name_or_path))


def parse_sensor(text: str, where: str) -> Sensor:
    """Parse a rig file's text, with or without a projector; `where` names its origin in messages. Raises BadConfig."""
    table = Table(_FILES.parse(text, where), f"rig {where}")
    name = table.text("name")
    title = table.text("title") if "title" in table else name
    assumed = table.flag("assumed_for_size") if "assumed_for_size" in table else False
    camera = camera_from_table(table.table("camera"), posed=False, lens=True)
    is_rig = any(key in table for key in ("projector", "second_projector", "stand_off_m", "range_step_mm"))
    lighting = _lighting(table) if is_rig else {}
    table.finish()
    with reported(f"rig {where}", BadConfig):
        _check_name(name)
        found = Sensor(name, title, camera, Rig(name=name, camera=camera, **lighting) if is_rig else None, assumed)
    for key, device in {"camera": camera, **lighting}.items():
        if isinstance(device, Camera):
            shape = device.rows, device.columns
            check_intrinsics(device.focal_px, device.centre_px, shape, f"rig {where}, [{key}]")
    if found.rig is not None:
        _check_light(found.rig, f"rig {where}")
    return found


def _check_light(rig: Rig, where: str) -> None:
    """Raise BadConfig if a projector lights nothing of the plane that the camera sees at the stand-off."""
    camera, *projectors = (
        PlacedCamera(each, each.axes, np.array(each.position_m)) for each in (rig.camera, *rig.projectors)
    )
    points = camera.to_body(rig.stand_off_m * rig.camera.scaled(1 / 16).pixel_rays().reshape(-1, 3))
    for placed in projectors:
        device = placed.camera
        with np.errstate(divide="ignore", invalid="ignore"):  # points beside the projector
            at, depth = placed.project(points)
        if not ((depth > 0) & ((at > 0) & (at < (device.columns, device.rows))).all(axis=1)).any():
            raise BadConfig(
                f"{where}: a projector must light something that the camera sees {rig.stand_off_m:g} m away: "
                f"found one at {list(device.position_m)} m that aims at {list(device.aims_at_m)} (x right, z ahead)"
            )


def rig_from_json(tree: Any) -> Rig:
    """Rebuild a rig from what `Rig.to_json` gave. Raises BadConfig."""
    table = Table(tree, "a stored rig")
    check_choice("a stored rig's 'format'", table.text("format"), (RIG_FORMAT,))
    name, camera = table.text("name"), camera_from_table(table.table("camera"), posed=True, lens=True)
    lighting = _lighting(table)
    table.finish()
    return Rig(name=name, camera=camera, **lighting)


def _lighting(table: Table) -> dict[str, Any]:
    """Read what a rig has besides its camera: keywords of `Rig`."""
    found: dict[str, Any] = {"stand_off_m": table.number("stand_off_m")}
    found["projector"] = camera_from_table(table.table("projector"), posed=True)
    if "range_step_mm" in table:
        found["range_step_mm"] = table.number("range_step_mm")
    if "second_projector" in table:
        found["second_projector"] = camera_from_table(table.table("second_projector"), posed=True)
    return found


def _check_name(name: str) -> None:
    if not _NAME.fullmatch(name):
        raise BadConfig(f"a rig's name must be one plain word of at most 40 letters, found {name[:60]!r}")
