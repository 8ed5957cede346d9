"""Cameras in messages: the CameraInfo beside a topic of images."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.rigs.distortion import Distortion
from bodyseg_model.recordings.bags.messages import CAMERA_INFO, Bag, Topic, decode
from bodyseg_model.recordings.intrinsics import Intrinsics

_TRANSPORTS: Final = ("compressedDepth", "compressed")
_MODEL: Final = "plumb_bob"


def camera_beside(bag: Bag, topic: Topic, where: str) -> Intrinsics | None:
    """Read the camera of a topic of images from the first CameraInfo beside it; None if there is none.

    That is `camera_info` in the topic's namespace, or in `info/` as RealSense's recordings have it. Of a rectified
    image ("image_rect"), the camera is that of the projection matrix, without distortion. Raises BadConfig for
    distortion of another model than plumb_bob, and for a camera of binned or cut images.
    """
    parts = [part for part in topic.name.split("/") if part]
    if parts and parts[-1] in _TRANSPORTS:
        del parts[-1]
    names = {"/".join(["", *parts[:-1], "camera_info"]), "/".join(["", *parts[:-2], "info", "camera_info"])}
    info = next((each for each in bag.topics if each.name in names and each.kind == CAMERA_INFO), None)
    if info is None or not len(info.times_ns):
        return None
    named = f"{where}: {info.name}"
    try:
        message = decode(bag, info, 0)
    except BadConfig as error:
        raise BadConfig(f"{named}: {error}") from error
    return camera_of(message, named, rectified=bool(parts) and parts[-1].startswith("image_rect"))


def camera_of(message: Any, where: str, rectified: bool) -> Intrinsics | None:
    """Return the camera in a CameraInfo of ROS 1 or 2, None for one that is not calibrated.

    rectified: its images are, so their camera is that of the projection matrix. where: name in messages. Raises
    BadConfig as `camera_beside`.
    """
    region = message.roi
    if max(message.binning_x, message.binning_y) > 1 or region.x_offset or region.y_offset:
        raise BadConfig(f"{where}: images must be neither binned nor cut: give --focal or --rig")
    # ROS 1 has capitals.
    matrix, projection, given = (_numbers(message, name) for name in "kpd")
    if rectified and projection[0] > 0:
        fx, fy, cx, cy = projection[0], projection[5], projection[2], projection[6]
        given = []
    else:
        fx, fy, cx, cy = matrix[0], matrix[4], matrix[2], matrix[5]
    if fx == 0:  # not calibrated
        return None
    if not (fx > 0 and fy > 0):
        raise BadConfig(f"{where}: focal lengths must be above 0, found {fx:g} and {fy:g}")
    distortion = None
    if any(given):
        if message.distortion_model != _MODEL or len(given) not in (4, 5):
            raise BadConfig(
                f"{where}: distortion must be {_MODEL}, of 4 or 5 coefficients, found {message.distortion_model!r} of "
                f"{len(given)}: undistort the recording, or give --focal or --rig"
            )
        distortion = Distortion(*given)
    size = (int(message.height), int(message.width)) if message.height and message.width else None
    return Intrinsics(fx, fy, cx, cy, distortion, size, where)


def _numbers(message: Any, name: str) -> Sequence[float]:
    values = getattr(message, name) if hasattr(message, name) else getattr(message, name.upper())
    return [float(value) for value in values]
