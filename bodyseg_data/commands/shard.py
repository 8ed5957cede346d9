"""`bodyseg shard`: render bodies and pack them into shards."""

import json
import sys
import warnings
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

from bodyseg_data.artifacts import Augmentation, check_variant
from bodyseg_data.bodies import SOURCES, Units, UpAxis, check_source, collapsed
from bodyseg_data.commands.options import flag_of, option
from bodyseg_data.commands.progress import Progress
from bodyseg_data.core import BadConfig, BadMesh, check_int, one_line
from bodyseg_data.meshes import GeodesicMethod
from bodyseg_data.packing import (
    PROCESSES,
    STOP,
    FaultyMeshes,
    OnError,
    OnFaults,
    Packing,
    ThingsPlace,
    check_engine,
    open_engine,
    pack,
    pack_renders,
    plan,
)
from bodyseg_data.rendering import RendererName
from bodyseg_data.renders import LayoutName, open_renders
from bodyseg_data.rigs import PAPER, load_rig
from bodyseg_data.samples import SPLITS, Split, ViewGrid, parse_choice
from bodyseg_data.shards import CodecName, Manifest, ProjectorKind, ShardReader

EXAMPLE = "bodyseg shard --source open --meshes 40 --out shards"

RENDERS: Final = "renders"
"""The source of scenes that another program has rendered."""
ROOMS: Final = "rooms"
"""The source of made rooms with people."""

_OF_ALL: Final = ("source", "out", "codec", "shard_samples", "workers", "plan")
_TAKEN: Final = {
    RENDERS: ("path", "layout", "projector"),
    ROOMS: ("rig", "units", "up", "poses", "samples", "split", "kinds", "without", "scene"),
}
_ALSO: Final = ("path", "rig", "units", "up", "poses")  # options of `_TAKEN` that sources of bodies have, too
_WHY: Final = {
    RENDERS: "they are finished scenes, with rig and classes of their own",
    ROOMS: "all in them is drawn by their keys",
}


@dataclass(frozen=True)
class Options:
    source: str = option(
        f"a source of bodies ({', '.join(SOURCES)}, or one that an installed package adds), {RENDERS} (scenes rendered "
        f"elsewhere) or {ROOMS} (made rooms with people and furniture)"
    )
    path: Path | None = option("folder of the source's meshes or renders, for sources that read one", None)
    out: Path | None = option("folder for the shards; an interrupted packing carries on there where it stopped", None)
    layout: LayoutName | None = option(
        "layout of the folder (default: found from its files)", None, heading="Renders (--source renders)"
    )
    projector: ProjectorKind | None = option(
        "what to store of the projector's range (default: shadow: what its shadow needs, if there is any)", None
    )
    samples: int | None = option("number of rooms", None, heading="Rooms (--source rooms)")
    split: Split = option("split that all rooms, and the people in them, belong to", "train")
    kinds: tuple[str, ...] = option("kinds of things in the rooms (default: all)", ())
    without: tuple[str, ...] = option("kinds of things to leave out, and to test with later", ())
    scene: Path | None = option("folder of meshes of further things in the rooms, not bodies", None)
    landmarks: Path | None = option(
        "landmark file, or folder of them (default: those beside the meshes, or shipped)", None, heading="Meshes"
    )
    units: Units = option("unit of the mesh files", Packing.units)
    up: UpAxis = option("axis of the mesh files that points up; a negative one as --up=-y", Packing.up)
    poses: tuple[str, ...] = option("only bodies in these poses, such as lying* (default: all)", (), heading="Views")
    meshes: int | None = option("number of bodies, taken evenly from every subset (default: all)", None)
    views: int | None = option("number of views of each body (default: all combinations)", None)
    distances: tuple[int, ...] = option("distances from the camera, cm", ViewGrid.distances_cm)
    azimuths: int = option("number of directions around the body", ViewGrid.azimuths)
    azimuth_span: int = option("degrees that the azimuths cover", ViewGrid.span_deg)
    pitch: tuple[str, ...] = option(
        "degrees by which the camera, aimed at the body, looks up (negative: down, from above); "
        "or one range like -30..10, which each view draws from",
        ("0",),
    )
    roll: tuple[str, ...] = option("degrees by which the camera is turned clockwise, or one range", ("0",))
    height: tuple[str, ...] = option("cm by which the camera is then raised without turning, or one range", ("0",))
    rig: str = option("a rig that ships with the package, or a .toml file", PAPER, heading="Rendering")
    geodesics: GeodesicMethod = option("method of measuring distances along the surface", Packing.geodesics)
    tolerance_mm: float | None = option(
        "range error, mm, to which pymeshlab reduces meshes; 0 reduces none (default: as --pymeshlab says)",
        Packing.tolerance_mm,
    )
    pymeshlab: bool = option(
        "let pymeshlab (GPL-3.0) repair scans, and reduce meshes of 150 000 triangles and more to 0.2 mm", False
    )
    renderer: RendererName = option("renderer", Packing.renderer)
    things: ThingsPlace = option("draw furniture without labels around the bodies", Packing.things)
    template: bool = option("also pack the map of the body, the column 'template' (open sources)", False)
    codec: CodecName = option("codec of the stored images", Packing.codec, heading="Packing")
    shard_samples: int = option("samples a shard", Packing.shard_samples)
    engine: str = option("processes (of this machine), or dask://HOST:PORT of a running scheduler", PROCESSES)
    workers: int | None = option("rendering processes (default: one a processor, or all that the cluster has)", None)
    on_error: OnError = option("for meshes that cannot be packed: stop and name all, or skip them", OnFaults.on_error)
    skip_budget: float | None = option("the most meshes to skip: a number, or a share below 1", OnFaults.skip_budget)
    plan: bool = option("print the counts as JSON and render nothing", False)

    def packing(self) -> Packing:
        """Return the options as a `Packing`. Raises BadConfig."""
        pitch, roll, height = (parse_choice(getattr(self, at), f"--{at}") for at in ("pitch", "roll", "height"))
        views = ViewGrid(self.distances, self.azimuths, self.azimuth_span, self.views, pitch, roll, height)
        given: dict[str, Any] = {each.name: getattr(self, each.name) for each in fields(Packing)}
        path, landmarks = (each and each.absolute() for each in (self.path, self.landmarks))  # of this folder
        return Packing(**given | {"path": path, "landmarks": landmarks, "views": views, "rig": load_rig(self.rig)})


def run(options: Options) -> int:
    """Pack, or print the plan."""
    check_source(options.source, *_TAKEN)
    _refuse_foreign(options)
    if options.source == RENDERS:
        return _run_renders(options)
    if options.source == ROOMS:
        return _run_rooms(options)
    check_engine(options.engine)
    packing = options.packing()
    if options.plan:
        _warn_about_source(packing)
        sys.stdout.write(json.dumps(plan(packing), indent=2) + "\n")
        return 0
    out = _needed_out(options)
    if (options.on_error == "skip") != (options.skip_budget is not None):
        raise BadConfig("--on-error skip and --skip-budget, the most meshes to leave out or a share, belong together")
    on_faults = OnFaults(options.on_error, options.skip_budget)
    _warn_about_source(packing)

    def make(progress: Progress) -> Manifest:
        return pack_on(options.engine, options.workers, packing, out, progress, on_faults)

    try:
        _warn_about_empty(_said(options, "views", make), out)
        return 0
    except FaultyMeshes as error:
        sys.stderr.write("".join(f"{one_line(line)}\n" for line in error.lines()))
        hint = "--on-error skip --skip-budget N leaves them out"
        if options.on_error == "skip":
            hint = "--skip-budget says how many may be left out"
        raise BadMesh(f"{error.problem}, for the reasons above; {hint}") from error


def _said(options: Options, unit: str, make: Callable[[Progress], Manifest]) -> Manifest:
    """Make a set, showing progress, and say how large it is and what was left out; returns its manifest."""
    with Progress("packing", unit) as progress:
        manifest = make(progress)
    size = sum(shard.size for shard in manifest.shards)
    sys.stdout.write(
        f"{options.out}: {manifest.counts}, {size / 1e6:.1f} MB, {size / manifest.samples() / 1000:.1f} kB a sample\n"
    )
    sys.stderr.write("".join(f"skipped {mesh}: {why}\n" for mesh, why in manifest.skipped.items()))
    notes = [note for shard in manifest.shards for note in shard.notes]
    more = [f"and {len(notes) - 9} more notes, which bodyseg inspect --json has"] * (len(notes) > 9)
    sys.stderr.write("".join(f"{note}\n" for note in (*notes[:9], *more)))
    return manifest


def _refuse_foreign(options: Options) -> None:
    """Raise BadConfig for options of another kind of source."""
    source = options.source
    for each in fields(options):
        others = [other for other, names in _TAKEN.items() if each.name in names and each.name not in _ALSO]
        foreign = each.name not in (*_OF_ALL, *_TAKEN[source]) if source in _TAKEN else others
        if foreign and getattr(options, each.name) != each.default:
            why = _WHY[source] if source in _TAKEN else f"it is of {others[0]}"
            raise BadConfig(f"{flag_of(each)} does not go with --source {options.source}: {why}")


def _run_renders(options: Options) -> int:
    if options.path is None:
        raise BadConfig(f"--source {RENDERS} needs --path: the folder that holds the renders")
    source = open_renders(options.path, options.layout)
    keys = source.keys()
    splits = set(map(source.split, keys))
    if len(splits) == 1:
        sys.stderr.write(f"bodyseg shard: note: all {len(keys)} renders are of the split {splits.pop()}\n")
    if options.plan:
        counts: dict[str, Any] = {split: sum(source.split(key) == split for key in keys) for split in SPLITS}
        counts |= {"classes": source.classes.names, "rigs": len(source.rigs), "planes": dict(source.planes)}
        sys.stdout.write(json.dumps({"source": RENDERS, "views": len(keys), **counts}, indent=2) + "\n")
        return 0
    given = source, _needed_out(options), options.codec, options.projector, options.shard_samples, options.workers
    _said(options, "renders", lambda progress: pack_renders(*given, progress.update))
    return 0


def _run_rooms(options: Options) -> int:
    from bodyseg_data.rooms import OwnThings, chosen_kinds, pack_rooms, people_of  # needs numba, as rendering does

    if options.samples is None:
        raise BadConfig(f"--source {ROOMS} needs --samples: how many rooms")
    check_int("--samples", options.samples, 1)
    kinds = chosen_kinds(options.kinds, options.without)
    if options.scene is None and (options.units, options.up) != (Packing.units, Packing.up):
        raise BadConfig("--units and --up are those of the meshes of --scene, which is missing")
    own = None if options.scene is None else OwnThings(options.scene.absolute(), options.units, options.up)
    if options.plan:
        counts = {"source": ROOMS, "views": options.samples, options.split: options.samples, "kinds": kinds}
        counts |= {"people": sum(len(bodies) for _, bodies in people_of(options.split, options.poses))}
        counts |= {} if own is None else {"scene": [name for name, _ in own.surfaces()]}
        sys.stdout.write(json.dumps(counts, indent=2) + "\n")
        return 0
    given = _needed_out(options), load_rig(options.rig), options.samples, options.split, kinds, own, options.poses
    how = options.codec, options.shard_samples, options.workers
    _said(options, "rooms", lambda progress: pack_rooms(*given, *how, progress.update))
    return 0


def _needed_out(options: Options) -> Path:
    if options.out is None:
        raise BadConfig("--out is missing: the folder for the shards (or --plan to see the counts only)")
    return options.out


def _warn_about_source(packing: Packing) -> None:
    """Name meshes that are missing, and the split of all meshes of a source with files, if it has only one."""
    missing = packing.opened().missing()
    if missing:
        runs = collapsed(missing)
        more = f", and {len(runs) - 3} more such (--plan lists all)" if len(runs) > 3 else ""
        what = f"the source {packing.source} is not complete, {len(missing)} missing: {', '.join(runs[:3])}{more}"
        warnings.warn(what, stacklevel=2)
    bodies = packing.bodies()
    splits = sorted({body.split for body in bodies})
    if packing.path is not None and len(splits) == 1:
        (lacking,) = set(SPLITS) - set(splits)
        note = f"all {len(bodies)} meshes are of the split {splits[0]}, none is of {lacking}"
        sys.stderr.write(f"bodyseg shard: note: {note}\n")


def _warn_about_empty(manifest: Manifest, out: Path) -> None:
    """Warn where some of a set's images, evenly chosen, show nothing, as by a rig with a number in another unit."""
    places = [(number, index) for number, shard in enumerate(manifest.shards) for index in range(len(shard))]
    reader = ShardReader(out, manifest)
    few = [reader.read(*place) for place in places[:: -(-len(places) // 4)]]
    for variant, seen_by in (("none", "camera sees"), ("occ", "projector lights")):
        make = Augmentation(manifest.rig, check_variant(variant))
        if not any(make(sample).range.any() for sample in few):
            where = "are the rig's numbers, --distances and --height right?"
            warnings.warn(f"the {seen_by} nothing in {len(few)} images looked at: {where}", stacklevel=2)
            return


def pack_on(
    engine: str, workers: int | None, packing: Packing, out: Path, progress: Progress, on_faults: OnFaults = STOP
) -> Manifest:
    """Pack on an engine, showing progress, of the check first; see `open_engine` and `pack`."""

    def shown(title: str, unit: str, done: int, total: int) -> None:
        progress.begin(title, unit)
        progress.update(done, total)

    packed, checked = partial(shown, progress.title, progress.unit), partial(shown, "checking", "meshes")
    with open_engine(engine, workers, packing) as opened:
        return pack(packing, out, opened.executor, opened.workers, packed, replace(on_faults, progress=checked))
