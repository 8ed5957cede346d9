"""Depth tracks of Matroska files (.mkv), as Azure Kinect's recorder writes them.

The form: https://microsoft.github.io/Azure-Kinect-Sensor-SDK/master/record_format.html. The track DEPTH is 16-bit grey,
raw, big-endian, in millimetres; the calibration is an attachment in JSON. Its values are of the whole sensor, as shares
of 1024 pixels; a mode shows a part of the sensor, or pairs of its pixels
(https://github.com/microsoft/Azure-Kinect-Sensor-SDK). Its lens has OpenCV's rational model: the radial factor is
(1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6), to which `driver_camera` fits five coefficients.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig, reported
from bodyseg_data.machine import required
from bodyseg_model.recordings.cameras import Intrinsics, driver_camera
from bodyseg_model.recordings.recording import LARGEST_SIDE, Frame, FrameSource, stored_recording

if TYPE_CHECKING:
    from av.container import InputContainer
    from av.video.stream import VideoStream

_DEPTH: Final = "DEPTH"
_GREY: Final = ("gray16le", "gray16be")


def open_mkv(path: Path, topic: str | None, step_m: float | None) -> tuple[Frame, ...]:
    """Open the 16-bit grey track of a Matroska file that is called `topic`, or DEPTH, or is the only one.

    The camera is that of an Azure Kinect's calibration, where the file holds one (`depth_camera`). Raises BadConfig,
    MissingLibrary.
    """
    with _opened(path) as container:
        track = _track(container, topic, path)
        frames = _Frames(path, track.index, _times(container, track))
        shape = track.codec_context.height, track.codec_context.width
        calibration = next((each.data for each in container.streams.attachments if each.name == CALIBRATION), None)
    camera = None if calibration is None else depth_camera(calibration, shape, f"{path}: {CALIBRATION}")
    return stored_recording(path, frames, frames.times_s, False, step_m, camera=camera, part=topic or "")


class _Frames(FrameSource):
    """Frames of one track, by their times. The file is open between neighbours, so that they are read in one pass."""

    def __init__(self, path: Path, track: int, marks: list[tuple[int, float]]) -> None:
        self._path, self._track, self._marks = path, track, sorted(marks)
        self._next: tuple[int, int, Iterator[NDArray[np.uint16]]] | None = None
        self.times_s = [time for _, time in self._marks]

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_next": None}  # another process opens it itself

    def read(self, index: int) -> NDArray[Any]:
        process = os.getpid()  # a fork's file would move on with its parent's
        with self.one_at_a_time:
            if self._next is None or self._next[:2] != (process, index):
                self._next = process, index, self._from(index)
            stream, self._next = self._next[2], None
            with reported("the frame cannot be decoded", BadConfig, Exception):  # whatever the decoder raises
                pixels = next(stream)
            self._next = process, index + 1, stream
        return pixels

    def _from(self, index: int) -> Iterator[NDArray[np.uint16]]:
        """Decode frames from `index` on, beginning at the last one before it that needs no other."""
        wanted = self._marks[index][0]
        with _opened(self._path) as container:
            track = next(each for each in container.streams.video if each.index == self._track)
            track.codec_context.thread_count = 1  # a fork, which has no others, would wait for them for ever
            track.codec_context.options = {"max_pixels": str(LARGEST_SIDE**2)}  # of frames larger than their header
            container.seek(wanted, stream=track, backward=True)
            for frame in container.decode(track):
                if frame.pts is not None and frame.pts < wanted:
                    continue
                if frame.pts != wanted:
                    raise ValueError("it is missing")
                yield frame.to_ndarray().astype(np.uint16)
                index += 1
                if index == len(self._marks):
                    return
                wanted = self._marks[index][0]


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[InputContainer]:
    av, errors = (required(module, "reading .mkv files", "recordings") for module in ("av", "av.error"))
    with reported(f"{path} must be a Matroska file", BadConfig, errors.FFmpegError, OSError, ValueError):
        container = av.open(str(path), format="matroska")
    with container:
        yield container


def _track(container: InputContainer, topic: str | None, path: Path) -> VideoStream:
    tracks = {
        (track.metadata.get("title") or f"track {number}"): track
        for number, track in enumerate(container.streams.video)
    }
    grey = {name: track for name, track in tracks.items() if getattr(track.codec_context, "pix_fmt", None) in _GREY}
    if topic is not None:
        chosen = [track for name, track in grey.items() if name == topic]
    else:
        chosen = [track for name, track in grey.items() if name == _DEPTH] or list(grey.values())
    if len(chosen) != 1:
        rule = "--topic must be a track of 16-bit grey" if topic else "one track must be 16-bit grey, or --topic one of"
        raise BadConfig(f"{rule}, found {', '.join(grey or tracks) or 'no track'}: {path}")
    size = chosen[0].codec_context.height, chosen[0].codec_context.width
    if not all(1 <= side <= LARGEST_SIDE for side in size):
        raise BadConfig(f"a frame's side must be 1 to {LARGEST_SIDE} pixels, found {size[0]} x {size[1]}: {path}")
    return chosen[0]


def _times(container: InputContainer, track: VideoStream) -> list[tuple[int, float]]:
    """Time of every frame of a track, in its unit and in seconds, from packets alone: nothing is decoded."""
    with reported(f"{container.name} must be a whole Matroska file", BadConfig, OSError, ValueError):
        return [
            (packet.pts, float(packet.pts * (track.time_base or 0)))
            for packet in container.demux(track)
            if packet.pts is not None and packet.size
        ]


CALIBRATION: Final = "calibration.json"
"""Name of the attachment."""

_LOCATION: Final = "CALIBRATION_CameraLocationD0"
_MODES: Final = {  # (rows, columns) of images: pixels across the whole sensor, first column, first row
    (288, 320): (512, 96, 90),
    (576, 640): (1024, 192, 180),
    (512, 512): (512, 0, 0),
    (1024, 1024): (1024, 0, 0),
}


def depth_camera(data: bytes, shape: tuple[int, int], where: str) -> Intrinsics | None:
    """Read the camera of depth images of `shape` (rows, columns) from a calibration's bytes.

    None for another calibration or size, and where the five coefficients are off by more than a pixel anywhere, as they
    are for the widest modes: the camera must then be given. where: name in messages.
    """
    if shape not in _MODES:
        return None
    across, column, row = _MODES[shape]
    try:
        cameras = json.loads(data.rstrip(b"\0"))["CalibrationInformation"]["Cameras"]
        found = next(camera["Intrinsics"]["ModelParameters"] for camera in cameras if camera["Location"] == _LOCATION)
        cx, cy, fx, fy, *radial, _, _, p2, p1 = (float(value) for value in found[:14])
        if len(radial) != 6 or not np.isfinite(found[:14]).all() or not min(fx, fy) > 0:
            return None
        cx, cy, fx, fy = cx * across - column - 0.5, cy * across - row - 0.5, fx * across, fy * across
        k1, k2, k3, *lower = radial
        return driver_camera("rational_polynomial", (k1, k2, p1, p2, k3, *lower), (fx, fy, cx, cy), shape, where)
    except (ValueError, KeyError, TypeError, StopIteration, RecursionError, AttributeError, BadConfig):
        return None
