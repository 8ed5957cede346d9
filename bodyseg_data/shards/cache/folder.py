"""Folder of complete downloaded shards: named by content, of bounded size, shared by processes.

A partial download is `SHA256.SIZE.part`, a complete shard `SHA256.tar`; other files in the folder are not touched. The
size in a part's name reserves its space. The process that writes a part holds a lock on it, which the operating system
releases if the process is killed.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from bodyseg_data.shards.records import CheckedFile

DEFAULT_CACHE_BYTES: Final = 20 * 10**9
"""Default size limit, bytes: room for about 300 000 samples."""

IN_USE_S: Final = 60.0
"""Seconds since its last read during which a shard is not evicted, so that two sets do not evict each other's."""

_NAME: Final = re.compile(r"[0-9a-f]{64}(?:\.tar|\.([0-9]{1,15})\.part)")
_POLL_S: Final = 0.05


def default_folder() -> Path:
    """The folder `bodyseg` in XDG_CACHE_HOME or ~/.cache; a relative XDG_CACHE_HOME is ignored, as XDG requires."""
    chosen = Path(os.environ.get("XDG_CACHE_HOME", ""))
    return (chosen if chosen.is_absolute() else Path.home() / ".cache") / "bodyseg"


@dataclass(frozen=True)
class _Entry:
    path: Path
    used: float
    size: int


@dataclass(frozen=True)
class ShardCache:
    """Cache of at most `limit` bytes of shards in `folder`; shards read within `in_use_s` seconds are not evicted.

    All methods raise OSError for errors of the disk.
    """

    folder: Path
    limit: int
    in_use_s: float = IN_USE_S

    def path(self, record: CheckedFile) -> Path:
        """Path of the complete shard, present or not."""
        return self.folder / f"{record.sha256}.tar"

    def part(self, record: CheckedFile) -> Path:
        """Path of the shard during its download."""
        return self.folder / f"{record.sha256}.{record.size}.part"

    def read(self, record: CheckedFile, offset: int, length: int) -> bytes | None:
        """Read bytes of a shard and mark it as used; None if the complete shard is not in the cache."""
        try:
            with self.path(record).open("rb", buffering=0) as file:
                if time.time() - os.fstat(file.fileno()).st_mtime > self.in_use_s / 4:
                    with contextlib.suppress(OSError):  # the file of another user
                        os.utime(file.fileno())
                return os.pread(file.fileno(), length, offset)
        except FileNotFoundError:
            return None

    @contextlib.contextmanager
    def claim(self, record: CheckedFile) -> Iterator[int | None]:
        """Open and lock the part file, as a descriptor, for the download of the shard.

        Waits while another process downloads it. None if the shard is complete by then or there is no room for it.
        """
        handle = self._wait_for_part(record)
        try:
            yield handle
        finally:
            if handle is not None:
                # A process forked meanwhile holds the same lock, and closing would not release it.
                fcntl.flock(handle, fcntl.LOCK_UN)
                os.close(handle)

    def finish(self, record: CheckedFile) -> None:
        """Turn the claimed part, now complete, into the shard."""
        self.part(record).replace(self.path(record))

    def used_bytes(self) -> int:
        """Bytes taken by shards; partial downloads count in full."""
        return sum(entry.size for entry in self._entries())

    def _wait_for_part(self, record: CheckedFile) -> int | None:
        while not self.path(record).exists():
            handle = self._open_part(record)
            if handle is None:
                return None
            locked = _try_lock(handle) and is_same_file(handle, self.part(record))
            if locked and not self.path(record).exists():
                return handle
            if locked:  # finished between the check and the opening, which created a new part
                self.part(record).unlink()
            os.close(handle)
            time.sleep(_POLL_S)
        return None

    def _open_part(self, record: CheckedFile) -> int | None:
        """Open the part file, created if there is room; None if there is not."""
        part = self.part(record)
        with contextlib.suppress(FileNotFoundError):
            return os.open(part, os.O_RDWR | os.O_CLOEXEC)
        self.folder.mkdir(parents=True, exist_ok=True)
        guard = os.open(self.folder / "lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(guard, fcntl.LOCK_EX)
            if not self._make_room(record.size):
                return None
            return os.open(part, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        finally:
            fcntl.flock(guard, fcntl.LOCK_UN)
            os.close(guard)

    def _make_room(self, size: int) -> bool:
        """Evict the least recently used shards; evict none and return False if that would not free `size` bytes."""
        entries = self._entries()
        excess = sum(entry.size for entry in entries) + size - self.limit
        victims = []
        for entry in sorted(entries, key=lambda entry: entry.used):
            if excess <= 0 or time.time() - entry.used < self.in_use_s:
                break
            victims.append(entry)
            excess -= entry.size
        if excess > 0:
            return False
        return all(_evict(entry.path) for entry in victims)

    def _entries(self) -> list[_Entry]:
        entries = []
        with os.scandir(self.folder) as found:
            for file in found:
                match = _NAME.fullmatch(file.name)
                if match is not None:
                    with contextlib.suppress(FileNotFoundError):  # finished or evicted meanwhile
                        status = file.stat(follow_symlinks=False)
                        size = int(match[1]) if match[1] else status.st_size
                        entries.append(_Entry(Path(file.path), status.st_mtime, size))
        return entries


def _evict(path: Path) -> bool:
    """Remove a shard; False if it is a part that a process is writing."""
    try:
        handle = os.open(path, os.O_RDWR | os.O_CLOEXEC)
    except FileNotFoundError:
        return True
    try:
        if not _try_lock(handle):
            return False
        if is_same_file(handle, path):
            path.unlink(missing_ok=True)
        return True
    finally:
        fcntl.flock(handle, fcntl.LOCK_UN)
        os.close(handle)


def _try_lock(handle: int) -> bool:
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def is_same_file(handle: int, path: Path) -> bool:
    """Test that `path` still names the opened file, which may have been renamed or evicted meanwhile."""
    try:
        return os.path.samestat(os.fstat(handle), path.stat())
    except FileNotFoundError:
        return False
