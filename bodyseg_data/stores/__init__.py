"""Where the files of a set are: a folder of this machine, or behind an address."""

from __future__ import annotations

import io
import os
from pathlib import Path
from typing import Any, Final, Protocol

from bodyseg_data.files import contents

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

    @property
    def name(self) -> str:
        """The path."""
        return str(self.path)

    def read(self, name: str, offset: int, length: int) -> bytes:
        """See `Store.read`."""
        with (self.path / name).open("rb", buffering=0) as file:
            return os.pread(file.fileno(), length, offset)

    def whole(self, name: str, limit: int) -> bytes | None:
        """See `Store.whole`."""
        try:
            data = contents(self.path / name, packed=False, limit=limit)
        except FileNotFoundError:
            return None
        if data is None:
            raise OSError(f"at most {limit} bytes are read, found more")
        return data

    def size(self, name: str) -> int:
        """See `Store.size`."""
        return (self.path / name).stat().st_size

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
