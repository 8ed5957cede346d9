"""Stores: access to the files of a set, in a local folder or at an address."""

from __future__ import annotations

import contextlib
import io
import os
import threading
import time
from collections.abc import MutableSequence
from concurrent.futures import CancelledError, Future
from enum import IntEnum
from pathlib import Path
from typing import Any, Final, Protocol

from bodyseg_data.core import BadConfig
from bodyseg_data.files import contents

READ_ATTEMPTS: Final = 3
"""Number of reads before altered bytes count as the content of the file."""

_BUFFER_BYTES: Final = 4 << 20


class Stage(IntEnum):
    """Tallies of threads that make samples: seconds of each stage up to DELIVER, then counts."""

    STORE, FETCH, DECODE, ARTIFACTS, TRANSFORM, DELIVER, BATCHES, SAMPLES, BYTES, REQUESTS, HITS, STALLS = range(12)


class Tally(threading.local):
    """Work of the current thread, added up in a row that other threads or processes may read."""

    def __init__(self) -> None:
        self.start([0.0] * len(Stage))

    def start(self, row: MutableSequence[float]) -> None:
        """Tally in `row`, float [len(Stage)], from now on."""
        self.row, self._since = row, time.perf_counter()
        self._at_hand: bool | None = None

    def lap(self, stage: Stage) -> None:
        """The time since the last lap, or the start, was of `stage`."""
        now = time.perf_counter()
        self.row[stage] += now - self._since
        self._since = now

    def count(self, what: Stage, number: float = 1) -> None:
        self.row[what] += number

    def came(self, at_hand: bool) -> None:
        """Bytes of the current sample of a remote set were at hand, or else were waited for."""
        self._at_hand = at_hand and self._at_hand is not False

    def end_sample(self) -> None:
        """Count the current sample as a hit or a stall, however often its bytes were asked for."""
        if self._at_hand is not None:
            self.row[Stage.HITS if self._at_hand else Stage.STALLS] += 1
        self._at_hand = None


TALLY: Final = Tally()


class Pieces:
    """Bytes read ahead of a store's files. Threads may use it at once; copies, in forks and by pickle, are empty."""

    def __init__(self) -> None:
        self._owner, self._changing = os.getpid(), threading.Lock()
        self._pieces: dict[tuple[str, int], Future[bytes]] = {}
        self.size = 0
        """Bytes that are expected or held."""

    def __reduce__(self) -> tuple[type[Pieces], tuple[()]]:
        return Pieces, ()

    def expect(self, name: str, offset: int, length: int) -> Future[bytes] | None:
        """Have `take` wait for a range; None if it does already."""
        if self._owner != os.getpid():
            self.__init__()  # type: ignore[misc]  # a lock may have been held at the fork
        with self._changing:
            if (name, offset) in self._pieces:
                return None
            self.size += length
            return self._pieces.setdefault((name, offset), Future())

    def take(self, name: str, offset: int, length: int) -> bytes | None:
        """Return a range once it has come; None if it is not expected, or no longer."""
        piece = self._pieces.get((name, offset)) if self._owner == os.getpid() else None
        if piece is None:
            return None
        TALLY.came(piece.done())
        with contextlib.suppress(CancelledError):  # of a piece that was given up; `wait` would not return
            piece.result()
        with self._changing:  # not before, or `clear` would not find it
            if self._pieces.pop((name, offset), None) is not None:
                self.size -= length
        return None if piece.cancelled() else piece.result()

    def clear(self) -> None:
        """Expect nothing more."""
        with self._changing:
            for piece in self._pieces.values():
                piece.cancel()
            self._pieces, self.size = {}, 0


class Store(Protocol):
    """Reader of the files of one set. It may be forked, pickled and used by several threads.

    All methods raise OSError for errors of local files, Unreachable for errors of a network.
    """

    @property
    def name(self) -> str:
        """Path or address, for messages; without secrets."""

    def read(self, name: str, offset: int, length: int) -> bytes:
        """Read `length` bytes of a file from `offset` on; fewer at its end."""

    def read_file(self, name: str, limit: int) -> bytes | None:
        """Read a whole file of at most `limit` bytes; None if it does not exist."""

    def size(self, name: str) -> int:
        """Size of a file, bytes."""

    def prepare_reread(self, name: str) -> bool:
        """Prepare to read a file again whose bytes were wrong; False if the same bytes would come."""


def store_at(where: Path | Store) -> Store:
    """Open a local folder as a store; a store is returned unchanged."""
    return LocalFolder(where) if isinstance(where, Path) else where


class LocalFolder:
    """Store of a local folder. Each read opens its file, so processes share no descriptor."""

    def __init__(self, path: Path) -> None:
        self.path, self.name = path, str(path)
        self._root = path.absolute()  # the working directory may change, or be another in a worker
        self._prefix = f"{self._root}{os.sep}"  # joining paths takes longer than opening a file

    def read(self, name: str, offset: int, length: int) -> bytes:
        # Without O_NONBLOCK, opening a pipe waits for a writer; files ignore the flag.
        file = os.open(self._prefix + name, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        try:
            return os.pread(file, length, offset)
        finally:
            os.close(file)

    def read_file(self, name: str, limit: int) -> bytes | None:
        """See `Store.read_file`. Raises BadConfig if the folder does not exist."""
        try:
            data = contents(self._root / name, packed=False, limit=limit)
        except (FileNotFoundError, NotADirectoryError):
            if not self._root.is_dir():
                raise BadConfig(f"no such folder: {self.path}") from None
            return None
        if data is None:
            raise OSError(f"at most {limit} bytes are read, found more")
        return data

    def size(self, name: str) -> int:
        return (self._root / name).stat().st_size

    def prepare_reread(self, name: str) -> bool:
        return False  # a disk gives the same bytes again


class HeldFile:
    """Store of one file: one thread fetches its first `size` bytes when any are read, and they are held in memory."""

    def __init__(self, store: Store, size: int) -> None:
        self.name, self.size, self.read_file = store.name, store.size, store.read_file
        self._store, self._length, self._data, self._fetching = store, size, b"", 0  # the last: a process's id

    def read(self, name: str, offset: int, length: int) -> bytes:
        if not (data := self._data):
            if self._fetching == os.getpid():  # another thread does; two would take twice the memory
                return self._store.read(name, offset, length)
            self._fetching = os.getpid()
            try:
                data = self._data = self._store.read(name, 0, self._length)
            finally:
                self._fetching = 0
        return data[offset : offset + length]

    def prepare_reread(self, name: str) -> bool:
        self._data = b""
        return True


def open_file(store: Store, name: str) -> io.BufferedReader:
    """Open a file of a set for sequential reading. Opening and reading raise OSError or Unreachable."""
    return io.BufferedReader(_StoreFile(store, name), _BUFFER_BYTES)


class _StoreFile(io.RawIOBase):
    """Unbuffered sequential reader of a store's file."""

    def __init__(self, store: Store, name: str) -> None:
        self._store, self._name, self._size, self._position = store, name, store.size(name), 0

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        data = self._store.read(self._name, self._position, min(len(buffer), self._size - self._position))
        buffer[: len(data)] = data
        self._position += len(data)
        return len(data)
