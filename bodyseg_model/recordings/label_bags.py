"""Labels and points of frames as messages of ROS 2: in an MCAP file, with the times of their frames."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig, reported
from bodyseg_data.files import held_part
from bodyseg_data.labels import BACKGROUND, LabelMap
from bodyseg_model.recordings.bag_files import McapBag
from bodyseg_model.recordings.bag_messages import IMAGE, bag_library, typestore
from bodyseg_model.recordings.recording import Frame, Stamp

TOPIC: Final = "/bodyseg/labels"
"""Topic of the labels."""

POINTS_TOPIC: Final = "/bodyseg/points"
"""Topic of the points."""

CLOUD: Final = "sensor_msgs/msg/PointCloud2"

LEGEND: Final = "bodyseg.labels"
"""Name of the metadata that say which number is which part."""

# Of sensor_msgs/msg/PointField.
_DATATYPES: Final = {"u1": 2, "u2": 4, "f4": 7}


@contextlib.contextmanager
def labels_out(path: Path, label_map: LabelMap, frames_per_second: float) -> Iterator[LabelsOut]:
    """Open the file of a recording's labels: it appears when the block ends, and not at all if it fails.

    path: an .mcap file, which may be there if it holds labels. frames_per_second: of frames without times.
    Raises BadConfig for another path or one that cannot be written, MissingLibrary.
    """
    if path.suffix.lower() != ".mcap" or path.is_dir():
        raise BadConfig(f"labels are written into an .mcap file, found {path}")
    if path.exists() and not {each.name for each in McapBag(path).topics} <= {TOPIC, POINTS_TOPIC}:  # of `*.mcap`
        raise BadConfig(f"labels replace an earlier file of labels alone, found {path}")
    with reported(f"cannot write {path}", BadConfig, OSError), held_part(path, Path.touch) as part:
        with part.open("wb") as file:
            writer = bag_library("mcap.writer").Writer(file)
            writer.start("ros2")
            yield LabelsOut(writer, frames_per_second)
            writer.add_metadata(LEGEND, legend(label_map))
            writer.finish()
        part.replace(path)


def legend(label_map: LabelMap) -> dict[str, str]:
    """Return the name of every number in label images, and that of the map of labels."""
    names = {str(number): name for number, name in enumerate(label_map.names)}
    return {"map": label_map.name, **names, str(BACKGROUND): "no label"}


def cloud_fields(points: NDArray[np.void]) -> dict[str, Any]:
    """The fields of a sensor_msgs/msg/PointCloud2 but its header, one point a record of one-number columns, [N].

    "fields" are those of sensor_msgs/msg/PointField; "data" is uint8 [N x point_step].
    """
    return {
        "height": 1,
        "width": len(points),
        "fields": [
            {"name": name, "offset": offset, "datatype": _DATATYPES[kind.str[1:]], "count": 1}
            for name, (kind, offset, *_) in (points.dtype.fields or {}).items()
        ],
        "is_bigendian": sys.byteorder == "big",
        "point_step": points.itemsize,
        "row_step": points.nbytes,
        "data": np.frombuffer(points.tobytes(), np.uint8),
        "is_dense": True,
    }


class LabelsOut:
    """Writer of label images, one a frame: sensor_msgs/msg/Image of encoding mono8 on `TOPIC`; of points, where they
    are given: `CLOUD` on `POINTS_TOPIC`. writer: the package mcap's, of an open file.
    """

    def __init__(self, writer: Any, frames_per_second: float) -> None:
        self._writer, self._rate, self._count = writer, frames_per_second, 0
        self._types, self._channels = typestore("cdr").types, dict[str, int]()

    def add(
        self, frame: Frame, labels: NDArray[np.uint8], of_message: Stamp | None, points: NDArray[np.void] | None = None
    ) -> None:
        """Write the labels of a frame, uint8 [H, W], with time and coordinate frame of its message, `frame.stamp()`.

        points: of people (`Segmentation.points`), to be written, too; their coordinate frame is the same. A frame that
        is no message has its time alone; one without a time is `frames_per_second` from the one before.
        """
        time_ns = round(1e9 * (self._count / self._rate if frame.time_s is None else frame.time_s))
        stamp = of_message or Stamp(time_ns, "")
        seconds, rest = divmod(stamp.time_ns, 10**9)
        self._count += 1
        kinds = self._types
        time = kinds["builtin_interfaces/msg/Time"](sec=seconds, nanosec=rest)
        header = kinds["std_msgs/msg/Header"](stamp=time, frame_id=stamp.frame_id)
        image = kinds[IMAGE](
            header=header,
            height=labels.shape[0],
            width=labels.shape[1],
            encoding="mono8",
            is_bigendian=0,
            step=labels.shape[1],
            data=labels.ravel(),
        )
        messages = [(TOPIC, IMAGE, image)]
        if points is not None:
            cloud = cloud_fields(points)
            cloud["fields"] = [kinds["sensor_msgs/msg/PointField"](**each) for each in cloud["fields"]]
            messages.append((POINTS_TOPIC, CLOUD, kinds[CLOUD](header=header, **cloud)))
        for topic, kind, message in messages:
            if topic not in self._channels:
                text, _ = typestore("cdr").generate_msgdef(kind, ros_version=2)
                schema = self._writer.register_schema(kind, "ros2msg", text.encode())
                self._channels[topic] = self._writer.register_channel(topic, "cdr", schema)
            data, at = bytes(typestore("cdr").serialize_cdr(message, kind)), max(time_ns, 0)
            self._writer.add_message(self._channels[topic], at, data, at)
