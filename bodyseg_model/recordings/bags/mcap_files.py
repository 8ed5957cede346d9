"""MCAP files (https://mcap.dev/spec), chunked or not, with an index or without."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Final, NamedTuple

import numpy as np

from bodyseg_data.core.errors import BadConfig, MissingLibrary
from bodyseg_model.recordings.bags.compression import decompressed
from bodyseg_model.recordings.bags.depth_topics import bag_recording
from bodyseg_model.recordings.bags.messages import LARGEST_MESSAGE, MOST_MESSAGES, Encoding, Topic, as_times, missing
from bodyseg_model.recordings.recording import StoredRecording

if TYPE_CHECKING:
    from mcap.records import Channel, Schema

MAGIC: Final = b"\x89MCAP0\r\n"

_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _INDEX = 2, 3, 4, 5, 6, 7
_RECORD: Final = struct.Struct("<BQ")
_MESSAGE_START: Final = struct.Struct("<HIQQ")
_PLAIN: Final = -1
_ENCODINGS: Final[dict[str, Encoding]] = {"cdr": "cdr", "ros1": "ros1"}


def open_mcap(path: Path, topic: str | None, step_m: float | None) -> StoredRecording:
    """Open an MCAP file with messages of ROS 1 or 2. Raises BadConfig, MissingLibrary."""
    return bag_recording(path, McapBag(path), topic, step_m)


class _Location(NamedTuple):
    """A message's record: in the chunk at byte `chunk` of the file, or in the file itself (`_PLAIN`), from `offset`."""

    time_ns: int
    chunk: int
    offset: int


class McapBag:
    """Messages of an MCAP file. Records are listed by their headers; one decompressed chunk at a time is in memory.

    Raises BadConfig for a file that is damaged or cut off, MissingLibrary.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._channels: dict[int, Channel] = {}
        self._schemas: dict[int, Schema] = {}
        self._held: tuple[int, bytes] = (_PLAIN, b"")
        locations: dict[int, list[_Location]] = {}
        try:
            with path.open("rb") as file:
                self._list(file, locations)
            self._locations = self._by_topic(locations)
        except MissingLibrary:
            raise
        except Exception as error:  # a damaged file raises what the parser likes
            raise BadConfig(
                f"{path} must be a whole MCAP file: {str(error) or type(error).__name__} (`mcap recover` mends a "
                "recording that was cut off)"
            ) from error
        self.topics = list(self._locations)

    def _by_topic(self, locations: dict[int, list[_Location]]) -> dict[Topic, list[_Location]]:
        """Join the messages of a topic's channels, in the order of time."""
        joined: dict[tuple[str, str, Encoding], list[_Location]] = {}
        for number, found in locations.items():
            channel = self._channels.get(number)
            schema = self._schemas.get(channel.schema_id) if channel is not None else None
            if channel is not None and schema is not None and channel.message_encoding in _ENCODINGS:
                kind = schema.name if "/msg/" in schema.name else schema.name.replace("/", "/msg/", 1)
                joined.setdefault((channel.topic, kind, _ENCODINGS[channel.message_encoding]), []).extend(found)
        by_topic = {}
        for name, found in sorted(joined.items()):
            found.sort()
            by_topic[Topic(*name, as_times([location.time_ns for location in found]))] = found
        return by_topic

    def read(self, topic: Topic, index: int) -> bytes:
        """Read message `index` of a topic."""
        location = self._locations[topic][index]
        try:
            if location.chunk == _PLAIN:
                with self._path.open("rb") as file:
                    return _record(file, location.offset, _MESSAGE)[_MESSAGE_START.size :]
            if self._held[0] != location.chunk:
                self._held = (_PLAIN, b"")  # not two chunks at once
                with self._path.open("rb") as file:
                    self._held = location.chunk, _chunk(file, location.chunk)
            return _record(io.BytesIO(self._held[1]), location.offset, _MESSAGE)[_MESSAGE_START.size :]
        except Exception as error:  # as above
            raise BadConfig(f"the message cannot be read: {str(error) or type(error).__name__}") from error

    def _list(self, file: BinaryIO, locations: dict[int, list[_Location]]) -> None:
        """List where messages lie, by channel: by the index behind each chunk, or else by its own records."""
        if file.read(len(MAGIC)) != MAGIC:
            raise ValueError("its first bytes are others")
        chunk, indexed, whole = _PLAIN, True, False
        for opcode, offset in _records(file, len(MAGIC)):
            if opcode == _INDEX:
                data = _record(file, offset, _INDEX)
                entries = np.frombuffer(data, "<u8", offset=6, count=min((len(data) - 6) // 16 * 2, 2 * MOST_MESSAGES))
                number = int.from_bytes(data[:2], "little")
                locations.setdefault(number, []).extend(
                    _Location(int(time), chunk, int(start)) for time, start in entries.reshape(-1, 2)
                )
                indexed = True
                if number not in self._channels:
                    self._scan(_chunk(file, chunk), None, chunk)
            elif opcode in (_SCHEMA, _CHANNEL):
                self._define(opcode, _record(file, offset, opcode))
            else:
                if not indexed:
                    self._scan(_chunk(file, chunk), locations, chunk)
                    indexed = True
                if opcode == _CHUNK:
                    chunk, indexed = offset, False
                elif opcode == _MESSAGE:
                    file.seek(offset + _RECORD.size)
                    number, _, time, _ = _MESSAGE_START.unpack(file.read(_MESSAGE_START.size))
                    locations.setdefault(number, []).append(_Location(time, _PLAIN, offset))
                elif opcode == _FOOTER:
                    whole = True
                    break
        if not whole:
            raise ValueError("it ends before its footer")

    def _scan(self, data: bytes, locations: dict[int, list[_Location]] | None, chunk: int) -> None:
        """Note the schemas and channels of a chunk, and where `locations` is given its messages as well."""
        file = io.BytesIO(data)
        for opcode, offset in _records(file, 0):
            if opcode in (_SCHEMA, _CHANNEL):
                self._define(opcode, _record(file, offset, opcode))
            elif opcode == _MESSAGE and locations is not None:
                number, _, time, _ = _MESSAGE_START.unpack_from(data, offset + _RECORD.size)
                locations.setdefault(number, []).append(_Location(time, chunk, offset))

    def _define(self, opcode: int, data: bytes) -> None:
        try:
            from mcap.data_stream import ReadDataStream
            from mcap.records import Channel, Schema
        except ImportError as error:
            raise missing(error) from error
        stream = ReadDataStream(io.BytesIO(data))
        if opcode == _SCHEMA:
            schema = Schema.read(stream)
            self._schemas[schema.id] = schema
        else:
            channel = Channel.read(stream)
            self._channels[channel.id] = channel


def _records(file: BinaryIO, start: int) -> Iterator[tuple[int, int]]:
    """Yield the kind and location of every record from byte `start` on, by their headers. Raises ValueError."""
    size = file.seek(0, io.SEEK_END)
    offset = start
    while offset + _RECORD.size <= size:
        file.seek(offset)
        opcode, length = _RECORD.unpack(file.read(_RECORD.size))
        if offset + _RECORD.size + length > size:
            raise ValueError(f"it is cut off at byte {offset}")
        yield opcode, offset
        offset += _RECORD.size + length


def _record(file: BinaryIO, offset: int, kind: int) -> bytes:
    """Read the content of the record at a byte. Raises ValueError for another kind, or one that is cut off."""
    file.seek(offset)
    opcode, length = _RECORD.unpack(file.read(_RECORD.size))
    if opcode != kind or length > LARGEST_MESSAGE:
        raise ValueError(f"a record at byte {offset} is of kind {opcode} and has {length} bytes")
    data = file.read(length)
    if len(data) != length:
        raise ValueError(f"a record at byte {offset} is cut off")
    return data


def _chunk(file: BinaryIO, offset: int) -> bytes:
    """Read the chunk at a byte, decompressed. Raises ValueError, also for a wrong checksum."""
    try:
        from mcap.data_stream import ReadDataStream
        from mcap.records import Chunk
    except ImportError as error:
        raise missing(error) from error
    chunk = Chunk.read(ReadDataStream(io.BytesIO(_record(file, offset, _CHUNK))))
    data = decompressed(chunk.data) if chunk.compression else chunk.data
    if len(data) != chunk.uncompressed_size:
        raise ValueError(f"a chunk must have {chunk.uncompressed_size} bytes, found {len(data)}")
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise ValueError(f"the checksum of the chunk at byte {offset} must be {chunk.uncompressed_crc:08x}")
    return data
