"""The camera of a sequence of frames: named, given by numbers in OpenCV's terms, or assumed from the frames' size."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np

from bodyseg_data.core import BadConfig
from bodyseg_data.rigs import PAPER, Camera, Distortion, Rig, Sensor, load_sensor, rig_names

_SQUARE: Final = 0.01


@dataclass(frozen=True)
class FrameCamera:
    """A camera and the origin of its numbers. assumed: whether they follow from the frames' size alone. rig: the camera
    with its projector, where the sensor is known and has one.
    """

    camera: Camera
    origin: str
    assumed: bool = False
    rig: Rig | None = None

    @property
    def projector_side(self) -> Literal["left", "right"] | None:
        """The projector's side of the camera, as the camera looks; None if it is not known, or above or below.

        Also None for two projectors on different sides.
        """
        if self.rig is None:
            return None
        sides: set[Literal["left", "right"] | None] = set()
        for projector in self.rig.projectors:
            x, y, _ = self.camera.axes @ np.subtract(projector.position_m, self.rig.camera.position_m)
            sides.add(None if abs(x) <= abs(y) else "right" if x > 0 else "left")
        return sides.pop() if len(sides) == 1 else None

    def to_json(self) -> dict[str, Any]:
        """Intrinsics, any distortion and their origin as plain JSON; the pose does not matter to a frame."""
        camera = self.camera
        lens = {} if camera.distortion is None else {"distortion": camera.distortion.to_json()}
        return {
            "rows": camera.rows,
            "columns": camera.columns,
            "focal_px": camera.focal_px,
            "centre_px": list(camera.centre_px),
            **lens,
            "origin": self.origin,
        }


def assumed_sensors() -> tuple[Sensor, ...]:
    """The sensors that frames are assumed to be from by their size, in alphabetical order of their names."""
    return tuple(sensor for sensor in map(load_sensor, rig_names()) if sensor.assumed_for_size)


def other_sensors() -> tuple[Sensor, ...]:
    """`assumed_sensors` but the paper's, whose images the networks are trained on."""
    return tuple(sensor for sensor in assumed_sensors() if sensor.name != PAPER)


def frame_camera(
    shape: tuple[int, int],
    where: str,
    rig: str | None = None,
    focal_px: float | None = None,
    centre_px: tuple[float, ...] = (),
    trained: Rig | None = None,
) -> FrameCamera:
    """The camera of frames of `shape` (rows, columns): that of a rig file (one of `rig_names`, or a path), or one of
    given focal length and principal point (x, y; the middle if left out), or else one assumed for the size: of the rig
    that a network was `trained` for, where it has the size, or a sensor's.

    where: a frame, for messages. Raises BadConfig for a rig of another image size, a size that no sensor is assumed
    for, or options that contradict each other.
    """
    rows, columns = shape
    if rig is not None:
        if focal_px is not None or centre_px:
            raise BadConfig("give either --rig or --focal and --centre")
        sensor = load_sensor(rig)
        camera = sensor.camera
        if (camera.rows, camera.columns) != shape:
            raise BadConfig(
                f"frames must have the size of the rig's camera, {camera.rows} x {camera.columns}, "
                f"found {rows} x {columns}: {where}"
            )
        return FrameCamera(camera, f"rig {rig}", rig=sensor.rig)
    if len(centre_px) not in (0, 2):
        raise BadConfig(f"--centre takes two numbers, x and y, found {len(centre_px)}")
    if focal_px is not None:
        x, y = centre_px or (columns / 2, rows / 2)
        return FrameCamera(Camera(rows, columns, focal_px, (x, y), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)), "given")
    if centre_px:
        raise BadConfig("--centre needs --focal")
    sensors = assumed_sensors()
    named = trained is None or trained.camera in [sensor.camera for sensor in sensors]
    if trained is not None and not named and (trained.camera.rows, trained.camera.columns) == shape:
        origin = f"assumed: rig {trained.name}, which the network was trained for, by the frames' size"
        return FrameCamera(trained.camera, origin, True, trained)
    for sensor in sensors:
        if (sensor.camera.rows, sensor.camera.columns) == shape:
            return FrameCamera(sensor.camera, f"assumed: {sensor.title}, by the frames' size", True, sensor.rig)
    raise BadConfig(f"no sensor is assumed for frames of {rows} x {columns} pixels: give --focal or --rig ({where})")


@dataclass(frozen=True)
class Intrinsics:
    """Camera matrix and lens distortion of a frame as OpenCV gives them: pixels, pixel centres at whole numbers.

    size: (rows, columns) of the frame, None if the file does not say. where: the file, for messages. Raises BadConfig
    for focal lengths that differ by more than 1 %, which square pixels do not have.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: Distortion | None
    size: tuple[int, int] | None
    where: str

    def __post_init__(self) -> None:
        if abs(self.fx / self.fy - 1) > _SQUARE:
            raise BadConfig(f"{self.where}: pixels must be square, found 'fx' {self.fx:g} and 'fy' {self.fy:g}")

    def frame_camera(self, shape: tuple[int, int]) -> FrameCamera:
        """The camera of a frame of `shape` (rows, columns). Raises BadConfig for another size than the file's."""
        if self.size is not None and self.size != shape:
            expected, found = (" x ".join(map(str, size)) for size in (self.size, shape))
            raise BadConfig(f"{self.where}: the frame must have {expected} pixels, found {found}")
        centre, pose = (self.cx + 0.5, self.cy + 0.5), ((0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
        try:
            camera = Camera(*shape, math.sqrt(self.fx * self.fy), centre, *pose, distortion=self.distortion)
        except BadConfig as error:
            raise BadConfig(f"{self.where}: {error}") from None
        return FrameCamera(camera, f"file {self.where}")
