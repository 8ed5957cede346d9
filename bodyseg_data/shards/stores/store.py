"""Where the files of a set are: a folder of this machine, or behind an address."""

from __future__ import annotations

import io
import os
from pathlib import Path
from typing import Any, Final, Protocol

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.files import contents

TIMES: Final = 3
"""So often altered bytes are fetched before they count as what is there."""

_BUFFER_BYTES: Final = 4 << 20


class Store(Protocol):
    """Reads the files of one set. May be forked, pickled and used by several threads.

    Raises OSError for what this machine's files do, Unreachable for what a network does.
    """

    @property
    def name(self) -> str:
        """Path or address, for messages; without secrets."""

    def read(self, name: str, offset: int, length: int) -> bytes:
        """`length` bytes from `offset` on; fewer where the file ends before."""

    def whole(self, name: str, limit: int) -> bytes | None:
        """A whole file of at most `limit` bytes; None if there is none."""

    def size(self, name: str) -> int:
        """Bytes of a file."""

    def doubt(self, name: str) -> bool:
        """Whether to read again may help where what was read is wrong."""


def store_at(where: Path | Store) -> Store:
    """The store meant: a path is a folder of this machine."""
    return LocalFolder(where) if isinstance(where, Path) else where


class LocalFolder:
    """A folder of this machine. Files are opened for every read, which leaves nothing to share between processes."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._place = path.absolute()  # for programs that change their working directory, and workers that have another

    @property
    def name(self) -> str:
        """The path, as it was given."""
        return str(self.path)

    def read(self, name: str, offset: int, length: int) -> bytes:
        """See `Store.read`."""
        # Opening a pipe must not wait for a writer; to files the flag means nothing.
        file = os.open(self._place / name, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        try:
            return os.pread(file, length, offset)
        finally:
            os.close(file)

    def whole(self, name: str, limit: int) -> bytes | None:
        """See `Store.whole`. Raises BadConfig if the folder itself is not there."""
        try:
            data = contents(self._place / name, packed=False, limit=limit)
        except (FileNotFoundError, NotADirectoryError):
            if not self._place.is_dir():
                raise BadConfig(f"no such folder: {self.path}") from None
            return None
        if data is None:
            raise OSError(f"at most {limit} bytes are read, found more")
        return data

    def size(self, name: str) -> int:
        """See `Store.size`."""
        return (self._place / name).stat().st_size

    def doubt(self, name: str) -> bool:
        """A disk gives the same bytes again."""
        return False


def open_file(store: Store, name: str) -> io.BufferedReader:
    """A file of a set, to be read from its start to its end. Raises OSError or Unreachable, now or when it is read."""
    return io.BufferedReader(_Raw(store, name), _BUFFER_BYTES)


class _Raw(io.RawIOBase):
    """What is buffered: reads wherever the last one ended."""

    def __init__(self, store: Store, name: str) -> None:
        self._store, self._name, self._size, self._position = store, name, store.size(name), 0

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        data = self._store.read(self._name, self._position, min(len(buffer), self._size - self._position))
        buffer[: len(data)] = data
        self._position += len(data)
        return len(data)
