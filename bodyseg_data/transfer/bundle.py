"""Bundles: the files of a set or a network that are copied together, with their checksums."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from bodyseg_data.cards.stale import CARD_NAMES
from bodyseg_data.core.errors import BadShard
from bodyseg_data.shards.manifest import LARGEST_MANIFEST, MANIFEST_NAME, Manifest, read_manifest
from bodyseg_data.shards.records import CheckedFile
from bodyseg_data.shards.stores.store import Store, open_file


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
    the others; it is written last, so that a copy which has it is whole.
    """

    files: tuple[SharedFile, ...]
    index: str
    index_bytes: bytes
    pages: Mapping[str, bytes] = field(default_factory=dict)

    @property
    def size(self) -> int:
        """Bytes of the large files."""
        return sum(file.size for file in self.files)

    @property
    def names(self) -> set[str]:
        """Names of all files."""
        return {self.index, *self.pages, *(file.name for file in self.files)}


def set_bundle(store: Store) -> Bundle:
    """Return the bundle of a set: index, shards, cards, manifest. Raises as `read_manifest`."""
    manifest = read_manifest(store)
    return Bundle(
        tuple(SharedFile(file.name, file.size, file.sha256) for file in _large_files(manifest)),
        MANIFEST_NAME,
        read_page(store, MANIFEST_NAME),
        pages_of(store, CARD_NAMES),
    )


def _large_files(manifest: Manifest) -> Iterator[CheckedFile]:
    """Yield the index of a set that has one, and its shards."""
    yield from () if manifest.index is None else (manifest.index,)
    yield from manifest.shards


def read_page(store: Store, name: str) -> bytes:
    """Read a small file. Raises BadShard if it is missing."""
    data = store.read_file(name, LARGEST_MANIFEST)
    if data is None:
        raise BadShard(f"{store.name}/{name} is missing")
    return data


def pages_of(store: Store, names: tuple[str, ...]) -> dict[str, bytes]:
    """Read those of the small files `names` that a store holds."""
    found = {name: store.read_file(name, LARGEST_MANIFEST) for name in names}
    return {name: data for name, data in found.items() if data is not None}


def superseded(store: Store, bundle: Bundle) -> list[str]:
    """Return names of files of the set in `store` that a bundle which takes its place has not."""
    try:
        held = [file.name for file in _large_files(read_manifest(store))]
    except BadShard:  # a network, or a set of another format: what it holds is not known
        held = []
    cards = pages_of(store, CARD_NAMES) if bundle.index == MANIFEST_NAME else {}
    return [name for name in (*held, *cards) if name not in bundle.names]


def sha256_of(store: Store, name: str) -> str:
    """Read a file of a store and return its SHA-256, in hexadecimal. Raises OSError or Unreachable."""
    with open_file(store, name) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
