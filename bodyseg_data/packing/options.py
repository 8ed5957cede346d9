"""The options of a packing, and the source that they open."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from functools import lru_cache
from pathlib import Path
from typing import Final

from bodyseg_data.bodies import SOURCES, BodyRef, BodySource, Units, UpAxis, collapsed, open_source
from bodyseg_data.core import BadConfig, BadSample, bounded, check_fields, reported
from bodyseg_data.labels import PART_CLASSES, Classes
from bodyseg_data.meshes import GeodesicMethod
from bodyseg_data.packing.sampler import body_key
from bodyseg_data.packing.things import ThingsPlace
from bodyseg_data.rendering import RendererName
from bodyseg_data.rigs import Rig, load_rig
from bodyseg_data.samples import SPLITS, View, ViewGrid, check_key
from bodyseg_data.shards import CodecName

PACKING_VERSION: Final = 3
"""Goes up with any change of code that changes a sample's bytes, so that no packing carries on across it."""


@dataclass(frozen=True)
class Packing:
    """The options of a packing. All of them shape the bytes of the set; the number of workers does not.

    source, path, landmarks, units, up: where bodies come from (`open_source`). poses: shell patterns; if there are any,
    a body's pose must match one. meshes: number of bodies, taken evenly from every subset; None for all.
    views: of each body. renderer, codec: by name. shard_samples: samples a shard.
    geodesics: how distances along the surface are measured. tolerance_mm: how coarse meshes may be (`reduced_body`).
    pymeshlab: for `open_source` and `reduced_body`. things: where they stand around bodies (docs/reference/things.md).
    template: also pack the map of the body, a column; the set's own bytes are the same without it.
    """

    source: str
    path: Path | None = None
    poses: tuple[str, ...] = ()
    meshes: int | None = bounded(None, 1)
    views: ViewGrid = field(default_factory=ViewGrid)
    rig: Rig = field(default_factory=load_rig)
    renderer: RendererName = "raster"
    codec: CodecName = "bsi"
    shard_samples: int = bounded(1080, 1)
    landmarks: Path | None = None
    units: Units = "auto"
    up: UpAxis = "auto"
    geodesics: GeodesicMethod = "exact"
    tolerance_mm: float | None = bounded(None, 0)
    pymeshlab: bool = False
    things: ThingsPlace = "none"
    template: bool = False

    def __post_init__(self) -> None:
        check_fields(self)
        if self.template and self.tolerance_mm:
            raise BadConfig(f"the map of the body needs whole meshes, found a tolerance of {self.tolerance_mm:g} mm")
        with reported(f"rig {self.rig.name}", BadConfig):
            self.rig.check_reach(max(self.views.distances_cm) / 100)

    def bodies(self) -> list[BodyRef]:
        """Return the bodies to pack, in the source's order. Raises BadConfig if two have one name, if a name cannot be
        in keys, if a split is unknown, if none has a pose that fits `poses`, if they are fewer than `meshes`, or if
        they have no map of the body.
        """
        if self.template and not getattr(self.opened(), "on_template", False):
            raise BadConfig(f"the map of the body needs bodies that are made, found the source {self.source!r}")
        bodies = self.opened().bodies()
        if len({body.mesh for body in bodies}) < len(bodies) or {body.split for body in bodies} - {*SPLITS}:
            raise BadConfig(f"source {self.source!r}: each body has a 'mesh' of its own, and the split train or test")
        with reported(f"source {self.source!r}", BadConfig, BadSample):  # here, not when the body's turn comes
            for body in bodies:
                check_key(body_key(self.source, body))
        if not bodies:
            raise BadConfig(f"the source {self.source!r} has no bodies")
        wanted = in_poses(bodies, self.poses, self.source)
        return evenly_sampled(wanted, self.meshes)

    def views_of(self, body: BodyRef) -> Iterator[View]:
        """The views of one body, in their order."""
        return self.views.of(body_key(self.source, body))

    def opened(self, plan: str = "") -> BodySource:
        """The source, opened once a process and, if it reads files, once a plan (its digest). Raises BadConfig."""
        if self.path is None and self.landmarks is None:
            return _source(SOURCES.get(self.source), self.source, self.units, self.up)
        return _read_source(self.source, self.path, self.landmarks, self.units, self.up, self.pymeshlab, plan)


def classes_from(source: BodySource) -> Classes:
    """Return the classes of a source's labels: the 33 parts, unless it has the attribute `classes`."""
    return getattr(source, "classes", PART_CLASSES)


def in_poses(bodies: Sequence[BodyRef], poses: Sequence[str], source: str) -> list[BodyRef]:
    """Return bodies whose pose fits a shell pattern, all without any. Raises BadConfig, with `source`, if none does."""
    wanted = [body for body in bodies if not poses or any(fnmatchcase(body.pose, each) for each in poses)]
    if not wanted:
        names = ", ".join(collapsed(sorted({body.pose for body in bodies})))
        raise BadConfig(f"no body of {source} has a pose like {' or '.join(poses)}; its poses: {names}")
    return wanted


def evenly_sampled(bodies: Sequence[BodyRef], count: int | None) -> list[BodyRef]:
    """`count` of `bodies` in their order, shared out evenly over subsets, and evenly spaced in each."""
    if count is None:
        return list(bodies)
    if count > len(bodies):
        raise BadConfig(f"{count} meshes asked for, the source has {len(bodies)}")
    groups: dict[str, list[BodyRef]] = {}
    for body in bodies:
        groups.setdefault(body.subset, []).append(body)
    in_turn = [name for turn in range(count) for name, group in groups.items() if turn < len(group)]
    shares = Counter(in_turn[:count])
    chosen = {
        group[(2 * index + 1) * len(group) // (2 * shares[name])].mesh
        for name, group in groups.items()
        for index in range(shares[name])
    }
    return [body for body in bodies if body.mesh in chosen]


@lru_cache(maxsize=4)
def _source(home: object, name: str, units: Units, up: UpAxis) -> BodySource:
    """Open a source once a process, as a body model takes seconds to load, and anew if `home`, its class, changes."""
    return open_source(name, None, None, units, up)


@lru_cache(maxsize=4)  # several packings may share a worker
def _read_source(
    name: str, path: Path | None, landmarks: Path | None, units: Units, up: UpAxis, pymeshlab: bool, plan: str
) -> BodySource:
    return open_source(name, path, landmarks, units, up, pymeshlab)


def forget_sources() -> None:
    """Close the sources that read files, which may have changed since; body models stay loaded."""
    _read_source.cache_clear()
