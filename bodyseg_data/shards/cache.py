"""The cache of a remote set: complete shards in a folder, named by content, of bounded size, shared by processes.

A partial download is `SHA256.SIZE.part`, a complete shard `SHA256.tar`; other files in the folder are not touched. The
size in a part's name reserves its space. The process that writes a part holds a lock on it, which the operating system
releases if the process is killed.
"""

import contextlib
import fcntl
import hashlib
import itertools
import os
import re
import time
import warnings
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from bodyseg_data.core import BadConfig, check_int, reported
from bodyseg_data.files import cache_folder
from bodyseg_data.shards.index import IndexedShards
from bodyseg_data.shards.manifest import Manifest
from bodyseg_data.shards.records import CheckedFile
from bodyseg_data.shards.remote import Pause, RemoteFolder
from bodyseg_data.shards.store import READ_ATTEMPTS, TALLY, HeldFile, Store

DEFAULT_CACHE_BYTES: Final = 20 * 10**9
"""Default size limit, bytes: room for about 300 000 samples."""

IN_USE_S: Final = 60.0
"""Seconds since its last read during which a shard is not evicted, so that two sets do not evict each other's."""

_NAME: Final = re.compile(r"[0-9a-f]{64}(?:\.tar|\.([0-9]{1,15})\.part)")
_POLL_S: Final = 0.01
_LARGEST_HELD_INDEX: Final = 1 << 26  # bytes: of some five million samples

BUSY: Final = -1
"""In place of a part's descriptor: another process or thread is writing it."""


@dataclass(frozen=True)
class ShardCache:
    """Cache of at most `limit` bytes of shards in `folder`; shards read within `IN_USE_S` seconds are not evicted.

    All methods raise OSError for errors of the disk.
    """

    folder: Path
    limit: int

    def path(self, record: CheckedFile) -> Path:
        """Path of the complete shard, present or not."""
        return self.folder / f"{record.sha256}.tar"

    def part(self, record: CheckedFile) -> Path:
        """Path of the shard during its download."""
        return self.folder / f"{record.sha256}.{record.size}.part"

    def read(self, record: CheckedFile, offset: int, length: int, part: bool = False) -> bytes | None:
        """Read bytes of a shard and mark it as used; None if the complete shard is not in the cache.

        part: read what has come of it instead, which no hash has checked; None if these bytes have not.
        """
        try:
            with (self.part if part else self.path)(record).open("rb", buffering=0) as file:
                if abs(time.time() - os.fstat(file.fileno()).st_mtime) > IN_USE_S / 4:
                    with contextlib.suppress(OSError):  # the file of another user
                        os.utime(file.fileno())
                data = os.pread(file.fileno(), length, offset)
        except FileNotFoundError:
            return None
        return None if part and len(data) < length else data

    @contextlib.contextmanager
    def claim(self, record: CheckedFile) -> Iterator[int | None]:
        """Open and lock the part file, as a descriptor, for the download of the shard.

        BUSY while another process downloads it, None if the shard is complete or there is no room for it.
        """
        handle = self._open_and_lock(record)
        try:
            yield handle
        finally:
            if handle not in (None, BUSY):
                _release(handle)

    def finish(self, record: CheckedFile) -> None:
        """Turn the claimed part, now complete, into the shard."""
        self.part(record).replace(self.path(record))

    def _open_and_lock(self, record: CheckedFile) -> int | None:
        while not self.path(record).exists():
            handle = self._open_part(record)
            if handle is None:
                return None
            if not _try_lock(handle):
                os.close(handle)
                return BUSY
            same = is_same_file(handle, self.part(record))
            if same and not self.path(record).exists():
                return handle
            if same:  # finished between the check and the opening, which created a new part
                self.part(record).unlink()
            os.close(handle)
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
            if not self._make_room(record.size, guard):
                return None
            return os.open(part, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        finally:
            _release(guard)

    def _make_room(self, size: int, guard: int) -> bool:
        """Evict the least recently used shards; evict none and return False if that would not free `size` bytes."""
        most, victims = os.pread(guard, 20, 0), list[Path]()
        excess = int(most) + size - self.limit if most.isdigit() else 1
        if excess > 0:  # the noted size may be too large: the files tell
            entries = sorted(self._entries())
            excess = sum(held for _, _, held in entries) + size - self.limit
            for used, path, held in entries:
                if excess <= 0 or time.time() - used < IN_USE_S:
                    break
                victims.append(path)
                excess -= held
        if excess > 0 or not all(map(_evict, victims)):
            return False
        os.pwrite(guard, b"%020d" % (self.limit + excess), 0)
        return True

    def _entries(self) -> list[tuple[float, Path, int]]:
        """Time of the last read, path and size of every shard and part; 0 for a time that is still to come."""
        entries = []
        with os.scandir(self.folder) as found:
            for file in found:
                match = _NAME.fullmatch(file.name)
                if match is not None:
                    with contextlib.suppress(FileNotFoundError):  # finished or evicted meanwhile
                        status = file.stat(follow_symlinks=False)
                        size = int(match[1]) if match[1] else status.st_size
                        used = status.st_mtime if status.st_mtime <= time.time() + IN_USE_S else 0.0
                        entries.append((used, Path(file.path), size))
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
        _release(handle)


def _release(handle: int) -> None:
    """Unlock and close: a process forked meanwhile holds the same lock, and closing alone would not release it."""
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


class CachedStore:
    """Store that downloads complete shards to the cache and reads their samples there.

    The first of the `records`, in stored order, that fit into the cache's limit are cached; samples of the others are
    read by byte range. The choice never changes, so no shard is downloaded again and again. A sample is read as soon as
    its bytes have come, before the rest of its shard.
    """

    def __init__(self, remote: RemoteFolder, records: Iterable[CheckedFile], cache: ShardCache) -> None:
        self.remote, self._cache = remote, cache
        self.name, self.read_file, self.size = remote.name, remote.read_file, remote.size
        self._records = {record.name: record for record in records}
        self._spoiled: set[str] = set()
        sizes = itertools.accumulate(record.size for record in self._records.values())
        self.to_cache = {name for name, size in zip(self._records, sizes, strict=True) if size <= cache.limit}
        """Names of the shards to keep whole."""

    def read(self, name: str, offset: int, length: int) -> bytes:
        record = self._records[name]
        data = self._from_cache(record, offset, length)
        if data is None and name in self.to_cache:
            TALLY.came(False)
            while (kept := self.keep(record)) is None:
                come = None if name in self._spoiled else self._cache.read(record, offset, length, part=True)
                if come is not None:
                    return come
                time.sleep(_POLL_S)
            data = self._from_cache(record, offset, length) if kept else None
        elif data is not None:
            TALLY.came(True)
        return self.remote.read(name, offset, length) if data is None else data

    def is_here(self) -> bool:
        """True if all shards are in the cache."""
        paths = map(self._cache.path, self._records.values())
        return len(self.to_cache) == len(self._records) and all(path.exists() for path in paths)

    def prepare_reread(self, name: str) -> bool:
        """See `Store.prepare_reread`. A cached shard with a wrong hash is removed, to be downloaded again.

        If its hash is right, the bytes that were read may be of its part, before the download began anew.
        """
        self._spoiled.add(name)  # its part is not read again
        path = self._cache.path(self._records[name])
        with contextlib.suppress(OSError), path.open("rb") as file:
            spoiled = hashlib.file_digest(file, "sha256").hexdigest() != self._records[name].sha256
            if spoiled and is_same_file(file.fileno(), path):  # else another process has replaced it meanwhile
                path.unlink(missing_ok=True)
        return True

    def _from_cache(self, record: CheckedFile, offset: int, length: int) -> bytes | None:
        try:
            return self._cache.read(record, offset, length)
        except OSError as error:
            self._disable_cache(error)
            return None

    def keep(self, record: CheckedFile, pause: Pause = time.sleep) -> bool | None:
        """Download the shard unless it is cached; False if it cannot be cached.

        None while another process or thread is downloading it. pause: see `RemoteFolder.fetch`. Raises Unreachable.
        """
        try:
            with self._cache.claim(record) as handle:
                if handle == BUSY:
                    return None
                if handle is not None:
                    self._fill(record, handle, pause)
            return self._cache.path(record).exists()
        except OSError as error:
            self._disable_cache(error)
            return False

    def _fill(self, record: CheckedFile, handle: int, pause: Pause) -> None:
        try:
            if self._fetch(record, handle, pause):
                self._cache.finish(record)
            else:
                # Its samples may be intact: each is checked when it is read.
                self.to_cache.discard(record.name)
                altered = f"{self.name}: {record.name}: altered (fetched {READ_ATTEMPTS} times)"
                warnings.warn(f"{altered}: this shard is not kept, but read by range", RuntimeWarning, stacklevel=2)
        except OSError:
            with contextlib.suppress(OSError):
                os.ftruncate(handle, 0)  # leave a full disk as it was
            raise

    def _fetch(self, record: CheckedFile, handle: int, pause: Pause) -> bool:
        """Continue the download of the part file, or begin it anew until its hash is right; False if it never is."""
        os.ftruncate(handle, min(os.fstat(handle).st_size, record.size))
        for _ in range(READ_ATTEMPTS):
            fetched = os.lseek(handle, 0, os.SEEK_END)
            with os.fdopen(handle, "wb", 8192, closefd=False) as file:  # a kill loses 8 kB at most
                self.remote.fetch(record.name, fetched, record.size, file.write, pause)
            with os.fdopen(handle, "rb", closefd=False) as file:
                file.seek(0)
                if hashlib.file_digest(file, "sha256").hexdigest() == record.sha256:
                    os.fsync(handle)
                    return True
            os.ftruncate(handle, 0)
        return False

    def _disable_cache(self, error: OSError) -> None:
        """Stop caching, with a warning: a full disk must not end a run, so shards are read by byte range."""
        self.to_cache.clear()
        what = f"{self._cache.folder}: {error.strerror or error}"
        warnings.warn(f"{what}: shards are no longer kept there, but read by range", RuntimeWarning, stacklevel=2)


def with_cache(store: Store, records: Iterable[CheckedFile], folder: str | Path | None, limit: int | None) -> Store:
    """Add a cache to a remote store; a local store, and any with `limit` 0, is returned unchanged.

    folder: default `cache_folder()`. limit: bytes, default DEFAULT_CACHE_BYTES. Raises BadConfig.
    """
    if not isinstance(store, RemoteFolder):
        if folder is not None or limit is not None:
            raise BadConfig(f"cache and cache_bytes are for remote sets, found them given for {store.name}")
        return store
    limit = DEFAULT_CACHE_BYTES if limit is None else check_int("cache_bytes", limit, 0)
    if limit == 0:
        return store
    cache = ShardCache(cache_folder() if folder is None else Path(folder), limit)
    advice = "give another cache, by XDG_CACHE_HOME, too, or cache_bytes=0 for none"
    with reported(f"{cache.folder}: the cache's folder cannot be written; {advice}", BadConfig, OSError):
        cache.folder.mkdir(parents=True, exist_ok=True)
        if not os.access(cache.folder, os.W_OK | os.X_OK):
            raise PermissionError("no permission")
    return CachedStore(store, records, cache)


def with_kept_index(manifest: Manifest, store: Store, folder: str | Path | None, limit: int | None) -> Manifest:
    """Return the manifest, read from `store`, its index, if any, kept in the cache as `with_cache`, or in memory."""
    if not isinstance(manifest.shards, IndexedShards):
        return manifest
    table, fields = manifest.shards.table, manifest.shards.fields
    kept, size = with_cache(store, [table], folder, limit), table.size
    if isinstance(kept, RemoteFolder) and size <= _LARGEST_HELD_INDEX:
        kept = HeldFile(store, size)
    return replace(manifest, shards=IndexedShards(table, fields, store, kept))
