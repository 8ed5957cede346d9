"""The recording in a bag: its topic of range images, their times, camera and unit, decoded from its messages.

Range images are 16UC1, mono16, 32FC1, PNG, or of the transport compressedDepth
(https://github.com/ros-perception/image_transport_plugins): 12 bytes, an int32 and the float32 A and B, then a 16-bit
PNG or RVL. Of 16UC1 it holds the steps; of 32FC1 it holds v = A / range + B, rounded, range in metres, 0 where nothing
was measured. A compressed image may leave its encoding out ("png", as cv_bridge in Python writes): bytes then tell it.
Pieces of bags are decompressed up to a limit of bytes, whatever they claim.
"""

from __future__ import annotations

import bz2
import io
import math
import struct
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Final, Literal, Protocol

import numpy as np
import zstandard
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig, check_choice, reported
from bodyseg_data.machine import required
from bodyseg_model.recordings.cameras import Intrinsics, driver_camera
from bodyseg_model.recordings.frames import parse_frame
from bodyseg_model.recordings.recording import Frame, FrameSource, Stamp, check_pixels, stored_recording
from bodyseg_model.recordings.rvl import decode_rvl

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

Encoding = Literal["ros1", "cdr"]

IMAGE: Final = "sensor_msgs/msg/Image"
COMPRESSED: Final = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO: Final = "sensor_msgs/msg/CameraInfo"
FLOAT32: Final = "std_msgs/msg/Float32"

LARGEST_MESSAGE: Final = 1 << 28
"""The most bytes of a message, or of a compressed piece of a bag that holds messages."""

MOST_MESSAGES: Final = 1 << 24
"""The most messages that a bag may list."""

_BZ2: Final = b"BZh"
_LZ4: Final = b"\x04\x22\x4d\x18"
_PIECE: Final = 1 << 16
_ZSTD: Final = b"\x28\xb5\x2f\xfd"

_STEPS: Final = ("16UC1", "mono16")
_METRES: Final = "32FC1"
_HEADER: Final = struct.Struct("<iff")

ENCODINGS: Final = (*_STEPS, _METRES)
"""Encodings of pixels that range images have."""

_TRANSPORTS: Final = ("compressedDepth", "compressed")
_UNNAMED: Final = {"png", "compressed", "compresseddepth", "rvl"}  # words in a format's text that name no encoding
_GREY_PNG: Final = (b"\x89PNG\r\n\x1a\n", b"\x10\0")  # its first bytes; bits and colour, from byte 24
_LARGEST_A: Final = 1e7
_MOST_INFOS: Final = 1000

_KINDS: Final = (IMAGE, COMPRESSED)
_UNITS_TOPIC: Final = "option/Depth_Units/value"
_LONGEST_LIST: Final = 12


@dataclass(frozen=True, eq=False)
class Topic:
    """Messages of one topic. kind: their ROS 2 type. times_ns: int64 [N], when each was recorded, ascending."""

    name: str
    kind: str
    encoding: Encoding
    times_ns: NDArray[np.int64]


class Bag(Protocol):
    """A file or folder of messages, which are read by topic and number."""

    @property
    def topics(self) -> Sequence[Topic]:
        """All topics, in alphabetical order."""

    def read(self, topic: Topic, index: int) -> bytes:
        """Read message `index` of a topic. One that is damaged raises what the reader's library likes."""


def bag_recording(
    opener: Callable[[Path], Bag], path: Path, topic: str | None, step_m: float | None
) -> tuple[Frame, ...]:
    """Open a bag and return its range images as a recording: those of `topic`, or of the only topic that has any.

    Raises BadConfig, listing the topics, for another topic, none, or several, and as `opener`, as does MissingLibrary.
    """
    bag = opener(path)
    images = [each for each in bag.topics if each.kind in _KINDS and len(each.times_ns)]
    if topic is not None:
        chosen = [each for each in images if each.name == topic or each.name == f"/{topic}"]
        if not chosen:
            raise BadConfig(f"--topic must be a topic of images, one of {_listed(images)}, found {topic!r}: {path}")
    else:
        firsts = [(each, _first_message(bag, each)) for each in images]
        chosen = [each for each, first in firsts if first is not None and encoding(first, each.kind) in ENCODINGS]
        if not chosen:
            raise BadConfig(f"a recording must have a topic of range images, found {_listed(images)}: {path}")
        if len(chosen) > 1:
            raise BadConfig(f"several topics have range images, choose one by --topic: {_listed(chosen)} ({path})")
    (found,) = chosen[:1]
    first = _first_message(bag, found)
    floating = first is not None and encoding(first, found.kind) == _METRES
    try:
        camera, no_camera = camera_beside(bag, found, str(path)), ""
    except BadConfig as error:
        camera, no_camera = None, str(error)
    return stored_recording(
        path,
        _Images(opener, path, bag, found, floating),
        [time / 1e9 for time in found.times_ns],
        floating,
        step_m,
        _stored_step(bag, found),
        camera,
        found.name,
        no_camera,
    )


class _Images(FrameSource):
    """Images of one topic. The last message stays decoded, since its header is often read after its pixels."""

    def __init__(self, opener: Callable[[Path], Bag], path: Path, bag: Bag, topic: Topic, floating: bool) -> None:
        self._bag, self._topic, self._floating = bag, topic, floating
        self._place = opener, path, topic.name, topic.kind
        self._last: tuple[int, Any] | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        return _opened_again, (*self._place, self._floating)  # another process opens the file itself

    def read(self, index: int) -> NDArray[Any]:
        image = (_compressed_image if self._topic.kind == COMPRESSED else _plain_image)(self._message(index))
        if (image.dtype.kind == "f") != self._floating:
            raise BadConfig(f"all images of a topic must be of the first one's encoding, found {image.dtype}")
        return image

    def stamp(self, index: int) -> Stamp:
        header = self._message(index).header
        return Stamp(int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec), str(header.frame_id))

    def _message(self, index: int) -> Any:
        with self.one_at_a_time:
            if self._last is None or self._last[0] != index:
                self._last = None  # not two messages at once
                self._last = index, decode(self._bag, self._topic, index)
            return self._last[1]


def _opened_again(opener: Callable[[Path], Bag], path: Path, name: str, kind: str, floating: bool) -> _Images:
    bag = opener(path)
    (topic,) = (each for each in bag.topics if (each.name, each.kind) == (name, kind))
    return _Images(opener, path, bag, topic, floating)


def _first_message(bag: Bag, topic: Topic) -> Any:
    """The first of the first ten messages that can be read, or None."""
    for index in range(min(10, len(topic.times_ns))):
        try:
            return decode(bag, topic, index)
        except BadConfig:
            continue
    return None


def _stored_step(bag: Bag, topic: Topic) -> float | None:
    """Metres a step, from the topic beside the sensor's in RealSense's recordings; None in others."""
    sensor = topic.name.split("/")[:3]
    name = "/".join([*sensor, _UNITS_TOPIC])
    units = next((each for each in bag.topics if each.name == name and each.kind == FLOAT32), None)
    value = _first_message(bag, units) if units is not None else None
    return float(value.data) if value is not None and 1e-6 <= value.data <= 0.1 else None


def _listed(topics: list[Topic]) -> str:
    names = [topic.name for topic in topics]
    more = f" and {len(names) - _LONGEST_LIST} more" if len(names) > _LONGEST_LIST else ""
    return (", ".join(names[:_LONGEST_LIST]) or "none") + more


bag_library = partial(required, feature="reading and writing bags", extra="recordings")
"""Imports a module that bags need. Raises MissingLibrary."""


def as_times(times_ns: Sequence[int] | NDArray[np.int64]) -> NDArray[np.int64]:
    """Return times in nanoseconds as an array, int64 [N]. Raises ValueError or OverflowError for others."""
    if len(times_ns) > MOST_MESSAGES:
        raise ValueError(f"a topic must have at most {MOST_MESSAGES} messages, found {len(times_ns)}")
    return np.array(times_ns, np.int64).reshape(-1)


@cache
def typestore(encoding: Encoding) -> Typestore:
    """Return the message types of ROS 1 Noetic or ROS 2 Humble. Raises MissingLibrary."""
    types = bag_library("rosbags.typesys")
    store: Typestore = types.get_typestore(types.Stores.ROS1_NOETIC if encoding == "ros1" else types.Stores.ROS2_HUMBLE)
    return store


def decode(bag: Bag, topic: Topic, index: int) -> Any:
    """Read and decode message `index` of a topic. Raises BadConfig."""
    with reported("the message cannot be read", BadConfig, Exception):  # damaged pages and compressed data
        data = bag.read(topic, index)
    store = typestore(topic.encoding)
    with reported(f"the message is no {topic.kind}", BadConfig, Exception):  # whatever the decoder raises
        if topic.encoding == "ros1":
            return store.deserialize_ros1(data, topic.kind)
        return store.deserialize_cdr(data, topic.kind)


def decompressed(data: bytes, most: int = sys.maxsize) -> bytes:
    """Decompress bzip2, LZ4 frames or zstd, told by their first bytes; others are returned as they are.

    Records of a plain chunk cannot begin so: they would be larger than any chunk. Raises ValueError for more than
    `most` or `LARGEST_MESSAGE` bytes, MissingLibrary, and what the libraries raise for damaged data.
    """
    if data.startswith(_BZ2):
        stream: IO[bytes] = bz2.BZ2File(io.BytesIO(data))
    elif data.startswith(_LZ4):
        stream = bag_library("lz4.frame").LZ4FrameFile(io.BytesIO(data))
    elif data.startswith(_ZSTD):
        stream = zstandard.ZstdDecompressor().stream_reader(data)
    else:
        return bytes(data)
    most = min(most, LARGEST_MESSAGE)
    with stream:  # read in pieces, because libraries allocate all that they may return
        pieces, size = list[bytes](), 0
        while piece := stream.read(_PIECE):
            pieces.append(piece)
            size += len(piece)
            if size > most:
                raise ValueError(f"a piece must have at most {most} bytes")
    return b"".join(pieces)


def encoding(message: Any, kind: str) -> str:
    """Return the encoding of an image message's pixels, such as "16UC1" or "rgb8"."""
    if kind == IMAGE:
        return str(message.encoding)
    found = str(message.format).partition(";")[0].strip()
    if not set(found.lower().split()) <= _UNNAMED:
        return found
    start = bytes(message.data[:26])
    if "compresseddepth" in str(message.format).lower() and len(start) >= _HEADER.size:
        _, a, b = _HEADER.unpack_from(start)
        return _METRES if 1 <= a <= _LARGEST_A and abs(b) <= _LARGEST_A else _STEPS[0]
    return _STEPS[0] if (start[:8], start[24:]) == _GREY_PNG else found


def _plain_image(message: Any) -> NDArray[Any]:
    check_choice("the encoding of an image", message.encoding, ENCODINGS)
    kind = np.dtype(np.float32 if message.encoding == _METRES else np.uint16)
    kind = kind.newbyteorder(">" if message.is_bigendian else "<")
    rows, columns, step = int(message.height), int(message.width), int(message.step)
    check_pixels((rows, columns), kind)
    data = np.asarray(message.data, np.uint8)
    if step < columns * kind.itemsize or len(data) != rows * step:
        raise BadConfig(
            f"an image of {rows} x {columns} {message.encoding} in rows of {step} bytes cannot have {len(data)} bytes"
        )
    row = data.reshape(rows, step)[:, : columns * kind.itemsize]
    return np.ascontiguousarray(row).view(kind).astype(kind.newbyteorder("="))


def _compressed_image(message: Any) -> NDArray[Any]:
    data, text = bytes(message.data), str(message.format)
    if (found := encoding(message, COMPRESSED)) not in ENCODINGS:
        raise BadConfig(f"the encoding of an image must be one of {', '.join(ENCODINGS)}, found {text!r}")
    if "compresseddepth" not in text.lower():
        if found == _METRES or not ("png" in text.lower() or data.startswith(_GREY_PNG[0])):
            raise BadConfig(f"a compressed image must be a 16-bit PNG or compressedDepth, found {text!r}")
        return parse_frame(data)
    if len(data) < _HEADER.size:
        raise BadConfig(f"compressedDepth must begin with {_HEADER.size} bytes of header, found {len(data)} in all")
    _, a, b = _HEADER.unpack_from(data)
    stored = (decode_rvl if "rvl" in text.lower() else parse_frame)(data[_HEADER.size :])
    if found != _METRES:
        return stored
    if not (math.isfinite(a) and math.isfinite(b) and a > 0):
        raise BadConfig(f"compressedDepth of 32FC1 must have finite A above 0 and B, found {a:g} and {b:g}")
    with np.errstate(divide="ignore", invalid="ignore"):
        metres = np.float32(a) / (stored.astype(np.float32) - np.float32(b))
    metres[stored == 0] = 0
    return metres


def camera_beside(bag: Bag, topic: Topic, where: str) -> Intrinsics | None:
    """Read the camera of a topic of images from the first calibrated CameraInfo beside it; None if there is none.

    That is `camera_info` in the topic's namespace, in `info/` as RealSense's recordings have it, or below the topic. Of
    a rectified image ("image_rect_raw", "image_depth_rect"), the camera is that of the projection matrix, without
    distortion. Raises BadConfig for distortion that is none of `driver_camera`, and for binned or cut images.
    """
    parts = [part for part in topic.name.split("/") if part]
    if parts and parts[-1] in _TRANSPORTS:
        del parts[-1]
    beside = (parts[:-1], [*parts[:-2], "info"], parts)
    names = {"/".join(["", *folder, "camera_info"]) for folder in beside}
    info = next((each for each in bag.topics if each.name in names and each.kind == CAMERA_INFO), None)
    if info is None or not len(info.times_ns):
        return None
    named = f"{where}: {info.name}"
    for index in range(min(len(info.times_ns), _MOST_INFOS)):
        with reported(named, BadConfig):
            message = decode(bag, info, index)
        camera = camera_of(message, named, rectified=bool(parts) and "rect" in parts[-1].split("_"))
        if camera is not None:
            return camera
    return None


def camera_of(message: Any, where: str, rectified: bool) -> Intrinsics | None:
    """Return the camera in a CameraInfo of ROS 1 or 2, None for one that is not calibrated.

    rectified: its images are, so it is that of the projection matrix. where: for messages. Raises as `camera_beside`.
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
    size = (int(message.height), int(message.width)) if message.height and message.width else None
    return driver_camera(str(message.distortion_model), given, (fx, fy, cx, cy), size, where)


def _numbers(message: Any, name: str) -> Sequence[float]:
    values = getattr(message, name) if hasattr(message, name) else getattr(message, name.upper())
    return [float(value) for value in values]
