"""The recording in a bag: its topic of range images, their times, camera and unit."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from numpy.typing import NDArray

from bodyseg_data.core.errors import BadConfig
from bodyseg_model.recordings.bags.camera_info import camera_beside
from bodyseg_model.recordings.bags.images import is_floating, is_range_image, pixels, stamp
from bodyseg_model.recordings.bags.messages import COMPRESSED, FLOAT32, IMAGE, Bag, Topic, decode
from bodyseg_model.recordings.recording import FrameSource, Stamp, StoredRecording, stored_recording

_KINDS: Final = (IMAGE, COMPRESSED)
_UNITS_TOPIC: Final = "option/Depth_Units/value"
_LONGEST_LIST: Final = 12


def bag_recording(path: Path, bag: Bag, topic: str | None, step_m: float | None) -> StoredRecording:
    """Return the range images of a bag as a recording: those of `topic`, or of the only topic that has any.

    Raises BadConfig, listing the topics, for another topic, none, or several.
    """
    images = [each for each in bag.topics if each.kind in _KINDS and len(each.times_ns)]
    if topic is not None:
        chosen = [each for each in images if each.name == topic or each.name == f"/{topic}"]
        if not chosen:
            raise BadConfig(f"--topic must be a topic of images, one of {_listed(images)}, found {topic!r}: {path}")
    else:
        chosen = [each for each in images if _has_ranges(bag, each)]
        if not chosen:
            raise BadConfig(f"a recording must have a topic of range images, found {_listed(images)}: {path}")
        if len(chosen) > 1:
            raise BadConfig(f"several topics have range images, choose one by --topic: {_listed(chosen)} ({path})")
    (found,) = chosen[:1]
    first = _first(bag, found)
    floating = first is not None and is_floating(first, found.kind)
    return stored_recording(
        path,
        _Images(bag, found, floating),
        [time / 1e9 for time in found.times_ns],
        floating,
        step_m,
        _stored_step(bag, found),
        camera_beside(bag, found, str(path)),
        found.name,
    )


class _Images(FrameSource):
    """Images of one topic. The last message stays decoded, since its header is often read after its pixels."""

    def __init__(self, bag: Bag, topic: Topic, floating: bool) -> None:
        self._bag, self._topic, self._floating = bag, topic, floating
        self._last: tuple[int, Any] | None = None

    def read(self, index: int) -> NDArray[Any]:
        image = pixels(self._message(index), self._topic.kind)
        if (image.dtype.kind == "f") != self._floating:
            raise BadConfig(f"all images of a topic must be of the first one's encoding, found {image.dtype}")
        return image

    def stamp(self, index: int) -> Stamp:
        return stamp(self._message(index))

    def _message(self, index: int) -> Any:
        if self._last is None or self._last[0] != index:
            self._last = None  # not two messages at once
            self._last = index, decode(self._bag, self._topic, index)
        return self._last[1]


def _has_ranges(bag: Bag, topic: Topic) -> bool:
    first = _first(bag, topic)
    return first is not None and is_range_image(first, topic.kind)


def _first(bag: Bag, topic: Topic) -> Any:
    """The first of the first ten messages that can be read, or None."""
    for index in range(min(10, len(topic.times_ns))):
        try:
            return decode(bag, topic, index)
        except BadConfig:
            continue
    return None


def _stored_step(bag: Bag, topic: Topic) -> float | None:
    """Metres a step as RealSense's recordings hold it, beside the sensor; None elsewhere."""
    sensor = topic.name.split("/")[:3]
    name = "/".join([*sensor, _UNITS_TOPIC])
    units = next((each for each in bag.topics if each.name == name and each.kind == FLOAT32), None)
    value = _first(bag, units) if units is not None else None
    return float(value.data) if value is not None and 1e-6 <= value.data <= 0.1 else None


def _listed(topics: list[Topic]) -> str:
    names = [topic.name for topic in topics]
    more = f" and {len(names) - _LONGEST_LIST} more" if len(names) > _LONGEST_LIST else ""
    return (", ".join(names[:_LONGEST_LIST]) or "none") + more
