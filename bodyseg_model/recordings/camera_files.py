"""Cameras of single frames, from JSON files beside them, in OpenCV's terms.

`NAME.json` beside `NAME.png` is that frame's camera; `cameras.json` in a folder holds those of all frames there:

    {"fx": 525.2, "fy": 525.0, "cx": 319.5, "cy": 239.5, "distortion": [0.1, -0.2, 0, 0, 0]}
    {"default": {"fx": ...}, "frames": {"NAME": {"fx": ...}}}
"""

import os
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, Final

from bodyseg_data.core import BadConfig
from bodyseg_data.files import Table, parse_json, read_bytes
from bodyseg_data.rigs import Rig
from bodyseg_model.recordings.cameras import FrameCamera, Intrinsics, driver_camera, frame_camera
from bodyseg_model.recordings.frames import Skipping, first_readable
from bodyseg_model.recordings.recording import Frame

CAMERAS: Final = "cameras.json"

_LARGEST_FILE: Final = 1 << 24
_NEEDED: Final = ("fx", "fy", "cx", "cy")


def cameras_beside(frames: Sequence[Frame]) -> list[Intrinsics | None]:
    """The cameras that recordings hold or that are in files beside frames, None for a frame without one.

    A frame's own file comes before `CAMERAS`, and there an entry of its name before "default". A JSON file of a frame's
    name without any of fx, fy, cx and cy is not taken for a camera. Raises BadConfig, naming the file, for one that is
    damaged, incomplete or out of range, and for one of a recording that cannot be used.
    """
    if why := next((frame.no_camera for frame in frames if frame.no_camera), ""):
        raise BadConfig(why)
    shared = cache(_shared)  # files are read once

    @cache
    def camera_of(path: Path) -> Intrinsics | None:
        own_file = path.with_suffix(".json")
        own = _tree(own_file)
        if own is not None and any(name in own for name in _NEEDED):
            return _intrinsics(own, str(own_file))
        default, named = shared(path.with_name(CAMERAS))
        return named.get(path.name, named.get(path.stem, default))

    return [frame.camera or camera_of(frame.path) for frame in frames]


class FrameCameras:
    """The camera of every frame: the one that is given, or those beside frames and one for all others.

    rig, focal_px, centre_px, trained: as of `frame_camera`, for the camera of all frames: one of the first three is
    given, or none. common: the camera of those without their own, by the size of the first of them. first: camera of
    the first frame. bent: True if any camera has lens distortion. Raises BadConfig as `frame_camera` and
    `cameras_beside`, where no frame can be read, and for a first one that does not fit its own camera.
    """

    def __init__(
        self,
        frames: Sequence[Frame],
        rig: str | None,
        focal_px: float | None,
        centre_px: tuple[float, ...],
        trained: Rig,
        skipping: Skipping,
    ) -> None:
        given = rig is not None or focal_px is not None or len(centre_px) > 0
        beside: list[Intrinsics | None] = [None] * len(frames) if given else cameras_beside(frames)
        self._own = {frame: own for frame, own in zip(frames, beside, strict=True) if own is not None}
        others = [frame for frame in frames if frame not in self._own]
        first, other = first_readable(frames, skipping), first_readable(others, skipping)
        if first is None:
            raise BadConfig(f"at least one frame must be readable, found none: {skipping.skipped[-1]['error']}")
        self.common = None
        if other is not None:
            self.common = frame_camera(other.read().shape, other.where, rig, focal_px, centre_px, trained)
        self.first = self.of(first, first.read().shape)
        common = None if self.common is None else self.common.camera.distortion
        self.bent = any(lens is not None for lens in (common, *(own.lens for own in self._own.values())))

    def of(self, frame: Frame, shape: tuple[int, int]) -> FrameCamera:
        """`common`, or the own camera of a frame of (rows, columns). Raises BadConfig as `Intrinsics.frame_camera`."""
        if self.common is None or frame in self._own:
            return self._own[frame].frame_camera(shape)
        return self.common

    def to_json(self) -> dict[str, Any]:
        """The camera of all frames or of those without their own, and how many have their own, as plain JSON."""
        camera = self.first if len({replace(own, where="") for own in self._own.values()}) == 1 else None
        common = {"origin": "each frame's own"} if (shared := self.common or camera) is None else shared.to_json()
        return {**common, **({"frames_with_their_own": len(self._own)} if self._own else {})}


def _shared(where: Path) -> tuple[Intrinsics | None, dict[str, Intrinsics]]:
    """The default camera of a file `CAMERAS`, if it is there, and those of frames by name with or without suffix."""
    tree = _tree(where)
    if tree is None:
        return None, {}
    unknown = sorted(tree.keys() - {"default", "frames"})
    frames = tree.get("frames", {})
    if unknown or not isinstance(frames, dict) or not tree:
        raise BadConfig(
            f"{where} must hold 'frames', cameras by the frames' names, and 'default', or one of them: with a "
            "focal length (--focal) or a rig it is not read"
        )
    default = _intrinsics(tree["default"], f"{where}, default") if "default" in tree else None
    return default, {name: _intrinsics(camera, f"{where}, {name}") for name, camera in frames.items()}


def _tree(path: Path) -> dict[str, Any] | None:
    """The object in a JSON file; None if there is no such file. Raises BadConfig."""
    return parse_json(read_bytes(path, _LARGEST_FILE), str(path)) if os.path.lexists(path) else None


def _intrinsics(tree: Any, where: str) -> Intrinsics:
    if not isinstance(tree, dict):
        raise BadConfig(f"{where} must be a camera with fx, fy, cx and cy, found {type(tree).__name__}")
    table = Table(tree, where)
    fx, fy = table.positive("fx"), table.positive("fy")
    cx, cy = table.number("cx"), table.number("cy")
    size = None
    if "width" in table or "height" in table:
        columns, rows = table.whole("width"), table.whole("height")
        size = rows, columns
    coefficients: Sequence[float] = ()
    if "distortion" in table:
        given = tree["distortion"]
        coefficients = table.numbers("distortion", 4 if isinstance(given, list) and len(given) == 4 else 5)
    table.finish()
    return driver_camera("plumb_bob", coefficients, (fx, fy, cx, cy), size, where)
