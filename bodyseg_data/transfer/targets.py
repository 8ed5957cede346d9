"""Targets of a transfer: a local folder, into which downloads resume, and an address, to which files are uploaded."""

from __future__ import annotations

import fcntl
import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Final, Protocol

from bodyseg_data.core.errors import BadConfig, BadShard
from bodyseg_data.core.files import sync, write_atomically
from bodyseg_data.shards.stores.remote import RemoteFolder
from bodyseg_data.shards.stores.store import READ_ATTEMPTS, LocalFolder, Store
from bodyseg_data.transfer.bundle import SharedFile, sha256_of

_BLOCK_BYTES: Final = 4 << 20

Report = Callable[[int], None]
"""Receiver of numbers of bytes that have just been copied."""


class Target(Protocol):
    """Receiver of a bundle. All methods raise OSError for local files, Unreachable for a network."""

    @property
    def store(self) -> Store:
        """The files that the target holds."""

    def holds(self, file: SharedFile, sizes_only: bool) -> bool:
        """Return whether the target has a file of this size and, unless `sizes_only`, of this SHA-256."""

    def receive(self, file: SharedFile, report: Report, sizes_only: bool) -> None:
        """Copy a file from the source and check it. Raises BadShard if its bytes are not those expected."""

    def write(self, name: str, data: bytes) -> None:
        """Write a small file at once or not at all."""

    def remove(self, name: str) -> None:
        """Remove a file, which may be missing."""


class LocalTarget:
    """A local folder, made if it is missing. A file is called `.NAME.part` until it is complete and checked."""

    def __init__(self, folder: Path, source: Store) -> None:
        self._folder, self._source = folder, source
        folder.mkdir(parents=True, exist_ok=True)
        self.store: Store = LocalFolder(folder)

    def holds(self, file: SharedFile, sizes_only: bool) -> bool:
        """See `Target.holds`."""
        path = self._folder / file.name
        if not path.is_file() or path.stat().st_size != file.size:
            return False
        return sizes_only or sha256_of(self.store, file.name) == file.sha256

    def receive(self, file: SharedFile, report: Report, sizes_only: bool) -> None:
        """See `Target.receive`: continues a part that an interrupted transfer left. The SHA-256 is always checked."""
        part = self._folder / f".{file.name}.part"
        with part.open("r+b" if part.exists() else "w+b") as held:
            try:
                fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise BadConfig(f"{part}: another transfer writes this file") from None
            held.truncate(min(os.fstat(held.fileno()).st_size, file.size))
            resumed = held.seek(0, os.SEEK_END)
            report(resumed)
            for attempt in range(1, READ_ATTEMPTS + 1):

                def keep(chunk: bytes) -> None:
                    held.write(chunk)
                    report(len(chunk))

                _fetch(self._source, file.name, held.seek(0, os.SEEK_END), file.size, keep)
                held.seek(0)
                found = hashlib.file_digest(held, "sha256").hexdigest()
                if found == file.sha256:
                    break
                report(-held.seek(0, os.SEEK_END))
                held.truncate(0)
                # The part that was there may be of another file: that says nothing about the source.
                again, resumed = resumed > 0 or self._source.prepare_reread(file.name), 0
                if attempt == READ_ATTEMPTS or not again:
                    part.unlink()
                    raise BadShard(_altered(f"{self._source.name}/{file.name}", file, found))
            held.flush()
            os.fsync(held.fileno())
            part.replace(self._folder / file.name)
        sync(self._folder)

    def write(self, name: str, data: bytes) -> None:
        """See `Target.write`."""
        write_atomically(self._folder / name, data)

    def remove(self, name: str) -> None:
        """See `Target.remove`."""
        (self._folder / name).unlink(missing_ok=True)


class RemoteTarget:
    """A folder at an address, filled from a local one. Files are sent whole, and again if one was interrupted."""

    def __init__(self, remote: RemoteFolder, folder: Path) -> None:
        self._remote, self._folder = remote, folder
        self.store: Store = remote

    def holds(self, file: SharedFile, sizes_only: bool) -> bool:
        """See `Target.holds`; the bytes are read back from the address."""
        if self._remote.find_size(file.name) != file.size:
            return False
        return sizes_only or sha256_of(self._remote, file.name) == file.sha256

    def receive(self, file: SharedFile, report: Report, sizes_only: bool) -> None:
        """See `Target.receive`: the local bytes are checked before, those at the address after."""
        path = self._folder / file.name
        found = sha256_of(LocalFolder(self._folder), file.name)
        if found != file.sha256:
            raise BadShard(_altered(str(path), file, found))
        self._remote.write_file(file.name, path)
        if not self.holds(file, sizes_only):
            raise BadShard(f"{self._remote.name}/{file.name}: the bytes that arrived are not those that were sent")
        report(file.size)

    def write(self, name: str, data: bytes) -> None:
        """See `Target.write`."""
        self._remote.write_bytes(name, data)

    def remove(self, name: str) -> None:
        """See `Target.remove`."""
        self._remote.remove(name)


def _altered(name: str, file: SharedFile, found: str) -> str:
    return f"{name}: altered: SHA-256 {file.sha256} expected, found {found}"


def _fetch(source: Store, name: str, start: int, stop: int, sink: Callable[[bytes], None]) -> None:
    """Pass bytes `start` to `stop` of a file to `sink`; of a local file that is shorter, those that it has."""
    if isinstance(source, RemoteFolder):
        source.fetch(name, start, stop, sink)
        return
    while start < stop:
        chunk = source.read(name, start, min(_BLOCK_BYTES, stop - start))
        if not chunk:
            return
        sink(chunk)
        start += len(chunk)
