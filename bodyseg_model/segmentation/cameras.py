"""Which camera took a sequence of frames."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.rig import Camera, load_rig

SENSORS: Final = {(480, 640): ("Kinect v1", 525.0), (424, 512): ("Kinect v2", 365.0)}
"""Image sizes that one widespread sensor has -> its name and nominal focal length, pixels."""


@dataclass(frozen=True)
class FrameCamera:
    """A camera and where its numbers are from; an assumed one was told by the frames' size alone."""

    camera: Camera
    origin: str
    assumed: bool = False

    def to_json(self) -> dict[str, Any]:
        """What counts for a frame; poses do not."""
        camera = self.camera
        return {
            "rows": camera.rows,
            "columns": camera.columns,
            "focal_px": camera.focal_px,
            "centre_px": list(camera.centre_px),
            "origin": self.origin,
        }


def frame_camera(
    shape: tuple[int, int],
    where: str,
    rig: str | None = None,
    focal_px: float | None = None,
    centre_px: tuple[float, ...] = (),
) -> FrameCamera:
    """The camera of frames of `shape` (rows, columns): that of a rig (its name or a TOML file), or one of given focal
    length and principal point (x, y; the middle if left out), or that of a sensor with such images.

    where: a frame, for messages. Raises BadConfig for a rig of another image size, a size that tells no sensor, or
    options that contradict each other.
    """
    rows, columns = shape
    if rig is not None:
        if focal_px is not None or centre_px:
            raise BadConfig("give either --rig or --focal and --centre")
        camera = load_rig(rig).camera
        if (camera.rows, camera.columns) != shape:
            raise BadConfig(
                f"frames must have the size of the rig's camera, {camera.rows} x {camera.columns}, "
                f"found {rows} x {columns}: {where}"
            )
        return FrameCamera(camera, f"rig {rig}")
    if len(centre_px) not in (0, 2):
        raise BadConfig(f"--centre takes two numbers, x and y, found {len(centre_px)}")
    if focal_px is not None:
        return FrameCamera(_camera(shape, focal_px, centre_px), "given")
    if centre_px:
        raise BadConfig("--centre needs --focal")
    paper = load_rig().camera
    if shape == (paper.rows, paper.columns):
        return FrameCamera(paper, "assumed: the paper's rig, by the frames' size", True)
    if shape not in SENSORS:
        raise BadConfig(f"frames of {rows} x {columns} pixels tell no sensor: give --focal or --rig ({where})")
    name, focal = SENSORS[shape]
    return FrameCamera(_camera(shape, focal, ()), f"assumed: {name}, by the frames' size", True)


def _camera(shape: tuple[int, int], focal_px: float, centre_px: tuple[float, ...]) -> Camera:
    rows, columns = shape
    x, y = centre_px or (columns / 2, rows / 2)
    return Camera(rows, columns, focal_px, (x, y), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
