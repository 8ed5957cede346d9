"""A remote set whose shards are kept on this machine as far as there is room."""

from __future__ import annotations

import contextlib
import hashlib
import os
import warnings
from collections.abc import Iterable
from pathlib import Path

from bodyseg_data.core.errors import BadConfig, BadShard
from bodyseg_data.shards.cache.folder import DEFAULT_CACHE_BYTES, ShardCache, default_folder, is_at
from bodyseg_data.shards.manifest import ShardRecord
from bodyseg_data.shards.stores.remote import RemoteFolder
from bodyseg_data.shards.stores.store import TIMES, Store
from bodyseg_data.shards.tar import check_bytes


class CachedStore:
    """Reads a shard's bytes from the cache if it is there, fetching it whole first if it is one of those to keep.

    The first of the `records`, in stored order, that the cache's limit has room for are kept; samples of the others are
    read by byte range. So what is kept never changes and nothing is fetched over and over.
    """

    def __init__(self, remote: RemoteFolder, records: Iterable[ShardRecord], cache: ShardCache) -> None:
        self._remote, self._cache = remote, cache
        self._records = {record.name: record for record in records}
        self._kept = set()
        room = cache.limit
        for record in self._records.values():
            room -= record.size
            if room < 0:
                break
            self._kept.add(record.name)

    @property
    def name(self) -> str:
        """The address."""
        return self._remote.name

    def read(self, name: str, offset: int, length: int) -> bytes:
        """See `Store.read`."""
        record = self._records[name]
        data = self._from_cache(record, offset, length)
        if data is None and name in self._kept and self._keep(record):
            data = self._from_cache(record, offset, length)
        return self._remote.read(name, offset, length) if data is None else data

    def whole(self, name: str, limit: int) -> bytes | None:
        """See `Store.whole`."""
        return self._remote.whole(name, limit)

    def size(self, name: str) -> int:
        """See `Store.size`."""
        return self._remote.size(name)

    def doubt(self, name: str) -> bool:
        """See `Store.doubt`. A shard in the cache that is not what it was is dropped, to be fetched anew."""
        path = self._cache.path(self._records[name])
        try:
            with path.open("rb") as file:
                spoiled = hashlib.file_digest(file, "sha256").hexdigest() != self._records[name].sha256
                if spoiled and is_at(file.fileno(), path):  # or another process has fetched it anew meanwhile
                    path.unlink(missing_ok=True)
        except OSError:
            return True
        return spoiled

    def _from_cache(self, record: ShardRecord, offset: int, length: int) -> bytes | None:
        try:
            return self._cache.read(record, offset, length)
        except OSError as error:
            self._give_up(error)
            return None

    def _keep(self, record: ShardRecord) -> bool:
        """Have the shard in the cache; False if that is not to be."""
        try:
            with self._cache.claim(record) as handle:
                if handle is not None:
                    self._fill(record, handle)
            return self._cache.path(record).exists()
        except OSError as error:
            self._give_up(error)
            return False

    def _fill(self, record: ShardRecord, handle: int) -> None:
        try:
            problem = self._fetch(record, handle)
            if problem is None:
                self._cache.finish(record)
            else:
                # Its other samples may be sound: each is judged when it is read.
                self._kept.discard(record.name)
                _warn(f"{self.name}: {problem} (fetched {TIMES} times): this shard is not kept, but read by range")
        except OSError:
            with contextlib.suppress(OSError):
                os.ftruncate(handle, 0)  # a full disk is left as it was
            raise

    def _fetch(self, record: ShardRecord, handle: int) -> str | None:
        """Fetch into the part file, from where it ends, until it is the whole shard; or say what is wrong with it."""
        problem = None
        os.ftruncate(handle, min(os.fstat(handle).st_size, record.size))
        for _ in range(TIMES):
            have = os.lseek(handle, 0, os.SEEK_END)
            with os.fdopen(handle, "wb", closefd=False) as file:
                self._remote.fetch(record.name, have, record.size, file.write)
            found = _find_altered(record, handle)
            if found is None:
                os.fsync(handle)
                return None
            sound, problem = found
            os.ftruncate(handle, sound)
        return problem

    def _give_up(self, error: OSError) -> None:
        """A run does not end because of a full disk: what cannot be kept is read by byte range."""
        self._kept.clear()
        _warn(f"{self._cache.folder}: {error.strerror or error}: shards are no longer kept there, but read by range")


def keep_shards(store: Store, records: Iterable[ShardRecord], folder: str | Path | None, limit: int | None) -> Store:
    """The same store with a cache, if it is a remote one and `limit` is not 0.

    folder: None is `default_folder()`. limit: bytes; None is DEFAULT_CACHE_BYTES. Raises BadConfig.
    """
    if not isinstance(store, RemoteFolder):
        if folder is not None or limit is not None:
            raise BadConfig(f"cache and cache_bytes are for remote sets, found them given for {store.name}")
        return store
    if limit is not None and (isinstance(limit, bool) or not isinstance(limit, int) or limit < 0):
        raise BadConfig(f"cache_bytes must be a whole number of bytes, 0 for no cache, found {limit!r}")
    if limit == 0:
        return store
    cache = ShardCache(default_folder() if folder is None else Path(folder), limit or DEFAULT_CACHE_BYTES)
    try:
        cache.folder.mkdir(parents=True, exist_ok=True)
        problem = None if os.access(cache.folder, os.W_OK | os.X_OK) else "cannot be written"
    except OSError as error:
        problem = error.strerror or str(error)
    if problem is not None:
        raise BadConfig(f"{cache.folder}: the cache's folder {problem}; give another cache, or cache_bytes=0 for none")
    return CachedStore(store, records, cache)


def _warn(text: str) -> None:
    warnings.warn(text, RuntimeWarning, stacklevel=3)


def _find_altered(record: ShardRecord, handle: int) -> tuple[int, str] | None:
    """Where the first bytes are that are not what was written, and what is wrong there; None if the hash is right."""
    with os.fdopen(handle, "rb", closefd=False) as file:
        file.seek(0)
        found = hashlib.file_digest(file, "sha256").hexdigest()
        if found == record.sha256:
            return None
        file.seek(0)
        for index, offset in enumerate(record.offsets):
            try:
                check_bytes(file.read(record.lengths[index]), record, index)
            except BadShard as error:
                return offset, str(error)
        return file.tell(), f"{record.name}: altered: SHA-256 {record.sha256} expected, found {found}"
