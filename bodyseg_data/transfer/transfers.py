"""Transfer of a set or a network: what is already there is kept, all else is copied and checked, the index comes last.

A bundle is the files that are copied together, with their checksums. A target is a local folder, into which downloads
resume, or an address, to which files are uploaded.
"""

import contextlib
import fcntl
import hashlib
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from bodyseg_data.core import BadConfig, BadShard
from bodyseg_data.files import make_folder, naming, sync, write_atomically
from bodyseg_data.shards import (
    LARGEST_MANIFEST,
    MANIFEST_NAME,
    READ_ATTEMPTS,
    CheckedFile,
    LocalFolder,
    Manifest,
    RemoteFolder,
    Store,
    column_file,
    column_files,
    column_names,
    column_tar,
    open_file,
    read_manifest,
    read_optional,
)

CARD_NAMES: Final = ("croissant.json", "README.md")
"""Cards of a set, which are copied with it."""

_BLOCK_BYTES: Final = 4 << 20
_LARGEST_PAGE: Final = 1 << 24

Report = Callable[[int], None]
"""Receiver of numbers of bytes that have just been copied."""


@dataclass(frozen=True)
class SharedFile:
    """A file of a bundle. size: bytes. sha256: hexadecimal."""

    name: str
    size: int
    sha256: str


@dataclass(frozen=True)
class Bundle:
    """Files that are copied together.

    files: large ones. pages: small ones, name -> content. index, index_bytes: name and content of the file that names
    the others; it is written last, so that a copy which has it is whole. optional: pages of its kind, by name.
    """

    files: tuple[SharedFile, ...]
    index: str
    index_bytes: bytes
    pages: Mapping[str, bytes]
    optional: tuple[str, ...]

    @property
    def size(self) -> int:
        """Bytes of the large files."""
        return sum(file.size for file in self.files)


def set_bundle(store: Store) -> Bundle:
    """Return the bundle of a set: index, shards, columns, cards, manifest.

    Manifests are read once: the set may be replaced while it is copied. Raises as `read_manifest`, and as
    `column_files` for a column that is damaged or of another set.
    """
    read: list[bytes] = []
    manifest = read_manifest(store, read.append)
    tars, pages = column_files(store, manifest)
    return Bundle(
        tuple(SharedFile(file.name, file.size, file.sha256) for file in (*_large_files(manifest), *tars)),
        MANIFEST_NAME,
        read[-1],
        pages_of(store, CARD_NAMES) | pages,
        (column_file(), *CARD_NAMES),
    )


def _large_files(manifest: Manifest) -> Iterator[CheckedFile]:
    """Yield the index of a set that has one, and its shards."""
    yield from () if manifest.index is None else (manifest.index,)
    yield from manifest.shards


def read_page(store: Store, name: str) -> bytes:
    """Read a small file, of at most 16 MB. Raises BadShard if it is missing."""
    data = store.read_file(name, _LARGEST_PAGE)
    if data is None:
        raise BadShard(f"{store.name}/{name} is missing")
    return data


def pages_of(store: Store, names: tuple[str, ...]) -> dict[str, bytes]:
    """Read those of the small files `names`, of at most 16 MB each, that a store holds."""
    found = {name: read_optional(store, name, _LARGEST_PAGE) for name in names}
    return {name: data for name, data in found.items() if data is not None}


def superseded(store: Store, bundle: Bundle) -> list[str]:
    """Return names of files to remove, in order, of the set or network in `store` whose place a bundle takes."""
    # First the list of columns: if a transfer is interrupted, the columns that are left belong to no set.
    held = [*pages_of(store, bundle.optional), bundle.index]
    if bundle.index == MANIFEST_NAME:  # a set stays where a network is put beside it
        with contextlib.suppress(BadConfig, BadShard):  # of another format: what it holds is not known
            manifest = read_manifest(store)
            held += [file.name for file in _large_files(manifest)]
            for name in column_names(store):
                held += [column_file(name), *(column_tar(shard.name, name) for shard in manifest.shards)]
    kept = {*bundle.pages, *(file.name for file in bundle.files)}
    return [name for name in held if name not in kept]


def sha256_of(store: Store, name: str) -> str:
    """Read a file of a store and return its SHA-256, in hexadecimal. Raises OSError or Unreachable."""
    with open_file(store, name) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


class LocalTarget:
    """A local folder, made if it is missing. A file is called `.NAME.part` until it is complete and checked.

    Its methods raise OSError, its constructor BadConfig for a folder that cannot be made, or is the source itself.
    """

    def __init__(self, folder: Path, source: Store) -> None:
        self._folder, self._source = folder, source
        make_folder(folder)
        if isinstance(source, LocalFolder) and folder.samefile(source.name):
            raise BadConfig(f"{folder} cannot be copied to itself: choose another place")
        self.store: Store = LocalFolder(folder)

    def holds(self, file: SharedFile, sizes_only: bool) -> bool:
        """Return whether the target has a file of this size and, unless `sizes_only`, of this SHA-256."""
        path = self._folder / file.name
        if not path.is_file() or path.stat().st_size != file.size:
            return False
        return sizes_only or sha256_of(self.store, file.name) == file.sha256

    def holds_another(self, file: SharedFile) -> bool:
        """Return whether a file of this name that the target does not hold as it should be may be the user's own."""
        return (self._folder / file.name).exists()

    def check_room(self, files: Sequence[SharedFile]) -> None:
        """Raise BadConfig if the disk has no room for files, of the sizes that a server says."""
        parts = (self._part(file) for file in files)
        have = sum(part.lstat().st_size for part in parts if part.is_file())
        need, free = sum(file.size for file in files) - have, shutil.disk_usage(self._folder).free
        if need > free:
            raise BadConfig(f"{self._folder}: no space left: {need / 1e6:.1f} MB are needed, {free / 1e6:.1f} MB free")

    def _part(self, file: SharedFile) -> Path:
        return self._folder / f".{file.name}.part"

    def receive(self, file: SharedFile, report: Report, sizes_only: bool) -> None:
        """Copy a file after what an interrupted transfer left and check its SHA-256. Raises BadShard if it differs."""
        part = self._part(file)
        if part.is_symlink():
            part.unlink()  # not made by a transfer: writing would alter another file
        handle = os.open(part, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)
        with naming(part), os.fdopen(handle, "r+b") as held:
            try:
                fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if not os.path.samestat(part.lstat(), os.fstat(held.fileno())):
                    raise BlockingIOError
            except (BlockingIOError, FileNotFoundError):
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
                # The part that was there may be of another file, so the source may still be right.
                again, resumed = resumed > 0 or self._source.prepare_reread(file.name), 0
                if attempt == READ_ATTEMPTS or not again:
                    part.unlink()
                    raise BadShard(_altered(f"{self._source.name}/{file.name}", file, found))
            held.flush()
            os.fsync(held.fileno())
            part.replace(self._folder / file.name)
        sync(self._folder)

    def write(self, name: str, data: bytes) -> None:
        write_atomically(self._folder / name, data)

    def remove(self, name: str) -> None:
        (self._folder / name).unlink(missing_ok=True)


class RemoteTarget:
    """A folder at an address, filled from a local one. Files are sent whole, and again if one was interrupted.

    Its methods are those of `LocalTarget`, and raise Unreachable, too.
    """

    def __init__(self, remote: RemoteFolder, folder: Path) -> None:
        self._remote, self._folder, self.write, self.remove = remote, folder, remote.write, remote.remove
        self.store: Store = remote

    def holds(self, file: SharedFile, sizes_only: bool) -> bool:
        """See `LocalTarget.holds`; the bytes are read back from the address."""
        if self._remote.find_size(file.name) != file.size:
            return False
        return sizes_only or sha256_of(self._remote, file.name) == file.sha256

    def holds_another(self, file: SharedFile) -> bool:
        """See `LocalTarget.holds_another`; what an interrupted upload has left is none: it is shorter."""
        return (self._remote.find_size(file.name) or 0) >= file.size

    def receive(self, file: SharedFile, report: Report, sizes_only: bool) -> None:
        """See `LocalTarget.receive`: the local bytes are checked before, those at the address after."""
        path = self._folder / file.name
        found = sha256_of(LocalFolder(self._folder), file.name)
        if found != file.sha256:
            raise BadShard(_altered(str(path), file, found))
        self._remote.write(file.name, path)
        if not self.holds(file, sizes_only):
            self.remove(file.name)
            raise BadShard(f"{self._remote.name}/{file.name}: the bytes that arrived are not those that were sent")
        report(file.size)


Target = LocalTarget | RemoteTarget


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


@dataclass(frozen=True)
class Outcome:
    """Counts of a transfer's large files. copied_bytes: of those that were not there already."""

    files: int
    kept: int
    copied_bytes: int


def transfer(
    bundle: Bundle, target: Target, report: Callable[[int], None], replace: bool = False, sizes_only: bool = False
) -> Outcome:
    """Copy a bundle to a target. Interrupted at any point, it leaves a target that the same call completes.

    report: receives the bytes of the large files that are done so far. replace: a target that holds another bundle
    gets this one; its cards and its index are removed first, then all else that the new one has not. sizes_only: files
    at the target are compared by size alone.

    While files are missing or wrong the target has no index, so it is never read as whole. Raises BadConfig for a
    target that holds another bundle or page, or one without index that holds another file, without `replace`,
    BadShard for bytes that are not those of their checksum, OSError or Unreachable.
    """

    def refuse(others: Iterable[str]) -> None:
        for name in () if replace else others:
            raise BadConfig(f"{target.store.name} holds another {name}: choose another place, or --replace it")

    held = target.store.read_file(bundle.index, LARGEST_MANIFEST)
    other = held is not None and held != bundle.index_bytes
    refuse([bundle.index] if other else [])
    pages = bundle.pages.items()
    refuse(name for name, data in pages if read_optional(target.store, name, _LARGEST_PAGE) not in (None, data))
    done = 0
    missing = []
    for file in bundle.files:
        if target.holds(file, sizes_only):
            done += file.size
            report(done)
        else:
            missing.append(file)
    if isinstance(target, LocalTarget):
        target.check_room(missing)
    if other:
        outdated = superseded(target.store, bundle)
    else:
        outdated = [file.name for file in missing if target.holds_another(file)]
        refuse(outdated if held is None else [])
        # The index goes last: without one, wrong files would be taken for the user's own.
        outdated += [bundle.index] if held is not None and missing else []
        if replace and held is not None and isinstance(target, RemoteTarget):  # in a folder, columns may be its user's
            outdated += [name for name in superseded(target.store, bundle) if name != bundle.index]
    for name in outdated:
        target.remove(name)

    def add(copied: int) -> None:
        nonlocal done
        done += copied
        report(done)

    for file in missing:
        target.receive(file, add, sizes_only)
    for name, data in pages:
        target.write(name, data)
    if held != bundle.index_bytes or missing:
        target.write(bundle.index, bundle.index_bytes)
    return Outcome(len(bundle.files), len(bundle.files) - len(missing), sum(file.size for file in missing))
