"""Single files of ROS 2 bags in SQLite (.db3), those of RealSense's SDK among them."""

from __future__ import annotations

import sqlite3
from pathlib import Path
from urllib.parse import quote

from bodyseg_data.core.errors import BadConfig
from bodyseg_model.recordings.bags.compression import decompressed
from bodyseg_model.recordings.bags.depth_topics import bag_recording
from bodyseg_model.recordings.bags.messages import LARGEST_MESSAGE, MOST_MESSAGES, Topic, as_times
from bodyseg_model.recordings.recording import StoredRecording


def open_sqlite(path: Path, topic: str | None, step_m: float | None) -> StoredRecording:
    """Open a .db3 file. Raises BadConfig, MissingLibrary."""
    return bag_recording(path, SqliteBag(path), topic, step_m)


class SqliteBag:
    """Messages of a .db3 file by its tables `topics` and `messages`. Raises BadConfig for another file."""

    def __init__(self, path: Path) -> None:
        # A file without a log of writes beside it changes no more; then SQLite needs to make no file of its own.
        rest = "" if path.with_name(f"{path.name}-wal").exists() else "&immutable=1"
        uri = f"file:{quote(str(path.absolute()))}?mode=ro{rest}"
        try:
            self._base = sqlite3.connect(uri, uri=True, check_same_thread=False)
        except sqlite3.Error as error:
            raise BadConfig(f"cannot read {path}: {error}") from error
        self._rows: dict[Topic, list[int]] = {}
        try:
            self._base.execute("PRAGMA trusted_schema=OFF")
            tables = self._base.execute("SELECT name FROM sqlite_master WHERE type='table'").fetchall()
            if not {("topics",), ("messages",)} <= set(tables):
                raise ValueError("tables 'topics' and 'messages' are missing")
            for number, name, kind, form in self._base.execute(
                "SELECT id, name, type, serialization_format FROM topics ORDER BY name"
            ).fetchmany(10_000):
                rows = self._base.execute(
                    "SELECT timestamp, id FROM messages WHERE topic_id=? ORDER BY timestamp, id", (number,)
                ).fetchmany(MOST_MESSAGES)
                if form == "cdr":
                    topic = Topic(str(name), str(kind), "cdr", as_times([int(time) for time, _ in rows]))
                    self._rows[topic] = [int(row) for _, row in rows]
        except (sqlite3.Error, ValueError, TypeError, OverflowError) as error:
            self._base.close()
            raise BadConfig(f"{path} must be a whole file of a ROS 2 bag: {error}") from error
        self.topics = list(self._rows)

    def __del__(self) -> None:
        if hasattr(self, "_base"):
            self._base.close()

    def read(self, topic: Topic, index: int) -> bytes:
        """Read message `index` of a topic, decompressed if single messages are compressed."""
        try:
            row = self._base.execute(
                "SELECT data FROM messages WHERE id=? AND length(data)<=?", (self._rows[topic][index], LARGEST_MESSAGE)
            ).fetchone()
            if row is None or not isinstance(row[0], bytes):
                raise ValueError(f"it is missing, or has more than {LARGEST_MESSAGE} bytes")
            return decompressed(row[0])
        except Exception as error:  # damaged pages and compressed data raise what their libraries like
            raise BadConfig(f"the message cannot be read: {error}") from error
