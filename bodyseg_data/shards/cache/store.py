"""Store of a remote set that caches shards on this machine as far as there is room."""

from __future__ import annotations

import contextlib
import hashlib
import os
import warnings
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from bodyseg_data.core.errors import BadConfig, BadShard
from bodyseg_data.shards.cache.folder import DEFAULT_CACHE_BYTES, ShardCache, default_folder, is_same_file
from bodyseg_data.shards.index import IndexedShards
from bodyseg_data.shards.manifest import Manifest
from bodyseg_data.shards.records import CheckedFile, check_bytes
from bodyseg_data.shards.stores.remote import RemoteFolder
from bodyseg_data.shards.stores.store import READ_ATTEMPTS, Store


class CachedStore:
    """Store that downloads complete shards to the cache and reads their samples there.

    The first of the `records`, in stored order, that fit into the cache's limit are cached; samples of the others are
    read by byte range. The choice never changes, so no shard is downloaded again and again.
    """

    def __init__(self, remote: RemoteFolder, records: Iterable[CheckedFile], cache: ShardCache) -> None:
        self._remote, self._cache = remote, cache
        self._records = {record.name: record for record in records}
        self._to_cache = set()
        room = cache.limit
        for record in self._records.values():
            room -= record.size
            if room < 0:
                break
            self._to_cache.add(record.name)

    @property
    def name(self) -> str:
        """The address, for messages."""
        return self._remote.name

    def read(self, name: str, offset: int, length: int) -> bytes:
        """See `Store.read`."""
        record = self._records[name]
        data = self._from_cache(record, offset, length)
        if data is None and name in self._to_cache and self._ensure_cached(record):
            data = self._from_cache(record, offset, length)
        return self._remote.read(name, offset, length) if data is None else data

    def read_file(self, name: str, limit: int) -> bytes | None:
        """See `Store.read_file`."""
        return self._remote.read_file(name, limit)

    def size(self, name: str) -> int:
        """See `Store.size`."""
        return self._remote.size(name)

    def prepare_reread(self, name: str) -> bool:
        """See `Store.prepare_reread`. A cached shard with a wrong hash is removed, to be downloaded again."""
        path = self._cache.path(self._records[name])
        try:
            with path.open("rb") as file:
                spoiled = hashlib.file_digest(file, "sha256").hexdigest() != self._records[name].sha256
                if spoiled and is_same_file(file.fileno(), path):  # else another process has replaced it meanwhile
                    path.unlink(missing_ok=True)
        except OSError:
            return True
        return spoiled

    def _from_cache(self, record: CheckedFile, offset: int, length: int) -> bytes | None:
        try:
            return self._cache.read(record, offset, length)
        except OSError as error:
            self._disable_cache(error)
            return None

    def _ensure_cached(self, record: CheckedFile) -> bool:
        """Download the shard unless it is cached; False if it cannot be cached."""
        try:
            with self._cache.claim(record) as handle:
                if handle is not None:
                    self._fill(record, handle)
            return self._cache.path(record).exists()
        except OSError as error:
            self._disable_cache(error)
            return False

    def _fill(self, record: CheckedFile, handle: int) -> None:
        try:
            problem = self._fetch(record, handle)
            if problem is None:
                self._cache.finish(record)
            else:
                # Its other samples may be intact: each is checked when it is read.
                self._to_cache.discard(record.name)
                _warn(
                    f"{self.name}: {problem} (fetched {READ_ATTEMPTS} times): this shard is not kept, but read by range"
                )
        except OSError:
            with contextlib.suppress(OSError):
                os.ftruncate(handle, 0)  # leave a full disk as it was
            raise

    def _fetch(self, record: CheckedFile, handle: int) -> str | None:
        """Continue the download of the part file until its hash is right; otherwise return the problem."""
        problem = None
        os.ftruncate(handle, min(os.fstat(handle).st_size, record.size))
        for _ in range(READ_ATTEMPTS):
            fetched = os.lseek(handle, 0, os.SEEK_END)
            with os.fdopen(handle, "wb", closefd=False) as file:
                self._remote.fetch(record.name, fetched, record.size, file.write)
            found = _find_altered(record, handle)
            if found is None:
                os.fsync(handle)
                return None
            sound, problem = found
            os.ftruncate(handle, sound)
        return problem

    def _disable_cache(self, error: OSError) -> None:
        """Stop caching, with a warning: a full disk must not end a run, so shards are read by byte range."""
        self._to_cache.clear()
        _warn(f"{self._cache.folder}: {error.strerror or error}: shards are no longer kept there, but read by range")


def with_cache(store: Store, records: Iterable[CheckedFile], folder: str | Path | None, limit: int | None) -> Store:
    """Add a cache to a remote store; a local store, and any with `limit` 0, is returned unchanged.

    folder: default `default_folder()`. limit: bytes, default DEFAULT_CACHE_BYTES. Raises BadConfig.
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


def with_kept_index(manifest: Manifest, store: Store, folder: str | Path | None, limit: int | None) -> Manifest:
    """Return the manifest, read from `store`, with its index, if it has one, kept in the cache as `with_cache`."""
    if not isinstance(manifest.shards, IndexedShards):
        return manifest
    kept = with_cache(store, [manifest.shards.table], folder, limit)
    return replace(manifest, shards=manifest.shards.kept_in(kept))


def _warn(text: str) -> None:
    warnings.warn(text, RuntimeWarning, stacklevel=3)


def _find_altered(record: CheckedFile, handle: int) -> tuple[int, str] | None:
    """Find the offset of the first altered bytes of a file and the problem; None if the hash is right."""
    with os.fdopen(handle, "rb", closefd=False) as file:
        file.seek(0)
        found = hashlib.file_digest(file, "sha256").hexdigest()
        if found == record.sha256:
            return None
        file.seek(0)
        for index in range(len(record)):
            _, offset, length, _ = record.entry(index)
            try:
                check_bytes(file.read(length), record, index)
            except BadShard as error:
                return offset, str(error)
        return file.tell(), f"{record.name}: altered: SHA-256 {record.sha256} expected, found {found}"
