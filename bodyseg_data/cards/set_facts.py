"""Facts of a set that its cards tell, all counted from the manifest."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

from bodyseg_data.core.rig import Rig
from bodyseg_data.core.splits import SPLITS, Split
from bodyseg_data.shards.descriptions import BODY_FIELDS, VIEW_FIELDS
from bodyseg_data.shards.manifest import MANIFEST_FORMAT, Manifest, ShardRecord

_BODY = {name: column for column, name in enumerate(BODY_FIELDS)}


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

    digest: SHA-256 of the manifest's content, hexadecimal. sources: of the set and of its bodies, each once. splits:
    counts of those that hold samples. views: field of a view -> its lowest and highest value. notes: lines on meshes.
    """

    digest: str
    format: str
    codec: str
    renderer: str
    rig: Rig
    sources: tuple[str, ...]
    shards: tuple[ShardRecord, ...]
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
    bodies = {body for shard in manifest.shards for body in shard.descriptions.bodies}
    views = [view for shard in manifest.shards for view in shard.descriptions.views]
    columns = zip(VIEW_FIELDS, zip(*views, strict=True), strict=True)
    return SetFacts(
        digest=manifest.digest,
        format=MANIFEST_FORMAT,
        codec=manifest.codec,
        renderer=manifest.renderer,
        rig=manifest.rig,
        sources=tuple(dict.fromkeys([manifest.source, *sorted({body[_BODY["source"]] for body in bodies})])),
        shards=manifest.shards,
        splits={split: _counts(manifest, split) for split in SPLITS if manifest.samples(split)},
        views={name: (min(values), max(values)) for name, values in columns},
        notes=tuple(manifest.notes()),
    )


def _counts(manifest: Manifest, split: Split) -> SplitCounts:
    shards = [shard for shard in manifest.shards if shard.split == split]
    bodies = {body for shard in shards for body in shard.descriptions.bodies}
    by_subset: Counter[str] = Counter()
    for shard in shards:
        subsets = [body[_BODY["subset"]] for body in shard.descriptions.bodies]
        by_subset.update(subsets[row] for row in shard.descriptions.body)
    return SplitCounts(
        samples=manifest.samples(split),
        shards=len(shards),
        size=sum(shard.size for shard in shards),
        bodies=len(bodies),
        subjects=len({(body[_BODY["source"]], body[_BODY["subset"]], body[_BODY["subject"]]) for body in bodies}),
        samples_by_subset=dict(sorted(by_subset.items())),
    )
