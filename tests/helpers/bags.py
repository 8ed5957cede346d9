"""Small bags for tests, written by the libraries that users' tools write them with."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, Writer
from pngs import png
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_typestore

ROS1, ROS2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_HUMBLE)

DEPTH, INFO = "/camera/depth/image_raw", "/camera/depth/camera_info"

Message = tuple[str, str, Any]
"""Topic, type and fields of a message; nested messages are tuples of type and fields."""


def header(time_s: float, frame_id: str = "optical") -> Any:
    seconds, rest = divmod(round(time_s * 1e9), 10**9)
    return "std_msgs/msg/Header", {
        "stamp": ("builtin_interfaces/msg/Time", {"sec": seconds, "nanosec": rest}),
        "frame_id": frame_id,
    }


def image(
    values: np.ndarray[Any, Any], encoding: str, time_s: float = 0.0, topic: str = DEPTH, **other: Any
) -> Message:
    fields = {
        "header": header(time_s),
        "height": values.shape[0],
        "width": values.shape[1],
        "encoding": encoding,
        "is_bigendian": 0,
        "step": values.strides[0],
        "data": np.frombuffer(values.tobytes(), np.uint8),
    }
    return topic, "sensor_msgs/msg/Image", {**fields, **other}


def compressed(data: bytes, text: str, time_s: float = 0.0, topic: str = f"{DEPTH}/compressedDepth") -> Message:
    fields = {"header": header(time_s), "format": text, "data": np.frombuffer(data, np.uint8)}
    return topic, "sensor_msgs/msg/CompressedImage", fields


def compressed_depth(stored: np.ndarray[Any, Any], a: float = 0.0, b: float = 0.0) -> bytes:
    return struct.pack("<iff", int(a > 0), a, b) + png(stored)


def camera_info(shape: tuple[int, ...], topic: str = INFO, model: str = "plumb_bob", **other: Any) -> Message:
    region = {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False}
    fields = {
        "header": header(0.0),
        "height": shape[0],
        "width": shape[1],
        "distortion_model": model,
        "d": np.zeros(5),
        "k": np.array([100.0, 0, 41.5, 0, 101.0, 29.5, 0, 0, 1]),
        "r": np.eye(3).ravel(),
        "p": np.array([90.0, 0, 40, 0, 0, 90.5, 30, 0, 0, 0, 1, 0]),
        "binning_x": 0,
        "binning_y": 0,
        "roi": ("sensor_msgs/msg/RegionOfInterest", {**region, **other.pop("roi", {})}),
    }
    return topic, "sensor_msgs/msg/CameraInfo", {**fields, **other}


def write_ros1(path: Path, messages: Sequence[Message], compression: Any = None, chunk_size: int = 1 << 20) -> Path:
    writer = Ros1Writer(path)
    writer.chunk_threshold = chunk_size
    if compression is not None:
        writer.set_compression(compression)
    with writer:
        connections: dict[str, Any] = {}
        for number, (topic, kind, fields) in enumerate(messages):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=ROS1)
            data = ROS1.serialize_ros1(built(ROS1, kind, fields, True), kind)
            writer.write(connections[topic], 10**9 + number * 10**8, data)
    return path


def write_ros2(path: Path, messages: Sequence[Message], storage: StoragePlugin = StoragePlugin.SQLITE3) -> Path:
    with Ros2Writer(path, version=9, storage_plugin=storage) as writer:
        connections: dict[str, Any] = {}
        for number, (topic, kind, fields) in enumerate(messages):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=ROS2)
            data = ROS2.serialize_cdr(built(ROS2, kind, fields), kind)
            writer.write(connections[topic], 10**9 + number * 10**8, data)
    return path


def write_mcap(path: Path, messages: Sequence[Message], ros1: bool = False, **options: Any) -> Path:
    with path.open("wb") as file:
        writer = Writer(file, **{"compression": CompressionType.ZSTD, "chunk_size": 20_000, **options})
        writer.start("ros1" if ros1 else "ros2")
        channels: dict[str, int] = {}
        store = ROS1 if ros1 else ROS2
        for number, (topic, kind, fields) in enumerate(messages):
            if topic not in channels:
                text, _ = store.generate_msgdef(kind, ros_version=1 if ros1 else 2)
                name = kind.replace("/msg/", "/") if ros1 else kind
                schema = writer.register_schema(name, "ros1msg" if ros1 else "ros2msg", text.encode())
                channels[topic] = writer.register_channel(topic, "ros1" if ros1 else "cdr", schema)
            message = built(store, kind, fields, ros1)
            data = bytes(ROS1.serialize_ros1(message, kind) if ros1 else ROS2.serialize_cdr(message, kind))
            time = 10**9 + number * 10**8
            writer.add_message(channels[topic], time, data, time, number)
        writer.finish()
    return path


def built(store: Any, kind: str, fields: dict[str, Any], ros1: bool = False) -> Any:
    """A message of a type store. ROS 1 has a sequence number in headers and capitals in CameraInfo."""
    values = {name: built(store, *value, ros1) if isinstance(value, tuple) else value for name, value in fields.items()}
    if ros1 and kind.endswith("/Header"):
        values["seq"] = 0
    if ros1 and kind.endswith("/CameraInfo"):
        values = {name.upper() if len(name) == 1 else name: value for name, value in values.items()}
    return store.types[kind](**values)
