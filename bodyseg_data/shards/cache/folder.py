"""A folder of whole shards that were fetched before: named by content, bounded, shared by processes.

A shard under way is `SHA256.SIZE.part`, a whole one `SHA256.tar`; other files in the folder are left alone. A part's
name says how much room it will take, so that downloads under way count as if they were done. Who writes a part holds a
lock on it, which the system gives free if its process is killed.
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

from bodyseg_data.shards.manifest import ShardRecord

DEFAULT_CACHE_BYTES: Final = 20 * 10**9
"""Room for some 300 000 samples."""

IN_USE_S: Final = 60.0
"""A shard read within as many seconds is not evicted; so two sets that do not fit together do not chase each other."""

_NAME: Final = re.compile(r"[0-9a-f]{64}(?:\.tar|\.([0-9]{1,15})\.part)")
_POLL_S: Final = 0.05


def default_folder() -> Path:
    """`bodyseg` in the user's cache folder, which XDG_CACHE_HOME may name; a relative one is ignored, as XDG says."""
    chosen = Path(os.environ.get("XDG_CACHE_HOME", ""))
    return (chosen if chosen.is_absolute() else Path.home() / ".cache") / "bodyseg"


@dataclass(frozen=True)
class _Entry:
    path: Path
    used: float
    size: int


@dataclass(frozen=True)
class ShardCache:
    """`folder` holds at most `limit` bytes of shards. All methods raise OSError for what the disk does."""

    folder: Path
    limit: int
    in_use_s: float = IN_USE_S

    def path(self, record: ShardRecord) -> Path:
        """Where the shard is, or would be, whole."""
        return self.folder / f"{record.sha256}.tar"

    def part(self, record: ShardRecord) -> Path:
        """Where the shard is while it is fetched."""
        return self.folder / f"{record.sha256}.{record.size}.part"

    def read(self, record: ShardRecord, offset: int, length: int) -> bytes | None:
        """Bytes of a shard, None if it is not there whole; marks it as used."""
        try:
            with self.path(record).open("rb", buffering=0) as file:
                if time.time() - os.fstat(file.fileno()).st_mtime > self.in_use_s / 4:
                    with contextlib.suppress(OSError):  # someone else's
                        os.utime(file.fileno())
                return os.pread(file.fileno(), length, offset)
        except FileNotFoundError:
            return None

    @contextlib.contextmanager
    def claim(self, record: ShardRecord) -> Iterator[int | None]:
        """The part file, opened and locked, for the one who is to fetch the shard.

        Waits while another one fetches it. None: do not fetch it, since it is there by now or there is no room for it.
        """
        handle = self._wait_for_part(record)
        try:
            yield handle
        finally:
            if handle is not None:
                # A process forked meanwhile holds the same lock, and closing would not give that free.
                fcntl.flock(handle, fcntl.LOCK_UN)
                os.close(handle)

    def finish(self, record: ShardRecord) -> None:
        """The claimed part is the whole shard."""
        self.part(record).replace(self.path(record))

    def used_bytes(self) -> int:
        """Bytes taken by shards, those under way counted in full."""
        return sum(entry.size for entry in self._entries())

    def _wait_for_part(self, record: ShardRecord) -> int | None:
        while not self.path(record).exists():
            handle = self._open_part(record)
            if handle is None:
                return None
            mine = _lock(handle) and is_at(handle, self.part(record))
            if mine and not self.path(record).exists():
                return handle
            if mine:  # finished between the look and the opening, which made a new part
                self.part(record).unlink()
            os.close(handle)
            time.sleep(_POLL_S)
        return None

    def _open_part(self, record: ShardRecord) -> int | None:
        """The part file, made if there is room; None if there is not."""
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
        """Evict what was not used for longest, and nothing if that would not be enough."""
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
    """Remove a shard, unless it is a part that someone is writing."""
    try:
        handle = os.open(path, os.O_RDWR | os.O_CLOEXEC)
    except FileNotFoundError:
        return True
    try:
        if not _lock(handle):
            return False
        if is_at(handle, path):
            path.unlink(missing_ok=True)
        return True
    finally:
        fcntl.flock(handle, fcntl.LOCK_UN)
        os.close(handle)


def _lock(handle: int) -> bool:
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def is_at(handle: int, path: Path) -> bool:
    """Whether the opened file is still the one of this name: it may have been finished or evicted meanwhile."""
    try:
        return os.path.samestat(os.fstat(handle), path.stat())
    except FileNotFoundError:
        return False
