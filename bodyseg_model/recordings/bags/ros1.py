"""ROS 1 bags, and those of RealSense's SDK, which are such."""

from __future__ import annotations

import contextlib
from bisect import bisect_left
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bodyseg_data.core.errors import BadConfig
from bodyseg_model.recordings.bags.compression import decompressed
from bodyseg_model.recordings.bags.depth_topics import bag_recording
from bodyseg_model.recordings.bags.messages import LARGEST_MESSAGE, Topic, as_times, missing
from bodyseg_model.recordings.recording import StoredRecording

if TYPE_CHECKING:
    from rosbags.interfaces import Connection


def open_ros1(path: Path, topic: str | None, step_m: float | None) -> StoredRecording:
    """Open a ROS 1 bag of format 2.0. Raises BadConfig, MissingLibrary."""
    return bag_recording(path, _Ros1Bag(path), topic, step_m)


class _Ros1Bag:
    """Messages of a ROS 1 bag by its index; one chunk of it at a time is in memory."""

    def __init__(self, path: Path) -> None:
        try:
            from rosbags.rosbag1 import Reader
        except ImportError as error:
            raise missing(error) from error
        self._stream: tuple[Topic, int, Iterator[Any]] | None = None
        self._connections: dict[str, list[Connection]] = {}
        self._reader = Reader(path)
        try:
            self._reader.open()
            for position, chunk in self._reader.chunks.items():
                if chunk.datasize > LARGEST_MESSAGE:
                    raise ValueError(f"a chunk must have at most {LARGEST_MESSAGE} bytes, found {chunk.datasize}")
                self._reader.chunks[position] = chunk._replace(decompressor=decompressed)
            for connection in self._reader.connections:
                self._connections.setdefault(connection.topic, []).append(connection)
            self.topics = [self._topic(name) for name in sorted(self._connections)]
        except Exception as error:  # a damaged bag raises what the reader likes
            raise BadConfig(
                f"{path} must be a whole ROS 1 bag with an index: {error or type(error).__name__} (`rosbag reindex` "
                "mends a recording that was cut off)"
            ) from error

    def __del__(self) -> None:
        with contextlib.suppress(Exception):  # it may never have been opened
            self._reader.close()

    def read(self, topic: Topic, index: int) -> bytes:
        """Read message `index` of a topic: the next one of the stream that is open, or else by its time."""
        try:
            if self._stream is None or self._stream[:2] != (topic, index):
                time = int(topic.times_ns[index])
                messages = self._reader.messages(self._connections[topic.name], start=time)
                same = bisect_left(topic.times_ns, time)
                self._stream = topic, index, islice(messages, index - same, None)
            stream, self._stream = self._stream[2], None
            _, _, data = next(stream)
            self._stream = topic, index + 1, stream
        except Exception as error:  # as above
            raise BadConfig(f"the message cannot be read: {str(error) or type(error).__name__}") from error
        return bytes(data)

    def _topic(self, name: str) -> Topic:
        connections = self._connections[name]
        times = sorted(entry.time for each in connections for entry in self._reader.indexes[each.id])
        return Topic(name, connections[0].msgtype, "ros1", as_times(times))
