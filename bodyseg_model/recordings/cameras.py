"""The camera of a sequence of frames: named, given by numbers in OpenCV's terms, or assumed from the frames' size.

Lens distortion as drivers give it is brought to the five coefficients of `Distortion` by one fit. Names and formulas
are those of OpenCV and ROS (plumb_bob, rational_polynomial, equidistant) and of `rs2_distortion` in librealsense
(https://github.com/IntelRealSense/librealsense, src/rs.cpp). A direction is (x, y, 1), r^2 = x^2 + y^2.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig, reported
from bodyseg_data.rigs import PAPER, Camera, Distortion, Rig, Sensor, check_intrinsics, load_sensor, rig_names

_SQUARE: Final = 0.01
_NEARLY_SQUARE: Final = 0.1


@dataclass(frozen=True)
class FrameCamera:
    """A camera, `camera`, and where its numbers come from. assumed: whether they follow from the frames' size alone.
    rig: the camera with its projector, where the sensor is known and has one.
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
    where: str = "frames",
    rig: str | None = None,
    focal_px: float | None = None,
    centre_px: tuple[float, ...] = (),
    trained: Rig | None = None,
) -> FrameCamera:
    """The camera of frames of `shape` (rows, columns): of a rig, of given numbers, or assumed for that size.

    rig: one of `rig_names`, or a path. focal_px, centre_px: focal length and principal point (x, y; by default the
    middle). Without both, the camera is that of the rig that a network was `trained` for, where it has the size, or a
    sensor's.
    where: a frame, for messages. Raises BadConfig for a rig of another image size, a size that no sensor is assumed
    for, or options that contradict each other.
    """
    with reported(f"shape must be (rows, columns), found {shape!r:.60}", BadConfig, TypeError, ValueError):
        rows, columns = shape
    shape = rows, columns  # no list of them would be equal to a tuple
    if rig is not None:
        if focal_px is not None or len(centre_px):
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
        x, y = map(float, centre_px) if len(centre_px) else (columns / 2, rows / 2)
        check_intrinsics(focal_px, (x, y), shape, f"--focal and --centre, {where}")
        return FrameCamera(Camera(rows, columns, focal_px, (x, y), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)), "given")
    if len(centre_px):
        raise BadConfig("--centre needs --focal")
    sensors = assumed_sensors()
    named = trained is None or trained.camera in [sensor.camera for sensor in sensors]
    if trained is not None and not named and (trained.camera.rows, trained.camera.columns) == shape:
        origin = f"assumed: rig {trained.name}, which the network was trained for, by the frames' size"
        return FrameCamera(trained.camera, origin, True, trained)
    for sensor in sensors:
        if (sensor.camera.rows, sensor.camera.columns) == shape:
            return FrameCamera(sensor.camera, f"assumed: {sensor.title}, by the frames' size", True, sensor.rig)
    size = f"{rows} rows of {columns} pixels"
    raise BadConfig(f"no sensor is assumed for frames of {size}: give --focal or --rig ({where})")


@dataclass(frozen=True)
class Intrinsics:
    """Camera matrix and lens distortion of a frame as OpenCV gives them: pixels, pixel centres at whole numbers.

    size: (rows, columns) of the frame, None if the file does not say. where: the file, for messages. Focal lengths that
    differ by more than 1 %, which square pixels do not have, are part of the lens: frames are resampled. Raises
    BadConfig if they differ by more than 10 %, and unless both are above 0.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: Distortion | None
    size: tuple[int, int] | None
    where: str

    def __post_init__(self) -> None:
        if not (self.fx > 0 < self.fy and abs(self.fx / self.fy - 1) <= _NEARLY_SQUARE):
            found = f"'fx' {self.fx:g} and 'fy' {self.fy:g}"
            raise BadConfig(f"{self.where}: focal lengths must be above 0, and pixels square, found {found}")

    @property
    def lens(self) -> Distortion | None:
        """Distortion, with the shape of pixels that are not square; None for none."""
        if abs(self.fx / self.fy - 1) <= _SQUARE:
            return self.distortion
        return replace(self.distortion or Distortion(), aspect=math.sqrt(self.fx / self.fy))

    def frame_camera(self, shape: tuple[int, int]) -> FrameCamera:
        """The camera of a frame of `shape` (rows, columns). Raises BadConfig for another size than the file's."""
        if self.size is not None and tuple(self.size) != tuple(shape):
            expected, found = (" x ".join(map(str, size)) for size in (self.size, shape))
            raise BadConfig(f"{self.where}: the frame must have {expected} pixels, found {found}")
        focal_px = math.sqrt(self.fx * self.fy)
        check_intrinsics(focal_px, (self.cx + 0.5, self.cy + 0.5), shape, self.where)
        centre, pose = (self.cx + 0.5, self.cy + 0.5), ((0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
        with reported(self.where, BadConfig):
            return FrameCamera(Camera(*shape, focal_px, centre, *pose, distortion=self.lens), f"file {self.where}")


MODELS: Final = {  # name of a model -> the form of it, and how many coefficients it may have
    "plumb_bob": ("plain", (4, 5)),
    "brown_conrady": ("plain", (4, 5)),
    "modified_brown_conrady": ("modified", (4, 5)),
    "inverse_brown_conrady": ("modified", (4, 5)),  # librealsense projects by the same formula
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
    """Camera as a driver gives it: a lens by the name of its model, with the coefficients in that model's order.

    They become a `Distortion`, none where all are 0: exact for plumb_bob, else fitted over the whole image. camera: fx,
    fy, cx and cy of `Intrinsics`, as are size and where. Raises BadConfig as that, for a model or a number of
    coefficients that is not known, and for a lens that five coefficients do not follow to within a pixel.
    """
    fx, fy, cx, cy = camera
    given: list[float] = np.ravel(coefficients).tolist()  # OpenCV has them in a matrix of one row or column
    length = len(given)
    if not any(given):
        return Intrinsics(*camera, None, size, where)
    name = re.sub(r"[^a-z0-9]+", "_", model.lower())
    form, counts = MODELS.get(name, ("", ()))
    while len(given) > 4 and not given[-1]:  # zeros at the end have no effect
        given.pop()
    count = next((count for count in counts if count >= len(given)), 0)
    if not count or length < counts[0]:
        raise BadConfig(
            f"{where}: distortion must be plumb_bob, of 4 or 5 coefficients, or one of "
            f"{', '.join(list(MODELS)[1:])}, found {model!r} of {length}: undistort the "
            "recording, or give --focal or --rig"
        )
    given += [0.0] * (12 - len(given))
    if form == "plain" or (form == "rational" and not any(given[5:])):
        with reported(where, BadConfig):
            plain = Distortion(*given[:5])
        return Intrinsics(*camera, plain, size, where)
    rows, columns = size or (2 * cy + 1, 2 * cx + 1)
    across, down = (np.linspace(0, side - 1, _LATTICE) for side in (columns, rows))
    with np.errstate(all="ignore"):  # numbers beyond reason
        x, y = (each.ravel() for each in np.meshgrid((across - cx) / fx, (down - cy) / fy))
        found, off = _fitted(x, y, _drawn(form, given, x, y))
    if found is None or not off * max(fx, fy) <= _MOST_OFF_PX:
        raise BadConfig(
            f"{where}: five coefficients must follow the lens to {_MOST_OFF_PX:g} pixel, found "
            f"{off * max(fx, fy):.3g} for {model!r}: undistort the recording, or give --focal or --rig"
        )
    return Intrinsics(*camera, found, size, where)


def _drawn(form: str, given: list[float], x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Places at z = 1 to which a lens projects directions (x, y, 1)."""
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
    u, v = (x * factor, y * factor) if form == "modified" else (x, y)  # the point at which p1 and p2 count
    across = x * factor + 2 * p1 * u * v + p2 * (squared + 2 * u * u)
    down = y * factor + p1 * (squared + 2 * v * v) + 2 * p2 * u * v
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
