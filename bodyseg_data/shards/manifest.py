"""The manifest: the index of a set of shards. It is written last, so a set that has one is complete."""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from bodyseg_data.core.errors import BadConfig, BadSample, BadShard
from bodyseg_data.core.files import write_atomically
from bodyseg_data.core.parts import LANDMARKS
from bodyseg_data.core.rig import Rig, rig_from_json
from bodyseg_data.core.sample import check_key
from bodyseg_data.core.splits import SPLITS, Split
from bodyseg_data.shards.codecs import CODECS
from bodyseg_data.shards.descriptions import DESCRIPTION_FIELDS, Descriptions, descriptions_from_json
from bodyseg_data.shards.stores.store import READ_ATTEMPTS, Store, store_at

MANIFEST_NAME: Final = "manifest.json"
MANIFEST_FORMAT: Final = "bodyseg shards 5"

_FIELDS: Final = {"format", "parts", "rig", "codec", "source", "renderer", "plan", "shards"}
_COLUMNS: Final = ("keys", "offsets", "lengths", "crc32")
_RECORD_FIELDS: Final = {"samples", "name", "split", "size", "sha256", "notes", *_COLUMNS, *DESCRIPTION_FIELDS}
_SHARD_NAME = re.compile(r"[a-z]+-[0-9]{5}\.tar")
_SHA256 = re.compile(r"[0-9a-f]{64}")
_BLOCK: Final = 512
_LARGEST_SAMPLE: Final = 1 << 30
_LARGEST_SHARD: Final = 1 << 40
_LARGEST_MANIFEST: Final = 1 << 30


@dataclass(frozen=True)
class ShardRecord:
    """Index of one shard. keys, offsets, lengths and crc32 have one entry a sample, in stored order.

    size: of the file, bytes. sha256: of the file. keys: sample keys. offsets: of a sample's first tar header, bytes.
    lengths: from there to the end of the padding of its last member, bytes. crc32: of those bytes. notes: lines
    "MESH: NOTE" on meshes whose first view is in this shard, such as repairs and changes of method. descriptions: of
    the samples.
    """

    name: str
    split: Split
    size: int
    sha256: str
    keys: tuple[str, ...]
    offsets: tuple[int, ...]
    lengths: tuple[int, ...]
    crc32: tuple[int, ...]
    notes: tuple[str, ...]
    descriptions: Descriptions

    def __len__(self) -> int:
        return len(self.keys)

    def __repr__(self) -> str:
        return f"ShardRecord({self.name!r}, {len(self)} samples, {self.size} bytes)"


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
    shards: tuple[ShardRecord, ...]
    skipped: tuple[SkippedMesh, ...] = ()

    def __repr__(self) -> str:
        size = f"{self.samples()} samples in {len(self.shards)} shards"
        return f"Manifest({size}, codec={self.codec!r}, source={self.source!r}, renderer={self.renderer!r})"

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
            "format": MANIFEST_FORMAT,
            "parts": list(LANDMARKS),
            "rig": self.rig.to_json(),
            "codec": self.codec,
            "source": self.source,
            "renderer": self.renderer,
            "plan": self.plan,
            "shards": [record_to_json(shard) for shard in self.shards],
            **({"skipped": [asdict(each) for each in self.skipped]} if self.skipped else {}),
        }
        return {**tree, "digest": _digest(tree)}


def _digest(tree: dict[str, Any]) -> str:
    return hashlib.sha256(_compact(tree)).hexdigest()


def _compact(tree: dict[str, Any]) -> bytes:
    return json.dumps(tree, sort_keys=True, separators=(",", ":")).encode()


def record_to_json(record: ShardRecord) -> dict[str, Any]:
    """Convert a shard's record to a JSON object."""
    plain = {name: value for name, value in vars(record).items() if name != "descriptions"}
    return {"samples": len(record), **plain, **record.descriptions.to_json()}


def record_from_json(tree: Any, where: str) -> ShardRecord:
    """Parse and check a shard's record. Raises BadShard, naming `where` and the rule."""
    if not isinstance(tree, dict) or set(tree) != _RECORD_FIELDS:
        raise BadShard(f"{where}: a shard's record has not the fields of format {MANIFEST_FORMAT!r}")
    name = tree["name"]
    if not isinstance(name, str) or not _SHARD_NAME.fullmatch(name):
        raise BadShard(f"{where}: a shard's name must be like train-00000.tar, found {name!r}")
    where = f"{where}: {name}"
    if tree["split"] not in SPLITS or not name.startswith(f"{tree['split']}-"):
        raise BadShard(
            f"{where}: the split must be one of {', '.join(SPLITS)} and start the name, found {tree['split']!r}"
        )
    if not isinstance(tree["sha256"], str) or not _SHA256.fullmatch(tree["sha256"]):
        raise BadShard(f"{where}: 'sha256' must be 64 hexadecimal digits")
    for column in (*_COLUMNS, "body", "view"):
        values = tree[column]
        if not isinstance(values, list) or len(values) != tree["samples"]:
            raise BadShard(f"{where}: {column!r} must have one entry a sample")
        kind = str if column == "keys" else int
        if set(map(type, values)) - {kind}:
            raise BadShard(f"{where}: {column!r} must hold {kind.__name__} only")
    notes = tree["notes"]
    if not isinstance(notes, list) or not all(isinstance(note, str) and note.isprintable() for note in notes):
        raise BadShard(f"{where}: 'notes' must be a list of text that can be printed")
    if type(tree["size"]) is not int or not 0 <= tree["size"] <= _LARGEST_SHARD:
        raise BadShard(f"{where}: 'size' must be a number of bytes, at most {_LARGEST_SHARD}")
    if not tree["keys"]:
        raise BadShard(f"{where}: a shard holds at least one sample")
    end = 0
    for key, offset, length in zip(tree["keys"], tree["offsets"], tree["lengths"], strict=True):
        try:
            check_key(key)
        except BadSample as error:
            raise BadShard(f"{where}: {error}") from error
        if offset != end or not 0 < length <= _LARGEST_SAMPLE or length % _BLOCK:
            raise BadShard(
                f"{where}: {key}: samples must follow each other in whole blocks of {_BLOCK} bytes, each of at most "
                f"{_LARGEST_SAMPLE}"
            )
        end = offset + length
    if end > tree["size"]:
        raise BadShard(f"{where}: samples end at byte {end}, the shard at {tree['size']}")
    return ShardRecord(
        name=name,
        split=tree["split"],
        size=tree["size"],
        sha256=tree["sha256"],
        descriptions=descriptions_from_json(tree, where),
        **{column: tuple(tree[column]) for column in (*_COLUMNS, "notes")},
    )


def write_manifest(manifest: Manifest, folder: Path) -> None:
    """Write `folder`/manifest.json atomically."""
    write_atomically(folder / MANIFEST_NAME, _compact(manifest.to_json()) + b"\n")


def read_manifest(where: Path | Store) -> Manifest:
    """Read and check the manifest of a set. Raises BadShard, naming the file and the broken rule, or Unreachable."""
    store = store_at(where)
    path = f"{store.name}/{MANIFEST_NAME}"
    for attempt in range(1, READ_ATTEMPTS + 1):
        data = _contents(store, path)
        try:
            tree = _tree(data, path)
            del data  # a large one, no longer needed
            return _manifest(tree, path)
        except BadShard:
            if attempt == READ_ATTEMPTS or not store.prepare_reread(MANIFEST_NAME):
                raise
    raise AssertionError("the last attempt returns or raises")


def _contents(store: Store, path: str) -> bytes:
    try:
        data = store.read_file(MANIFEST_NAME, _LARGEST_MANIFEST)
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
    if not isinstance(tree, dict) or tree.get("format") != MANIFEST_FORMAT:
        found = tree.get("format") if isinstance(tree, dict) else type(tree).__name__
        raise BadShard(f"{path}: 'format' must be {MANIFEST_FORMAT!r}, found {found!r}")
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


def _manifest(tree: dict[str, Any], path: str) -> Manifest:
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
    if not isinstance(tree.get("shards"), list) or not tree["shards"]:
        raise BadShard(f"{path}: 'shards' must be a list of at least one")
    try:
        rig = rig_from_json(tree.get("rig"))
    except BadConfig as error:
        raise BadShard(f"{path}: {error}") from error
    shards = tuple(record_from_json(record, path) for record in tree["shards"])
    keys = [key for shard in shards for key in shard.keys]
    if len(set(keys)) != len(keys) or len({shard.name for shard in shards}) != len(shards):
        raise BadShard(f"{path}: sample keys and shard names must be unique")
    return Manifest(rig=rig, shards=shards, skipped=skipped, **{field: str(value) for field, value in texts.items()})


def _skipped(entries: Any, path: str) -> tuple[SkippedMesh, ...]:
    if not isinstance(entries, list) or not all(
        isinstance(entry, dict)
        and set(entry) == {"mesh", "why"}
        and all(isinstance(text, str) and text.isprintable() for text in entry.values())
        for entry in entries
    ):
        raise BadShard(f"{path}: 'skipped' must be a list of meshes, each with its name and the reason")
    return tuple(SkippedMesh(**entry) for entry in entries)
