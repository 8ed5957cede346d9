"""Messages of a bag: its topics, where each message lies, and the decoding of those of images and cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, Final, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadConfig, MissingLibrary
from bodyseg_data.core.system.libraries import missing_library

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


@dataclass(frozen=True, eq=False)
class Topic:
    """Messages of one topic. kind: their type as ROS 2 names it. times_ns: int64 [N], when
    each was recorded, ascending.
    """

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
        """Read message `index` of a topic. Raises BadConfig if it cannot be read."""


def missing(error: ImportError) -> MissingLibrary:
    """Return the line for a package that reading bags needs."""
    return missing_library("reading and writing bags", error, extra="recordings")


def as_times(times_ns: Sequence[int]) -> NDArray[np.int64]:
    """Return times in nanoseconds as an array, int64 [N]. Raises ValueError or OverflowError for others."""
    if len(times_ns) > MOST_MESSAGES:
        raise ValueError(f"a topic must have at most {MOST_MESSAGES} messages, found {len(times_ns)}")
    return np.array(times_ns, np.int64).reshape(-1)


@cache
def typestore(encoding: Encoding) -> Typestore:
    """Return the message types of ROS 1 Noetic or ROS 2 Humble. Raises MissingLibrary."""
    try:
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise missing(error) from error
    return get_typestore(Stores.ROS1_NOETIC if encoding == "ros1" else Stores.ROS2_HUMBLE)


def decode(bag: Bag, topic: Topic, index: int) -> Any:
    """Read and decode message `index` of a topic. Raises BadConfig."""
    data = bag.read(topic, index)
    store = typestore(topic.encoding)
    try:
        if topic.encoding == "ros1":
            return store.deserialize_ros1(data, topic.kind)
        return store.deserialize_cdr(data, topic.kind)
    except Exception as error:  # bytes of strangers: the decoder raises what it likes
        raise BadConfig(f"the message is no {topic.kind}: {error}") from error
