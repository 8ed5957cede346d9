"""Made rooms as a set of shards: who is in them, and the writing.

Samples of a block share 20 people, drawn by its number: building them takes longer than a room. The process that needs
them first builds them and leaves them to the others in the state folder. The bytes are the same for any number.
"""

import fcntl
import itertools
from contextlib import suppress
from functools import lru_cache, partial
from io import BytesIO
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from bodyseg_data.bodies import BodyRef, BodySource, Units, UpAxis, open_source
from bodyseg_data.core import BadConfig, BadLandmarks, BadMesh, ProgressCallback, check_int, reported, silent
from bodyseg_data.files import write_atomically
from bodyseg_data.labels import PART_CLASSES
from bodyseg_data.meshes import Borders, Mesh, Partition, Solid
from bodyseg_data.packing import STATE_NAME, ShardWriter, in_poses, processes, reduced_body
from bodyseg_data.rigs import Rig, load_rig
from bodyseg_data.rooms.furnishings import FURNISHINGS
from bodyseg_data.rooms.scenes import Room, RoomPerson
from bodyseg_data.samples import Split
from bodyseg_data.shards import CodecName, Manifest, read_manifest, shard_name

_BLOCK: Final = 400
_PEOPLE: Final = 20
_SOURCES: Final[dict[Split, tuple[str, ...]]] = {
    "train": ("wide", "everyday", "candidates"),  # the third: for poses that one of the others has at most
    "test": ("open", "hard"),
}
_Who = tuple[Split, tuple[str, ...]]  # split and poses of people
_NAMES: Final = "words", "vertices", "faces", "labels", "distance", "shared faces", "distance there"
_OWN_M: Final = 0.05, 4.0  # least and greatest size of a user's thing
_OWN_FACES: Final = 300_000  # most triangles of a user's thing
_AT_ONCE: Final = 8  # blocks whose rooms are written in turns, so that as many processes build people


def chosen_kinds(only: tuple[str, ...], without: tuple[str, ...]) -> tuple[str, ...]:
    """Kinds of things for rooms: those named, all if none is, but not those left out. Raises BadConfig."""
    unknown = [kind for kind in (*only, *without) if kind not in FURNISHINGS]
    if unknown:
        raise BadConfig(f"things of rooms are of the kinds {', '.join(FURNISHINGS)}, found {unknown[0]!r}")
    found = tuple(kind for kind in FURNISHINGS if kind in (only or FURNISHINGS) and kind not in without)
    if not found:
        raise BadConfig("rooms need things of at least one kind, found none")
    return found


class OwnThings(NamedTuple):
    """A user's meshes as things of rooms. folder: of scenes, labelled or not. units, up: as of `open_source`."""

    folder: Path
    units: Units = "auto"
    up: UpAxis = "auto"

    def _scenes(self) -> Any:
        with reported("--scene", BadConfig):
            return open_source("labelled", self.folder, None, self.units, self.up)

    def digest(self) -> str:
        """Digest of the files. Raises as `surfaces`."""
        scenes = self._scenes()
        return str(scenes.fingerprint(scenes.bodies()))[:12]

    def surfaces(self) -> list[tuple[str, Solid]]:
        """Name and surface of each, its base on y = 0 around x = z = 0.

        Raises BadConfig for a folder without meshes; BadMesh, naming the file, for one that cannot be read, is smaller
        than 5 cm or larger than 4 m, or has more than 300 000 triangles.
        """
        scenes = self._scenes()
        found = []
        for body in scenes.bodies():
            mesh, file = scenes.surface(body), scenes.entry(body).path
            low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
            size_m, (least_m, most_m) = float((high - low).max()), _OWN_M
            if not least_m <= size_m <= most_m:
                rule = f"a thing of rooms must be {least_m:g} to {most_m:g} m large"
                raise BadMesh(f"{file}: {rule}, found {size_m:.4g} m; --units gives the unit of its file")
            if len(mesh.faces) > _OWN_FACES:
                raise BadMesh(f"{file}: a thing of rooms may have {_OWN_FACES} triangles, found {len(mesh.faces)}")
            base = (low + high) / 2 * (1, 0, 1) + low * (0, 1, 0)
            found.append((body.mesh, Solid(mesh.vertices - base, mesh.faces)))
        return found


def pack_rooms(
    out: Path,
    rig: Rig,
    samples: int,
    split: Split = "train",
    kinds: tuple[str, ...] = tuple(FURNISHINGS),
    own: OwnThings | None = None,
    poses: tuple[str, ...] = (),
    codec: CodecName = "bsi",
    shard_samples: int = 1080,
    workers: int | None = None,
    progress: ProgressCallback = silent,
) -> Manifest:
    """Pack made rooms into the folder `out` and return its manifest; carries on where an interrupted packing stopped.

    split: of all samples, with people of "wide" and "everyday", or for test of "open" and "hard"; the plane "person"
    numbers them from 1. own: further things. poses: shell patterns; if there are any, people are in poses that fit one.
    workers: processes, one a processor if None. Raises BadConfig, also where nobody has such a pose, as
    `OwnThings.surfaces`, and as `ShardWriter`; MissingLibrary without pymeshlab.
    """
    order = sorted(
        range(check_int("samples", samples, 1)),
        key=lambda room: (room // (_AT_ONCE * _BLOCK), room % _BLOCK, room // _BLOCK),
    )
    keys = {f"room-{split}-{room:06d}": room for room in order}
    lacking = ", ".join(kind for kind in FURNISHINGS if kind not in kinds)
    source = f"rooms without {lacking}" if lacking else "rooms"
    if poses:
        source += f", people in poses {' '.join(poses)}"
        people_of(split, poses)
    digest = "" if own is None else own.digest()
    if own is not None:
        _things_of(own, digest)  # read before anything is written
        source += f", with things of digest {digest}"
    with (
        processes(workers) as engine,
        ShardWriter(
            out,
            rig=rig,
            classes=PART_CLASSES,
            projector="exact",
            planes={"person": "uint8"},
            source=source,
            codec=codec,
            shard_samples=shard_samples,
            workers=engine.workers,
            executor=engine.executor,
            progress=lambda done, _: progress(done, samples),
        ) as writer,
    ):
        places = {key: shard_name(split, place // shard_samples) for place, key in enumerate(keys)}
        if any(places.get(key) != file.name for key, file in writer.finished().items()):
            raise BadConfig(f"{out} holds rooms of another number or split: choose another folder, or delete it")
        progress(sum(key in writer for key in keys), samples)
        new = {key: room for key, room in keys.items() if key not in writer}
        writer.write_all(
            new, partial(_made, rig, (split, poses), kinds, own and (own, digest), (out / STATE_NAME).absolute())
        )
    return read_manifest(out)


def _made(
    rig: Rig, who: _Who, kinds: tuple[str, ...], own: tuple[OwnThings, str] | None, state: Path, room: int
) -> dict[str, Any]:
    people, things = _shared_people(state, *who, room // _BLOCK), () if own is None else _things_of(*own)
    made = vars(Room(f"room-{who[0]}-{room:06d}", rig, people, kinds, own=things).render(who[0]))
    return {name: made[name] for name in made if name != "key"}


@lru_cache(1)
def _things_of(own: OwnThings, _digest: str) -> list[tuple[str, Solid]]:
    """The things of files with this digest, read once a process."""
    return own.surfaces()


@lru_cache(_AT_ONCE)
def _shared_people(state: Path, split: Split, poses: tuple[str, ...], block: int) -> list[RoomPerson]:
    path = state / f"people-{split}-{block:04d}"
    with path.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not path.exists():
            write_atomically(path, _arrays(draw_people(split, block, poses)))
    damaged = reported(f"{path} cannot be read: delete it", BadConfig, Exception)  # whatever a damaged zip raises
    with damaged, np.load(BytesIO(path.read_bytes()), allow_pickle=False) as held:
        return [_person(*(held[f"{number} {name}"] for name in _NAMES)) for number in range(len(held) // len(_NAMES))]


def _arrays(people: list[RoomPerson]) -> bytes:
    held: dict[str, Any] = {}
    for number, person in enumerate(people):
        mesh, parts = person.mesh, person.parts
        words = np.array([mesh.name, person.pose])
        arrays = words, mesh.vertices, mesh.faces, parts.labels, parts.distance, *vars(parts.borders).values()
        held |= {f"{number} {name}": array for name, array in zip(_NAMES, arrays, strict=True)}
    np.savez_compressed(file := BytesIO(), **held)
    return file.getvalue()


def _person(words: Any, vertices: Any, faces: Any, labels: Any, distance: Any, shared: Any, to: Any) -> RoomPerson:
    parts = Partition(labels, distance, Borders(shared, to))
    return RoomPerson(Mesh(str(words[0]), vertices, faces), parts, str(words[1]))


def people_of(split: Split, poses: tuple[str, ...]) -> list[tuple[BodySource, list[BodyRef]]]:
    """The sources of a split's people that have bodies in such poses, with these. Raises BadConfig if none has."""
    sources = [open_source(name) for name in _SOURCES[split]]
    listed = [[body for body in source.bodies() if body.split == split] for source in sources]
    chosen = {*in_poses([*itertools.chain(*listed)], poses, " or ".join(_SOURCES[split]))}
    kept = [[body for body in bodies if body in chosen] for bodies in listed]
    return [(source, bodies) for source, bodies in zip(sources, kept, strict=True) if bodies]


def draw_people(split: Split, block: int, poses: tuple[str, ...] = ()) -> list[RoomPerson]:
    """The people of a block of samples, with meshes reduced as for 1.5 m. poses, and errors: as of `pack_rooms`."""
    # Not of `Draws`: rooms of the sets that are there have these people.
    rng, rig = np.random.default_rng((7, block, split == "train")), load_rig()
    found: list[RoomPerson] = []
    listed = people_of(split, poses)
    while len(found) < _PEOPLE:
        source, bodies = listed[min(int(rng.random() < 0.4), len(listed) - 1)]  # of five, two are of the second source
        body = bodies[int(rng.integers(len(bodies)))]
        with suppress(BadMesh, BadLandmarks):  # another one is drawn
            built = reduced_body(source.build(body), 1.0, rig, 150, (0,), False)
            found.append(RoomPerson(built.mesh, built.partition(), body.pose))
    return found
