"""ROS 2 bags: folders of files in SQLite (.db3) or MCAP beside a metadata.yaml."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable
from itertools import accumulate
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadConfig
from bodyseg_model.recordings.bags.depth_topics import bag_recording
from bodyseg_model.recordings.bags.mcap_files import McapBag
from bodyseg_model.recordings.bags.messages import Bag, Topic
from bodyseg_model.recordings.bags.sqlite_files import SqliteBag
from bodyseg_model.recordings.recording import StoredRecording

_STORAGE: Final[dict[str, Callable[[Path], Bag]]] = {".db3": SqliteBag, ".mcap": McapBag}
_PACKED: Final = (".zstd", ".zst")


def open_ros2(path: Path, topic: str | None, step_m: float | None) -> StoredRecording:
    """Open the folder of a ROS 2 bag, whose files are read one after another. Raises BadConfig, MissingLibrary."""
    files = sorted(path.iterdir(), key=lambda file: (len(file.name), file.name))
    parts = [file for file in files if file.suffix.lower() in _STORAGE]
    packed = [file for file in files if file.suffix.lower() in _PACKED]
    if packed:
        raise BadConfig(f"files of a bag must be decompressed first, by `zstd -d`: {packed[0]}")
    if not parts:
        raise BadConfig(f"a ROS 2 bag must hold .db3 or .mcap files, found none in {path}")
    return bag_recording(path, _Joined([_STORAGE[file.suffix.lower()](file) for file in parts]), topic, step_m)


class _Joined:
    """Files of one bag, the messages of a topic one after another."""

    def __init__(self, parts: list[Bag]) -> None:
        homes: dict[tuple[str, str], list[tuple[Bag, Topic]]] = {}
        for part in parts:
            for topic in part.topics:
                homes.setdefault((topic.name, topic.kind), []).append((part, topic))
        self._homes = {
            Topic(name, kind, homes[name, kind][0][1].encoding, _joined(homes[name, kind])): homes[name, kind]
            for name, kind in sorted(homes)
        }
        self.topics = list(self._homes)

    def read(self, topic: Topic, index: int) -> bytes:
        """Read message `index` of a topic."""
        homes = self._homes[topic]
        ends = [*accumulate(len(of_part.times_ns) for _, of_part in homes)]
        number = bisect_right(ends, index)
        part, of_part = homes[number]
        return part.read(of_part, index - ends[number] + len(of_part.times_ns))


def _joined(homes: list[tuple[Bag, Topic]]) -> NDArray[np.int64]:
    return np.concatenate([topic.times_ns for _, topic in homes])
