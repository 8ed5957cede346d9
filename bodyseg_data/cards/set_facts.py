"""Facts of a set that its cards tell, all counted from the manifest."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from bodyseg_data.core.rig import Rig
from bodyseg_data.core.splits import SPLITS, Split
from bodyseg_data.shards.descriptions import BODY_FIELDS, VIEW_FIELDS
from bodyseg_data.shards.manifest import Manifest
from bodyseg_data.shards.records import CheckedFile, ShardRecord

_PERSON: Final = ("source", "subset", "subject")
_BODY: Final = {name: column for column, name in enumerate(BODY_FIELDS)}


@dataclass(frozen=True)
class SplitCounts:
    """Counts of one split. size: bytes of its shards. samples_by_subset: subset -> samples."""

    samples: int
    shards: int
    size: int
    bodies: int
    subjects: int
    samples_by_subset: Mapping[str, int]


@dataclass(frozen=True)
class SetFacts:
    """Facts of a set.

    digest: SHA-256 of the manifest's content, hexadecimal. sources: of the set and of its bodies, each once. index:
    file beside the manifest, None for a set without one. splits: counts of those that hold samples. views: field of a
    view -> its lowest and highest value. notes: lines on meshes.
    """

    digest: str
    format: str
    codec: str
    renderer: str
    rig: Rig
    sources: tuple[str, ...]
    shards: Sequence[ShardRecord]
    index: CheckedFile | None
    splits: Mapping[Split, SplitCounts]
    views: Mapping[str, tuple[int, int]]
    notes: tuple[str, ...]

    @property
    def samples(self) -> int:
        """Number of samples in all splits."""
        return sum(counts.samples for counts in self.splits.values())

    @property
    def size(self) -> int:
        """Bytes of all shards."""
        return sum(shard.size for shard in self.shards)

    @property
    def version(self) -> str:
        """Version in the form of Semantic Versioning: that of the format, and the first twelve digits of the digest."""
        return f"{self.format.rpartition(' ')[2]}.0.0+{self.digest[:12]}"


def set_facts(manifest: Manifest) -> SetFacts:
    """Count the facts of a set."""
    by_split = {split: [shard for shard in manifest.shards if shard.split == split] for split in SPLITS}
    sources: set[str] = set()
    views: set[tuple[int, ...]] = set()
    for shard in manifest.shards:
        sources.update(body[_BODY["source"]] for body in shard.descriptions.bodies)
        views.update(shard.descriptions.views)
    columns = zip(VIEW_FIELDS, zip(*views, strict=True), strict=True)
    return SetFacts(
        digest=manifest.digest,
        format=manifest.format,
        codec=manifest.codec,
        renderer=manifest.renderer,
        rig=manifest.rig,
        sources=tuple(dict.fromkeys([manifest.source, *sorted(sources)])),
        shards=manifest.shards,
        index=manifest.index,
        splits={split: _split_counts(shards) for split, shards in by_split.items() if any(map(len, shards))},
        views={name: (min(values), max(values)) for name, values in columns},
        notes=tuple(manifest.notes()),
    )


def _split_counts(shards: Sequence[ShardRecord]) -> SplitCounts:
    bodies = {body for shard in shards for body in shard.descriptions.bodies}
    by_subset: Counter[str] = Counter()
    for shard in shards:
        subsets = [body[_BODY["subset"]] for body in shard.descriptions.bodies]
        by_subset.update(subsets[row] for row in shard.descriptions.body)
    return SplitCounts(
        samples=sum(map(len, shards)),
        shards=len(shards),
        size=sum(shard.size for shard in shards),
        bodies=len(bodies),
        subjects=len({tuple(body[_BODY[name]] for name in _PERSON) for body in bodies}),
        samples_by_subset=dict(sorted(by_subset.items())),
    )
