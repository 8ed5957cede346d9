"""Made rooms as a set of shards: who is in them, and the writing.

Samples of a block share 20 people, drawn by the block's number: building them costs more than a room. The first process
that needs them builds them and leaves them in the state folder of the packing for the others.
"""

from __future__ import annotations

import fcntl
import pickle
import zlib
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from bodyseg_data.bodies import open_source
from bodyseg_data.core import BadConfig, BadLandmarks, BadMesh, ProgressCallback, silent
from bodyseg_data.files import write_atomically
from bodyseg_data.labels import PART_CLASSES
from bodyseg_data.packing import STATE_NAME, ShardWriter, processes, reduced_body
from bodyseg_data.rigs import Rig, load_rig
from bodyseg_data.rooms.furnishings import FURNISHINGS
from bodyseg_data.rooms.scenes import Person, Room
from bodyseg_data.samples import Split
from bodyseg_data.shards import CodecName, Manifest, read_manifest

_BLOCK: Final = 400
_PEOPLE: Final = 20
_SOURCES: Final[dict[Split, tuple[str, str]]] = {"train": ("wide", "everyday"), "test": ("open", "hard")}
_SECOND: Final = 0.4  # share of people of the second source
_WAVE: Final = 8
"""Blocks whose samples are written in turns, so that as many processes build people at once."""


@dataclass(frozen=True)
class RoomSet:
    """Made rooms. kinds: of things, names of `FURNISHINGS`, all if empty; without: of these none. samples: how many.

    split: of all of them, and of the people: of "wide" and "everyday", or of "open" and "hard". Raises BadConfig for a
    kind that is not there, for none, and for less than one sample.
    """

    rig: Rig
    samples: int
    split: Split = "train"
    kinds: tuple[str, ...] = ()
    without: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for kind in (*self.kinds, *self.without):
            if kind not in FURNISHINGS:
                raise BadConfig(f"rooms have things of the kinds {', '.join(FURNISHINGS)}, found {kind!r}")
        if not self.things():
            raise BadConfig("rooms need a kind of things, found none that is left")
        if self.samples < 1:
            raise BadConfig(f"a set needs at least one room, found {self.samples}")

    def things(self) -> list[str]:
        """The kinds of things, in the order of `FURNISHINGS`."""
        return [kind for kind in FURNISHINGS if kind in (self.kinds or FURNISHINGS) and kind not in self.without]

    def numbers(self) -> dict[str, int]:
        """Key -> number of all samples, in the order of writing."""
        wave = _WAVE * _BLOCK
        order = sorted(range(self.samples), key=lambda n: (n // wave, n % _BLOCK, n // _BLOCK))
        return {f"room-{self.split}-{number:06d}": number for number in order}


@dataclass(frozen=True)
class _Make:
    """Makes the arguments of `ShardWriter.write` but the key, in whichever process. state: folder for the people."""

    rooms: RoomSet
    state: Path

    def __call__(self, number: int) -> dict[str, Any]:
        rooms = self.rooms
        people = _shared_people(self.state, rooms.split, number // _BLOCK)
        render = Room(f"room-{rooms.split}-{number:06d}", rooms.rig, people, rooms.things()).render(rooms.split)
        made = dict(vars(render))
        del made["key"]
        return made


def pack_rooms(
    rooms: RoomSet,
    out: Path,
    codec: CodecName = "bsi",
    shard_samples: int = 1080,
    workers: int | None = None,
    progress: ProgressCallback = silent,
) -> Manifest:
    """Pack made rooms into the folder `out` and return its manifest; carries on where an interrupted packing stopped.

    The plane "person" numbers people from 1. codec, shard_samples: as of `ShardWriter`. workers: processes, one a
    processor if None. The bytes are the same for any number of them. Raises as `ShardWriter`.
    """
    keys = rooms.numbers()
    lacking = [kind for kind in FURNISHINGS if kind not in rooms.things()]
    source = f"rooms without {', '.join(lacking)}" if lacking else "rooms"
    with (
        processes(workers) as engine,
        ShardWriter(
            out,
            rig=rooms.rig,
            classes=PART_CLASSES,
            projector="exact",
            planes={"person": "uint8"},
            source=source,
            codec=codec,
            shard_samples=shard_samples,
            workers=engine.workers,
            executor=engine.executor,
            progress=lambda done, _: progress(done, len(keys)),
        ) as writer,
    ):
        progress(sum(key in writer for key in keys), len(keys))
        writer.write_all(keys, _Make(rooms, (out / STATE_NAME).absolute()))
    return read_manifest(out)


@lru_cache(_WAVE)
def _shared_people(state: Path, split: Split, block: int) -> list[Person]:
    """The people of a block, built by the first process that asks."""
    path = state / f"people-{split}-{block:04d}"
    with path.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not path.exists():
            write_atomically(path, zlib.compress(pickle.dumps(draw_people(split, block)), 1))
    found: list[Person] = pickle.loads(zlib.decompress(path.read_bytes()))
    return found


def draw_people(split: Split, block: int) -> list[Person]:
    """The people of a block of samples, with meshes reduced for a range of 1.5 m."""
    rng, found, rig = np.random.default_rng((7, block, split == "train")), [], load_rig()
    sources = [open_source(name) for name in _SOURCES[split]]
    listed = [[body for body in source.bodies() if body.split == split] for source in sources]
    while len(found) < _PEOPLE:
        which = int(rng.random() < _SECOND)
        body = listed[which][int(rng.integers(len(listed[which])))]
        try:
            built = reduced_body(sources[which].build(body), 1.0, rig, 150, (0,), False)
            found.append(Person(built.mesh, built.partition(), body.pose))
        except (BadMesh, BadLandmarks):
            continue  # another one is drawn
    return found
