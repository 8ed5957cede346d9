"""The manifest: the index of a set of shards. It is written last, so a set that has one is complete."""

import hashlib
import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Literal, get_args

from bodyseg_data.core import BadConfig, BadSample, BadShard, check_choice, reported
from bodyseg_data.files import web_page, write_atomically
from bodyseg_data.labels import PART_CLASSES, Classes, classes_from_json
from bodyseg_data.rigs import Rig, rig_from_json
from bodyseg_data.samples import Sample, Split
from bodyseg_data.shards.codecs import CODECS
from bodyseg_data.shards.earlier import EARLIER_FORMATS, manifest_as_current
from bodyseg_data.shards.index import INDEX_NAME, IndexedShards, ShardTable, table_from_json, write_index
from bodyseg_data.shards.records import (
    BODY_FIELDS,
    Fields,
    ShardRecord,
    fields_from_json,
    record_from_json,
    record_to_json,
)
from bodyseg_data.shards.store import READ_ATTEMPTS, LocalFolder, Store, store_at

MANIFEST_NAME: Final = "manifest.json"
MANIFEST_FORMAT: Final = "bodyseg shards 7"

INDEXED_FROM: Final = 1 << 18
"""Number of samples from which on a manifest is written with an index."""

ProjectorKind = Literal["shadow", "exact", "none"]
PROJECTOR_KINDS: Final[tuple[ProjectorKind, ...]] = get_args(ProjectorKind)
"""What a set holds of the projector's range: as far as the shadow test needs it, all of it, or nothing."""

PLANE_KINDS: Final = ("uint8", "uint16")
"""Types of a sample's further planes."""

MOST_RIGS: Final = 4096
"""Largest number of rigs of a set."""

RIG_FIELD: Final = "rig"
"""Field of a sample's description that numbers its rig, in sets that have several."""

EXTERNAL: Final = "external"
"""The renderer of a set whose scenes were rendered elsewhere, with facing bits that came with them."""

FACING_FROM_RANGE: Final = f"{EXTERNAL}, facing from range images"
"""The same of a set whose facing bits were found from the range images (docs/how-to/writing_shards.md)."""

_FIELDS: Final = frozenset(
    ["format", "rigs", "classes", "fields", "projector", "planes", "codec", "source", "renderer", "plan", "shards"]
)
_PLANE: Final = re.compile(r"[a-z][a-z0-9_]{0,31}")
LARGEST_MANIFEST: Final = 1 << 30
"""Largest manifest that is read, bytes."""


@dataclass(frozen=True)
class Manifest:
    """Rigs, classes, codec, origin and shards of a set.

    rigs: of the set; a sample of one that has several says by its field `RIG_FIELD` which is its own. plan: digest of
    all options of the packing. skipped: meshes that it left out, name -> reason. classes: what labels mean. fields: of
    descriptions. projector: what is stored of the projector's range. planes: name -> type of further images of each
    sample. read_as: format of the file that was read, another than today's for a set packed before.
    """

    rigs: tuple[Rig, ...]
    codec: str
    source: str
    renderer: str
    plan: str
    shards: Sequence[ShardRecord]
    skipped: Mapping[str, str] = field(default_factory=dict)
    classes: Classes = PART_CLASSES
    fields: Fields = BODY_FIELDS
    projector: ProjectorKind = "shadow"
    planes: Mapping[str, str] = field(default_factory=dict)
    read_as: str = MANIFEST_FORMAT
    read_digest: str = field(default="", compare=False)

    @property
    def rig(self) -> Rig:
        """The first rig, of most sets the only one."""
        return self.rigs[0]

    def rig_of(self, sample: Sample) -> Rig:
        """The rig of a sample. Raises BadSample, naming the key, for a number that is none of the set's rigs."""
        if len(self.rigs) == 1:
            return self.rig
        number = sample.info.get(RIG_FIELD)
        if type(number) is not int or not 0 <= number < len(self.rigs):
            raise BadSample(f"{sample.key}: {RIG_FIELD!r} must be 0 to {len(self.rigs) - 1}, found {number!r}")
        return self.rigs[number]

    def __repr__(self) -> str:
        return f"Manifest({self.counts}, codec={self.codec!r}, source={self.source!r}, renderer={self.renderer!r})"

    @property
    def counts(self) -> str:
        """Its numbers of samples and shards in words."""
        samples, shards = self.samples(), len(self.shards)
        return f"{samples} sample{'s' * (samples != 1)} in {shards} shard{'s' * (shards != 1)}"

    @property
    def index(self) -> ShardTable | None:
        """Table of the shards and of their pieces in the set's index; None for a set without one."""
        return self.shards.table if isinstance(self.shards, IndexedShards) else None

    def notes(self) -> list[str]:
        """Notes on meshes, in the order of the shards, and after them on those that were left out."""
        notes = [note for shard in self.shards for note in shard.notes]
        return notes + [f"{mesh}: skipped: {why}" for mesh, why in self.skipped.items()]

    def samples(self, split: Split | None = None) -> int:
        """Number of samples, in one split or in all."""
        return sum(len(shard) for shard in self.shards if split in (None, shard.split))

    @property
    def digest(self) -> str:
        """SHA-256 of the content, in hexadecimal, as the file holds it; computed anew for one that was not read."""
        return self.read_digest or str(self.to_json()["digest"])

    def to_json(self) -> dict[str, Any]:
        """Convert to a JSON object of today's format, with a digest of its other fields."""
        skipped = [{"mesh": mesh, "why": why} for mesh, why in self.skipped.items()]
        tree: dict[str, Any] = {
            "format": MANIFEST_FORMAT,
            "rigs": [rig.to_json() for rig in self.rigs],
            "classes": self.classes.to_json(),
            "fields": self.fields.to_json(),
            "projector": self.projector,
            "planes": dict(self.planes),
            "codec": self.codec,
            "source": self.source,
            "renderer": self.renderer,
            "plan": self.plan,
            "shards": [record_to_json(each) for each in self.shards] if self.index is None else self.index.to_json(),
            **({"skipped": skipped} if skipped else {}),
        }
        return {**tree, "digest": _digest(tree)}


def _digest(tree: dict[str, Any]) -> str:
    return hashlib.sha256(_compact(tree)).hexdigest()


def _compact(tree: dict[str, Any]) -> bytes:
    return json.dumps(tree, sort_keys=True, separators=(",", ":")).encode()


def manifest_bytes(manifest: Manifest) -> bytes:
    """The content of a manifest's file."""
    return _compact(manifest.to_json()) + b"\n"


def write_manifest(manifest: Manifest, folder: Path) -> Manifest:
    """Write `folder`/manifest.json atomically, from `INDEXED_FROM` samples on with an index, and return it as written.

    Raises BadShard for a shard of too many samples.
    """
    manifest = replace(manifest, read_as=MANIFEST_FORMAT, read_digest="")
    if manifest.samples() >= INDEXED_FROM:
        table = write_index(manifest.shards, folder)
        manifest = replace(manifest, shards=IndexedShards(table, manifest.fields, LocalFolder(folder)))
    else:
        manifest = replace(manifest, shards=tuple(manifest.shards))
    write_atomically(folder / MANIFEST_NAME, manifest_bytes(manifest))
    if manifest.index is None:
        (folder / INDEX_NAME).unlink(missing_ok=True)  # an earlier set's
    return manifest


def read_manifest(
    where: Path | Store, keep: Callable[[bytes], object] | None = None, name: str = MANIFEST_NAME
) -> Manifest:
    """Read and check the manifest of a set. Raises BadShard, naming the file and the broken rule, or Unreachable.

    Of a set with an index, the shards' table is checked; the samples of a shard are when they are read. keep: is called
    with the file's bytes, and again if they are read again. name: of the file, another for a column of the set.
    """
    store = store_at(where)
    path = f"{store.name}/{name}"
    for attempt in range(1, READ_ATTEMPTS + 1):
        data = _contents(store, name)
        if keep is not None:
            keep(data)
        try:
            tree = _tree(data, path)
            del data  # a large one, no longer needed
            return _manifest(tree, path, store)
        except BadShard:
            if attempt == READ_ATTEMPTS or not store.prepare_reread(name):
                raise
    raise AssertionError("the last attempt returns or raises")


def _contents(store: Store, name: str) -> bytes:
    with reported(f"{store.name}/{name} cannot be read", BadShard, OSError):
        data = store.read_file(name, LARGEST_MANIFEST)
    if data is None:
        hint = "not a set of shards, or its packing has not ended" if name == MANIFEST_NAME else "no such column"
        raise BadShard(f"{store.name} holds no {name}: {hint}")
    return data


def _tree(data: bytes, path: str) -> dict[str, Any]:
    """Parse the file as JSON and check format and digest, which stays in it. Raises BadShard."""
    try:
        tree = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise BadShard(f"{path} cannot be read: {web_page(data) or error}") from error
    if not isinstance(tree, dict) or tree.get("format") not in (MANIFEST_FORMAT, *EARLIER_FORMATS):
        found = tree.get("format") if isinstance(tree, dict) else type(tree).__name__
        known = ", ".join(map(repr, (*EARLIER_FORMATS, MANIFEST_FORMAT)))
        raise BadShard(f"{path}: 'format' must be one of {known}, found {found!r}")
    stored = tree.pop("digest", None)
    with reported(f"{path} cannot be read", BadShard, RecursionError):  # brackets nested too deeply to write
        computed = _digest(tree)
    if stored != computed:
        raise BadShard(f"{path}: altered after it was written: stored digest {stored}, computed {computed}")
    return {**tree, "digest": stored}


def _manifest(tree: dict[str, Any], path: str, store: Store) -> Manifest:
    digest, read_as = str(tree.pop("digest")), str(tree["format"])
    skipped = _skipped(tree.pop("skipped", []), path)
    if read_as in EARLIER_FORMATS:
        tree = manifest_as_current(tree, path)
    if set(tree) != _FIELDS:
        raise BadShard(f"{path}: format {MANIFEST_FORMAT!r} has the fields {sorted(_FIELDS)}, found {sorted(tree)}")
    texts = {name: tree[name] for name in ("codec", "source", "renderer", "plan")}
    for name, value in texts.items():
        if not isinstance(value, str):
            raise BadShard(f"{path}: {name!r} must be text, found {value!r}")
    for name, known in (("codec", tuple(CODECS)), ("projector", PROJECTOR_KINDS)):
        check_choice(f"{path}: {name!r}", tree[name], known, BadShard)
    with reported("", BadShard, BadConfig):
        rigs, classes = _rigs(tree["rigs"], path), classes_from_json(tree["classes"], path)
    fields = fields_from_json(tree["fields"], path)
    if len(rigs) > 1 and fields.kinds.get(RIG_FIELD) != "int":
        raise BadShard(f"{path}: a set with {len(rigs)} rigs must have the field {RIG_FIELD!r}, a whole number")
    shards: Sequence[ShardRecord]
    if isinstance(tree["shards"], dict):
        shards = IndexedShards(table_from_json(tree["shards"], path), fields, store)
    else:
        shards = _records(tree["shards"], fields, path)
    return Manifest(
        rigs=rigs,
        classes=classes,
        fields=fields,
        projector=tree["projector"],
        planes=_planes(tree["planes"], path),
        shards=shards,
        skipped=skipped,
        read_as=read_as,
        read_digest=digest,
        **texts,
    )


def _rigs(trees: Any, path: str) -> tuple[Rig, ...]:
    if not isinstance(trees, list) or not 0 < len(trees) <= MOST_RIGS:
        raise BadShard(f"{path}: 'rigs' must be a list of 1 to {MOST_RIGS}")
    with reported(path, BadShard, BadConfig):
        rigs = tuple(map(rig_from_json, trees))
    check_rigs(rigs, path)
    return rigs


def check_rigs(rigs: Sequence[Rig], where: str) -> None:
    """Raise BadShard unless rigs can be of one set: not too many, images of one size, steps of range of one length."""
    if len(rigs) > MOST_RIGS:
        raise BadShard(f"{where}: a set has at most {MOST_RIGS} rigs")
    first = rigs[0]
    for rig in rigs[1:]:
        same = (rig.camera.rows, rig.camera.columns) == (first.camera.rows, first.camera.columns)
        same &= len(rig.projectors) == len(first.projectors)
        if not same or rig.projector_shape != first.projector_shape or rig.range_step_m != first.range_step_m:
            rule = "the rigs of a set have images of one size and one 'range_step_m'"
            raise BadShard(f"{where}: {rule}, found {rig.name!r} beside {first.name!r}")


def _planes(tree: Any, path: str) -> dict[str, str]:
    if not isinstance(tree, dict):
        raise BadShard(f"{path}: 'planes' must be an object, found {type(tree).__name__}")
    for name, kind in tree.items():
        check_plane(name, kind, path)
    return dict(tree)


def check_plane(name: Any, kind: Any, where: str) -> None:
    """Raise BadShard, naming `where`, unless a sample may have a further image of this name and type."""
    taken = ("range", "labels", "projector", "facing")
    if not isinstance(name, str) or not _PLANE.fullmatch(name) or name in taken:
        raise BadShard(f"{where}: a plane has a lower-case name like 'instances', none of {taken}, found {name!r}")
    if kind not in PLANE_KINDS:
        raise BadShard(f"{where}: the plane {name!r} must be of the type {' or '.join(PLANE_KINDS)}, found {kind!r}")


def _records(trees: Any, fields: Fields, path: str) -> tuple[ShardRecord, ...]:
    if not isinstance(trees, list) or not trees:
        raise BadShard(f"{path}: 'shards' must be a list of at least one")
    shards = tuple(record_from_json(record, fields, path) for record in trees)
    keys = [key for shard in shards for key in shard.keys]
    if len(set(keys)) != len(keys) or len({shard.name for shard in shards}) != len(shards):
        raise BadShard(f"{path}: sample keys and shard names must be unique")
    return shards


def _skipped(entries: Any, path: str) -> dict[str, str]:
    if not isinstance(entries, list) or not all(
        isinstance(entry, dict)
        and set(entry) == {"mesh", "why"}
        and all(isinstance(text, str) and text.isprintable() for text in entry.values())
        for entry in entries
    ):
        raise BadShard(f"{path}: 'skipped' must be a list of meshes, each with its name and the reason")
    return {entry["mesh"]: entry["why"] for entry in entries}
