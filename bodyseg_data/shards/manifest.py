"""The manifest: the index of a set of shards. It is written last, so a set that has one is complete."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

from bodyseg_data.core import BadConfig, BadShard
from bodyseg_data.files import write_atomically
from bodyseg_data.labels import LANDMARKS
from bodyseg_data.rigs import Rig, rig_from_json
from bodyseg_data.samples import Split
from bodyseg_data.shards.codecs import CODECS
from bodyseg_data.shards.index import INDEX_NAME, IndexedShards, ShardTable, table_from_json, write_index
from bodyseg_data.shards.records import ShardRecord, record_from_json, record_to_json
from bodyseg_data.shards.store import READ_ATTEMPTS, LocalFolder, Store, store_at

MANIFEST_NAME: Final = "manifest.json"
MANIFEST_FORMAT: Final = "bodyseg shards 5"

INDEXED_FORMAT: Final = "bodyseg shards 6"
"""Format of a manifest whose samples are in an index beside it. The shards are those of `MANIFEST_FORMAT`."""

INDEXED_FROM: Final = 1 << 18
"""Number of samples from which on a manifest is written with an index."""

_FIELDS: Final = {"format", "parts", "rig", "codec", "source", "renderer", "plan", "shards"}
LARGEST_MANIFEST: Final = 1 << 30
"""Largest manifest that is read, bytes."""


@dataclass(frozen=True)
class SkippedMesh:
    """Name of a mesh that the packing left out, and the reason in one line."""

    mesh: str
    why: str


@dataclass(frozen=True)
class Manifest:
    """Rig, codec, origin and shards of a set. plan: digest of all options of the packing. skipped: meshes that it left
    out.
    """

    rig: Rig
    codec: str
    source: str
    renderer: str
    plan: str
    shards: Sequence[ShardRecord]
    skipped: tuple[SkippedMesh, ...] = ()

    def __repr__(self) -> str:
        size = f"{self.samples()} samples in {len(self.shards)} shards"
        return f"Manifest({size}, codec={self.codec!r}, source={self.source!r}, renderer={self.renderer!r})"

    @property
    def format(self) -> str:
        """Format of the file."""
        return INDEXED_FORMAT if isinstance(self.shards, IndexedShards) else MANIFEST_FORMAT

    @property
    def index(self) -> ShardTable | None:
        """Table of the shards and of their pieces in the set's index; None for a set without one."""
        return self.shards.table if isinstance(self.shards, IndexedShards) else None

    def notes(self) -> list[str]:
        """Notes on meshes, in the order of the shards, and after them on those that were left out."""
        notes = [note for shard in self.shards for note in shard.notes]
        return notes + [f"{each.mesh}: skipped: {each.why}" for each in self.skipped]

    def samples(self, split: Split | None = None) -> int:
        """Number of samples, in one split or in all."""
        return sum(len(shard) for shard in self.shards if split in (None, shard.split))

    @property
    def digest(self) -> str:
        """SHA-256 of the content, in hexadecimal, as the file holds it; computed anew each time."""
        return str(self.to_json()["digest"])

    def to_json(self) -> dict[str, Any]:
        """Convert to a JSON object, with a digest of its other fields."""
        tree: dict[str, Any] = {
            "format": self.format,
            "parts": list(LANDMARKS),
            "rig": self.rig.to_json(),
            "codec": self.codec,
            "source": self.source,
            "renderer": self.renderer,
            "plan": self.plan,
            "shards": [record_to_json(each) for each in self.shards] if self.index is None else self.index.to_json(),
            **({"skipped": [asdict(each) for each in self.skipped]} if self.skipped else {}),
        }
        return {**tree, "digest": _digest(tree)}


def _digest(tree: dict[str, Any]) -> str:
    return hashlib.sha256(_compact(tree)).hexdigest()


def _compact(tree: dict[str, Any]) -> bytes:
    return json.dumps(tree, sort_keys=True, separators=(",", ":")).encode()


def write_manifest(manifest: Manifest, folder: Path) -> Manifest:
    """Write `folder`/manifest.json atomically, from `INDEXED_FROM` samples on with an index, and return it as written.

    Raises BadShard for a shard of too many samples.
    """
    if manifest.samples() >= INDEXED_FROM:
        table = write_index(manifest.shards, folder)
        manifest = replace(manifest, shards=IndexedShards(table, LocalFolder(folder)))
    else:
        manifest = replace(manifest, shards=tuple(manifest.shards))
    write_atomically(folder / MANIFEST_NAME, _compact(manifest.to_json()) + b"\n")
    if manifest.index is None:
        (folder / INDEX_NAME).unlink(missing_ok=True)  # of a set that was there before
    return manifest


def read_manifest(where: Path | Store) -> Manifest:
    """Read and check the manifest of a set. Raises BadShard, naming the file and the broken rule, or Unreachable.

    Of a set with an index, the shards' table is checked; the samples of a shard are when they are read.
    """
    store = store_at(where)
    path = f"{store.name}/{MANIFEST_NAME}"
    for attempt in range(1, READ_ATTEMPTS + 1):
        data = _contents(store, path)
        try:
            tree = _tree(data, path)
            del data  # a large one, no longer needed
            return _manifest(tree, path, store)
        except BadShard:
            if attempt == READ_ATTEMPTS or not store.prepare_reread(MANIFEST_NAME):
                raise
    raise AssertionError("the last attempt returns or raises")


def _contents(store: Store, path: str) -> bytes:
    try:
        data = store.read_file(MANIFEST_NAME, LARGEST_MANIFEST)
    except OSError as error:
        raise BadShard(f"{path} cannot be read: {error}") from error
    if data is None:
        raise BadShard(f"{store.name} holds no {MANIFEST_NAME}: not a set of shards, or its packing has not ended")
    return data


def _tree(data: bytes, path: str) -> dict[str, Any]:
    """Parse the file as JSON and check format and digest. Raises BadShard."""
    try:
        tree = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise BadShard(f"{path} cannot be read: {error}") from error
    if not isinstance(tree, dict) or tree.get("format") not in (MANIFEST_FORMAT, INDEXED_FORMAT):
        found = tree.get("format") if isinstance(tree, dict) else type(tree).__name__
        raise BadShard(f"{path}: 'format' must be {MANIFEST_FORMAT!r} or {INDEXED_FORMAT!r}, found {found!r}")
    stored = tree.pop("digest", None)
    if _is_as_written(data, stored):
        return tree
    try:
        computed = _digest(tree)
    except RecursionError as error:  # brackets nested as deeply as can just be read
        raise BadShard(f"{path} cannot be read: {error}") from error
    if stored != computed:
        raise BadShard(f"{path}: altered after it was written: stored digest {stored}, computed {computed}")
    return tree


def _is_as_written(data: bytes, stored: Any) -> bool:
    """Return whether `stored` is the digest of the file's own bytes without the digest: so of a file as it was written.

    Quicker than to write the content again, which only a file that somebody has formatted needs.
    """
    if not isinstance(stored, str) or not stored.isascii():
        return False
    field = f'"digest":"{stored}",'.encode()
    start = data.find(field)
    if start < 0:
        return False
    view = memoryview(data)
    rest = hashlib.sha256(view[:start])
    rest.update(view[start + len(field) : len(data) - data.endswith(b"\n")])
    return bool(rest.hexdigest() == stored)


def _manifest(tree: dict[str, Any], path: str, store: Store) -> Manifest:
    if tree.get("parts") != list(LANDMARKS):
        raise BadShard(f"{path}: 'parts' are not those of format {MANIFEST_FORMAT!r}")
    skipped = _skipped(tree.pop("skipped", []), path)
    if set(tree) != _FIELDS:
        raise BadShard(f"{path}: format {MANIFEST_FORMAT!r} has the fields {sorted(_FIELDS)}, found {sorted(tree)}")
    texts = {field: tree.get(field) for field in ("codec", "source", "renderer", "plan")}
    for field, value in texts.items():
        if not isinstance(value, str):
            raise BadShard(f"{path}: {field!r} must be text, found {value!r}")
    if texts["codec"] not in CODECS:
        raise BadShard(f"{path}: 'codec' must be one of {', '.join(CODECS)}, found {texts['codec']!r}")
    try:
        rig = rig_from_json(tree.get("rig"))
    except BadConfig as error:
        raise BadShard(f"{path}: {error}") from error
    indexed = tree["format"] == INDEXED_FORMAT
    shards = IndexedShards(table_from_json(tree["shards"], path), store) if indexed else _records(tree["shards"], path)
    return Manifest(rig=rig, shards=shards, skipped=skipped, **{field: str(value) for field, value in texts.items()})


def _records(trees: Any, path: str) -> tuple[ShardRecord, ...]:
    if not isinstance(trees, list) or not trees:
        raise BadShard(f"{path}: 'shards' must be a list of at least one")
    shards = tuple(record_from_json(record, path) for record in trees)
    keys = [key for shard in shards for key in shard.keys]
    if len(set(keys)) != len(keys) or len({shard.name for shard in shards}) != len(shards):
        raise BadShard(f"{path}: sample keys and shard names must be unique")
    return shards


def _skipped(entries: Any, path: str) -> tuple[SkippedMesh, ...]:
    if not isinstance(entries, list) or not all(
        isinstance(entry, dict)
        and set(entry) == {"mesh", "why"}
        and all(isinstance(text, str) and text.isprintable() for text in entry.values())
        for entry in entries
    ):
        raise BadShard(f"{path}: 'skipped' must be a list of meshes, each with its name and the reason")
    return tuple(SkippedMesh(**entry) for entry in entries)
