"""Labels of frames as messages of ROS 2: in an MCAP file, or in a bag, with the times of their frames."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig
from bodyseg_data.files import part_beside
from bodyseg_data.labels import BACKGROUND, LabelMap
from bodyseg_model.recordings.bag_messages import IMAGE, missing, typestore
from bodyseg_model.recordings.recording import Frame, Stamp

TOPIC: Final = "/bodyseg/labels"
"""Topic of the labels."""

LEGEND: Final = "bodyseg.labels"
"""Name of the metadata that say which number is which part."""

_SUFFIX: Final = ".mcap"


@contextlib.contextmanager
def labels_out(path: Path, label_map: LabelMap, frames_per_second: float) -> Iterator[LabelsOut]:
    """Open the file or folder of a recording's labels: it appears when the block ends, and not at all if it fails.

    path: an .mcap file, or a folder that does not exist, for a ROS 2 bag. frames_per_second: of frames without times.
    Raises BadConfig for another path or one that cannot be written, MissingLibrary.
    """
    part = part_beside(path)
    try:
        out: _Out = _McapOut(path, part) if path.suffix.lower() == _SUFFIX else _BagOut(path, part)
        try:
            yield LabelsOut(out, label_map, frames_per_second)
            out.finish(legend(label_map))
        except BaseException:
            out.abandon()
            raise
    except OSError as error:
        raise BadConfig(f"cannot write {path}: {error.strerror or error}") from error


def legend(label_map: LabelMap) -> dict[str, str]:
    """Return the name of every number in label images, and that of the map of labels."""
    names = {str(number): name for number, name in enumerate(label_map.names)}
    return {"map": label_map.name, **names, str(BACKGROUND): "no label"}


class LabelsOut:
    """Writer of label images, one a frame: sensor_msgs/msg/Image of encoding mono8 on `TOPIC`."""

    def __init__(self, out: _Out, label_map: LabelMap, frames_per_second: float) -> None:
        self._out, self._rate, self._count = out, frames_per_second, 0
        self._types = typestore("cdr").types

    def add(self, frame: Frame, labels: NDArray[np.uint8], of_message: Stamp | None) -> None:
        """Write the labels of a frame, uint8 [H, W], with time and coordinate frame of its message, `frame.stamp()`.

        A frame that is no message has its time alone; one without a time is `frames_per_second` from the one before.
        """
        time_ns = round(1e9 * (self._count / self._rate if frame.time_s is None else frame.time_s))
        stamp = of_message or Stamp(time_ns, "")
        seconds, rest = divmod(stamp.time_ns, 10**9)
        self._count += 1
        kinds = self._types
        time = kinds["builtin_interfaces/msg/Time"](sec=seconds, nanosec=rest)
        message = kinds[IMAGE](
            header=kinds["std_msgs/msg/Header"](stamp=time, frame_id=stamp.frame_id),
            height=labels.shape[0],
            width=labels.shape[1],
            encoding="mono8",
            is_bigendian=0,
            step=labels.shape[1],
            data=labels.ravel(),
        )
        self._out.write(max(time_ns, 0), bytes(typestore("cdr").serialize_cdr(message, IMAGE)))


class _Out(Protocol):
    def write(self, time_ns: int, data: bytes) -> None: ...
    def finish(self, metadata: dict[str, str]) -> None: ...
    def abandon(self) -> None: ...


class _McapOut:
    """An MCAP file, written beside its place."""

    def __init__(self, path: Path, part: Path) -> None:
        try:
            from mcap.writer import Writer
        except ImportError as error:
            raise missing(error) from error
        text, _ = typestore("cdr").generate_msgdef(IMAGE, ros_version=2)
        self._path, self._part = path, part
        self._file: IO[bytes] = part.open("wb")
        self._writer: Any = Writer(self._file)
        self._writer.start("ros2")
        schema = self._writer.register_schema(IMAGE, "ros2msg", text.encode())
        self._channel = self._writer.register_channel(TOPIC, "cdr", schema)

    def write(self, time_ns: int, data: bytes) -> None:
        self._writer.add_message(self._channel, time_ns, data, time_ns)

    def finish(self, metadata: dict[str, str]) -> None:
        self._writer.add_metadata(LEGEND, metadata)
        self._writer.finish()
        self._file.close()
        self._part.replace(self._path)

    def abandon(self) -> None:
        self._file.close()
        self._part.unlink(missing_ok=True)


class _BagOut:
    """The folder of a ROS 2 bag, written beside its place."""

    def __init__(self, path: Path, part: Path) -> None:
        if path.suffix:
            raise BadConfig(f"labels are written into an .mcap file or the folder of a bag, found {path}")
        if path.exists():
            raise BadConfig(f"the folder of a bag must be a new one, found {path}")
        try:
            from rosbags.rosbag2 import StoragePlugin, Writer
        except ImportError as error:
            raise missing(error) from error
        shutil.rmtree(part, ignore_errors=True)
        self._path, self._part = path, part
        self._writer: Any = Writer(part / path.name, version=9, storage_plugin=StoragePlugin.MCAP)
        self._writer.open()
        self._connection = self._writer.add_connection(TOPIC, IMAGE, typestore=typestore("cdr"))

    def write(self, time_ns: int, data: bytes) -> None:
        self._writer.write(self._connection, time_ns, data)

    def finish(self, metadata: dict[str, str]) -> None:
        for key, value in metadata.items():
            self._writer.set_custom_data(f"{LEGEND}.{key}", value)
        self._writer.close()
        (self._part / self._path.name).replace(self._path)  # its files are named after the folder
        self._part.rmdir()

    def abandon(self) -> None:
        with contextlib.suppress(Exception):  # of a writer that is closed already
            self._writer.close()
        shutil.rmtree(self._part, ignore_errors=True)
