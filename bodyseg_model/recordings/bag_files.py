"""Bags in their four kinds of files, each as a `Bag` of topics and messages.

ROS 1 bags, as those of RealSense's SDK; single files of ROS 2 in SQLite (.db3), the SDK's among them; MCAP files
(https://mcap.dev/spec), chunked or not, indexed or not; and ROS 2 bags, folders of such files beside a metadata.yaml.
"""

import contextlib
import io
import os
import sqlite3
import struct
import zlib
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterator
from functools import partial
from itertools import accumulate, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Final
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig, MissingLibrary, reported
from bodyseg_model.recordings.bag_messages import (
    LARGEST_MESSAGE,
    MOST_MESSAGES,
    Bag,
    Encoding,
    Topic,
    as_times,
    bag_library,
    bag_recording,
    decompressed,
)

if TYPE_CHECKING:
    from mcap.records import Channel, Schema
    from rosbags.interfaces import Connection


MAGIC: Final = b"\x89MCAP0\r\n"

_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _INDEX = 2, 3, 4, 5, 6, 7
_MCAP_RECORD: Final = struct.Struct("<BQ")
_MESSAGE_START: Final = struct.Struct("<HIQQ")
_PLAIN: Final = -1
_SCANNED: Final = (1 << 26, 100)  # most bytes of chunks without an index: this many, or this many times the file's
_ENCODINGS: Final[dict[str, Encoding]] = {"cdr": "cdr", "ros1": "ros1"}

_PACKED: Final = (".zstd", ".zst")


_Places = NDArray[np.int64]
"""Records of messages [N, 4]: channel; time, ns; the chunk's byte in the file, `_PLAIN` for none; byte within that."""


class McapBag:
    """Messages of an MCAP file. Records are listed by their headers; one decompressed chunk at a time is in memory.

    Raises BadConfig for a file that is damaged or cut off, MissingLibrary.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._channels: dict[int, Channel] = {}
        self._schemas: dict[int, Schema] = {}
        self._held: tuple[int, bytes] = (_PLAIN, b"")
        self._found: list[_Places] = []
        self._left = max(_SCANNED[0], _SCANNED[1] * path.stat().st_size)
        self._messages = 0
        mended = "`mcap recover` mends a recording that was cut off"
        with BadConfig.named(f"{path} must be a whole MCAP file ({mended})", passes=MissingLibrary):
            with path.open("rb") as file:
                self._list(file)
            self._locations = self._by_topic()
        self.topics = list(self._locations)

    def _by_topic(self) -> dict[Topic, _Places]:
        """Join the messages of a topic's channels, in the order of time."""
        joined: dict[tuple[str, str, Encoding], list[int]] = {}
        for number, channel in self._channels.items():
            schema = self._schemas.get(channel.schema_id)
            if schema is not None and channel.message_encoding in _ENCODINGS:
                kind = schema.name if "/msg/" in schema.name else schema.name.replace("/", "/msg/", 1)
                joined.setdefault((channel.topic, kind, _ENCODINGS[channel.message_encoding]), []).append(number)
        places = np.concatenate([np.empty((0, 4), np.int64), *self._found])
        places = places[np.lexsort(places.T[:0:-1])]
        by_topic = {name: places[np.isin(places[:, 0], numbers)] for name, numbers in sorted(joined.items())}
        return {Topic(*name, as_times(found[:, 1])): found for name, found in by_topic.items() if len(found)}

    def _note(self, places: Any) -> None:
        """Note messages' `_Places`. Raises ValueError for too many."""
        self._found.append(np.array(places, np.int64).reshape(-1, 4))
        self._messages += len(places)
        if self._messages > MOST_MESSAGES or self._found[-1].min(initial=0) < _PLAIN:
            raise ValueError(f"it must have at most {MOST_MESSAGES} messages, of times and places below 2^63")

    def read(self, topic: Topic, index: int) -> bytes:
        _, _, chunk, offset = self._locations[topic][index].tolist()
        if chunk == _PLAIN:
            with self._path.open("rb") as file:
                return _mcap_record(file, offset, _MESSAGE)[_MESSAGE_START.size :]
        if self._held[0] != chunk:
            self._held = (_PLAIN, b"")  # frees one chunk before the next is read
            with self._path.open("rb") as file:
                self._held = chunk, _mcap_chunk(file, chunk, LARGEST_MESSAGE)
        return _mcap_record(io.BytesIO(self._held[1]), offset, _MESSAGE)[_MESSAGE_START.size :]

    def _list(self, file: BinaryIO) -> None:
        """Note where all messages lie: from the index behind each chunk, or from the chunk itself if it has none."""
        if file.read(len(MAGIC)) != MAGIC:
            raise ValueError("its first bytes are others")
        chunk, indexed, whole = _PLAIN, True, False
        plain: list[tuple[int, int, int, int]] = []
        for opcode, offset in _mcap_records(file, len(MAGIC)):
            if opcode == _INDEX:
                data = _mcap_record(file, offset, _INDEX)
                entries = np.frombuffer(data, "<i8", offset=6, count=(len(data) - 6) // 16 * 2).reshape(-1, 2)
                number = int.from_bytes(data[:2], "little")
                self._note([(number, time, chunk, start) for time, start in entries.tolist()])
                indexed = True
                if number not in self._channels:
                    self._scan(file, chunk, noted=False)
            elif opcode in (_SCHEMA, _CHANNEL):
                self._define(opcode, _mcap_record(file, offset, opcode))
            else:
                if not indexed:
                    self._scan(file, chunk)
                    indexed = True
                if opcode == _CHUNK:
                    chunk, indexed = offset, False
                elif opcode == _MESSAGE:
                    file.seek(offset + _MCAP_RECORD.size)
                    number, _, time, _ = _MESSAGE_START.unpack(file.read(_MESSAGE_START.size))
                    plain.append((number, time, _PLAIN, offset))
                elif opcode == _FOOTER:
                    whole = True
                    break
        if not whole:
            raise ValueError("it ends before its footer")
        self._note(plain)

    def _scan(self, file: BinaryIO, chunk: int, noted: bool = True) -> None:
        """Note the schemas and channels of the chunk at a byte, and its messages unless an index lists them."""
        data = _mcap_chunk(file, chunk, min(self._left, LARGEST_MESSAGE))
        self._left -= len(data)
        within, found = io.BytesIO(data), list[tuple[int, int, int, int]]()
        for opcode, offset in _mcap_records(within, 0):
            if opcode in (_SCHEMA, _CHANNEL):
                self._define(opcode, _mcap_record(within, offset, opcode))
            elif opcode == _MESSAGE and noted:
                number, _, time, _ = _MESSAGE_START.unpack_from(data, offset + _MCAP_RECORD.size)
                found.append((number, time, chunk, offset))
        self._note(found)

    def _define(self, opcode: int, data: bytes) -> None:
        record = _mcap_parsed("Schema" if opcode == _SCHEMA else "Channel", data)
        (self._schemas if opcode == _SCHEMA else self._channels)[record.id] = record


def _mcap_records(file: BinaryIO, start: int) -> Iterator[tuple[int, int]]:
    """Yield the kind and location of every record from byte `start` on, by their headers. Raises ValueError."""
    size = file.seek(0, io.SEEK_END)
    offset = start
    while offset + _MCAP_RECORD.size <= size:
        file.seek(offset)
        opcode, length = _MCAP_RECORD.unpack(file.read(_MCAP_RECORD.size))
        if not opcode or offset + _MCAP_RECORD.size + length > size:
            raise ValueError(f"it is cut off at byte {offset}" if opcode else f"no record begins at byte {offset}")
        yield opcode, offset
        offset += _MCAP_RECORD.size + length


def _mcap_record(file: BinaryIO, offset: int, kind: int) -> bytes:
    """Read the content of the record at a byte. Raises ValueError for another kind, or one that is cut off."""
    file.seek(offset)
    opcode, length = _MCAP_RECORD.unpack(file.read(_MCAP_RECORD.size))
    if opcode != kind or length > LARGEST_MESSAGE:
        raise ValueError(f"a record at byte {offset} is of kind {opcode} and has {length} bytes")
    data = file.read(length)
    if len(data) != length:
        raise ValueError(f"a record at byte {offset} is cut off")
    return data


def _mcap_parsed(kind: str, data: bytes) -> Any:
    """Parse the content of a record of a class of `mcap.records`. Raises MissingLibrary."""
    stream = bag_library("mcap.data_stream").ReadDataStream(io.BytesIO(data))
    return getattr(bag_library("mcap.records"), kind).read(stream)


def _mcap_chunk(file: BinaryIO, offset: int, most: int) -> bytes:
    """Read the chunk at a byte, decompressed to at most so many. Raises ValueError, also for a wrong checksum."""
    chunk = _mcap_parsed("Chunk", _mcap_record(file, offset, _CHUNK))
    size = chunk.uncompressed_size
    if size > most:
        raise ValueError(f"the chunk at byte {offset} claims {size} bytes of {len(chunk.data)}, beyond any recording's")
    data = decompressed(chunk.data, size) if chunk.compression else chunk.data
    if len(data) != size:
        raise ValueError(f"a chunk must have {size} bytes, found {len(data)}")
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise ValueError(f"the checksum of the chunk at byte {offset} must be {chunk.uncompressed_crc:08x}")
    return data


class SqliteBag:
    """Messages of a .db3 file by its tables `topics` and `messages`. Raises BadConfig for another file."""

    def __init__(self, path: Path) -> None:
        # A file without a log of writes beside it changes no more; then SQLite needs to make no file of its own.
        rest = "" if path.with_name(f"{path.name}-wal").exists() else "&immutable=1"
        uri = f"file:{quote(str(path.absolute()))}?mode=ro{rest}"
        with reported(f"cannot read {path}", BadConfig, sqlite3.Error):
            self._base = sqlite3.connect(uri, uri=True, check_same_thread=False)
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
        row = self._base.execute(
            "SELECT data FROM messages WHERE id=? AND length(data)<=?", (self._rows[topic][index], LARGEST_MESSAGE)
        ).fetchone()
        if row is None or not isinstance(row[0], bytes):
            raise ValueError(f"it is missing, or has more than {LARGEST_MESSAGE} bytes")
        return decompressed(row[0])


class _Ros1Bag:
    """Messages of a ROS 1 bag by its index; one chunk of it at a time is in memory."""

    def __init__(self, path: Path) -> None:
        reader = bag_library("rosbags.rosbag1").Reader
        self._stream: tuple[Topic, int, Iterator[Any]] | None = None
        self._connections: dict[str, list[Connection]] = {}
        self._reader, self._process = reader(path), os.getpid()
        mended = "`rosbag reindex` mends a recording that was cut off"
        with BadConfig.named(f"{path} must be a whole ROS 1 bag with an index ({mended})", passes=MissingLibrary):
            self._reader.open()
            for position, chunk in self._reader.chunks.items():
                if chunk.datasize > LARGEST_MESSAGE:
                    raise ValueError(f"a chunk must have at most {LARGEST_MESSAGE} bytes, found {chunk.datasize}")
                self._reader.chunks[position] = chunk._replace(decompressor=decompressed)
            for connection in self._reader.connections:
                self._connections.setdefault(connection.topic, []).append(connection)
            self.topics = [self._topic(name) for name in sorted(self._connections)]

    def __del__(self) -> None:
        with contextlib.suppress(Exception):  # it may never have been opened
            self._reader.close()

    def read(self, topic: Topic, index: int) -> bytes:
        """Read message `index` of a topic: the next one of the stream that is open, or else by its time."""
        if self._process != os.getpid():  # a fork's file would move on with its parent's
            self._reader.bio, self._process = self._reader.path.open("rb"), os.getpid()
        if self._stream is None or self._stream[:2] != (topic, index):
            time = int(topic.times_ns[index])
            messages = self._reader.messages(self._connections[topic.name], start=time)
            same = bisect_left(topic.times_ns, time)
            self._stream = topic, index, islice(messages, index - same, None)
        stream, self._stream = self._stream[2], None
        _, _, data = next(stream)
        self._stream = topic, index + 1, stream
        return bytes(data)

    def _topic(self, name: str) -> Topic:
        connections = self._connections[name]
        times = sorted(entry.time for each in connections for entry in self._reader.indexes[each.id])
        return Topic(name, connections[0].msgtype, "ros1", as_times(times))


_ROS2_STORAGE: Final[dict[str, Callable[[Path], Bag]]] = {".db3": SqliteBag, ".mcap": McapBag}


class _JoinedBags:
    """The folder of a ROS 2 bag: messages of all its files, in the order of time. Raises BadConfig, MissingLibrary."""

    def __init__(self, path: Path) -> None:
        files = sorted(path.glob("[!.]*"), key=lambda file: (len(file.name), file.name))
        packed = [file for file in files if file.suffix.lower() in _PACKED and file.with_suffix("") not in files]
        if packed:
            raise BadConfig(f"files of a bag must be decompressed first, by `zstd -d`: {packed[0]}")
        parts = [_ROS2_STORAGE[file.suffix.lower()](file) for file in files if file.suffix.lower() in _ROS2_STORAGE]
        if not parts:
            raise BadConfig(f"a ROS 2 bag must hold .db3 or .mcap files, found none in {path}")
        homes: dict[tuple[str, str], list[tuple[Bag, Topic]]] = {}
        for part in parts:
            for topic in part.topics:
                homes.setdefault((topic.name, topic.kind), []).append((part, topic))
        self._homes: dict[Topic, tuple[list[tuple[Bag, Topic]], NDArray[np.intp]]] = {}
        for name, kind in sorted(homes):
            topics = [topic for _, topic in homes[name, kind]]
            times_ns = np.concatenate([topic.times_ns for topic in topics])
            order = np.argsort(times_ns, kind="stable")  # files of several recorders, and of one, may overlap
            self._homes[Topic(name, kind, topics[0].encoding, times_ns[order])] = homes[name, kind], order
        self.topics = list(self._homes)

    def read(self, topic: Topic, index: int) -> bytes:
        homes, order = self._homes[topic]
        place = int(order[index])
        ends = [*accumulate(len(of_part.times_ns) for _, of_part in homes)]
        number = bisect_right(ends, place)
        part, of_part = homes[number]
        return part.read(of_part, place - ends[number] + len(of_part.times_ns))


open_ros1, open_ros2 = partial(bag_recording, _Ros1Bag), partial(bag_recording, _JoinedBags)
open_sqlite, open_mcap = partial(bag_recording, SqliteBag), partial(bag_recording, McapBag)
