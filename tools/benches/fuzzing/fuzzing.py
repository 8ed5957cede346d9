"""Readers fed with hostile inputs, each in bounded time and memory; run in a process of its own, which may die.

A reader may give something or raise the error that it declares; anything else is a fault. Input `number` of a target
is made from (seed, target, number), so every fault can be made again by `one_input`.
"""

from __future__ import annotations

import contextlib
import faulthandler
import hashlib
import json
import resource
import subprocess
import sys
import tempfile
import time
import tracemalloc
import warnings
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from benches.environment import child_environment
from benches.fuzzing.hostile import declared_bytes
from benches.fuzzing.hostile_files import KEY, MAKERS, column_set
from bodyseg_data.bodies.sources.labelled import LabelledScenes
from bodyseg_data.core import BadConfig, BadLandmarks, BadMesh, BadSample, BadShard, BodysegError
from bodyseg_data.machine.kernels import VARIABLE
from bodyseg_data.meshes import load_landmark_file, read_mesh
from bodyseg_data.renders import open_renders
from bodyseg_data.rigs import load_rig
from bodyseg_data.samples import Sample
from bodyseg_data.shards import (
    BODY_FIELDS,
    CODECS,
    MANIFEST_NAME,
    column_file,
    decode_sample,
    read_manifest,
    record_from_json,
)
from bodyseg_data.shards.columns import read_column
from bodyseg_data.shards.earlier import EARLIER_FIELDS, piece_as_current
from bodyseg_data.shards.index import Piece
from bodyseg_data.shards.tar import parse_members
from bodyseg_model.recordings import open_recording

SECONDS_EACH: Final = 2.0
"""The processor time that one input may take; the largest image allowed takes a second."""

WARMING: Final = 64
"""Inputs that a reader gets before any is measured."""

_HANG_S: Final = 60.0
_MEMORY: Final = 1 << 32  # that a process may allocate beyond what it has when it begins
_SLACK: Final = 4 << 20  # libraries' own, once
_TIMES_DECLARED: Final = 5  # the arrays themselves, what is unpacked for them, and steps between the two
_TIMES_INPUT: Final = 100  # an object of Python for a letter or two of JSON
_HEAD: Final = {"name": "train-00000.tar", "split": "train", "size": 20_480, "sha256": "0" * 64}


@dataclass(frozen=True)
class Target:
    """read: a reader, given an input and a folder to put files in. refuses: what it may raise, by its documentation."""

    read: Callable[[Any, Path], object]
    refuses: tuple[type[Exception], ...]


def _sample(members: Mapping[str, bytes], folder: Path) -> object:
    """Both ways of reading a sample; what they have in common must be the same."""
    whole, part = decode_sample(KEY, members), decode_sample(KEY, members, projector=False, planes=())
    for name in ("range", "labels", "faces_projector"):
        if not np.array_equal(getattr(whole, name), getattr(part, name)):
            raise AssertionError(f"{name} is another without the projector's range")
    return whole


def _piece(given: tuple[bool, bytes], folder: Path) -> object:
    """Every sample of a piece of an index, and the whole record."""
    earlier, data = given
    fields = EARLIER_FIELDS if earlier else BODY_FIELDS
    piece = Piece(piece_as_current(data, "here") if earlier else data, 3, "here")
    found = [piece.entry(index) for index in range(3)]
    record = record_from_json({**_HEAD, **piece.to_json()}, fields, "here")
    if [record.entry(index) for index in range(len(record))] != found:
        raise AssertionError("a sample is at another place by itself than in the record")
    return record


def _column(given: tuple[str, bytes], folder: Path) -> object:
    name, data = given
    (folder / column_file(name)).write_bytes(data)
    return read_column(folder, column_set(), name)


@contextlib.contextmanager
def _laid_out(given: Mapping[str, bytes], folder: Path) -> Iterator[Path]:
    """A folder of these files."""
    with tempfile.TemporaryDirectory(dir=folder) as name:
        for file, data in given.items():
            path = Path(name) / file
            path.parent.mkdir(exist_ok=True)
            path.write_bytes(data)
        yield Path(name)


def _scenes(given: Mapping[str, bytes], folder: Path) -> object:
    """Every scene of a folder, with its classes."""
    with _laid_out(given, folder) as path:
        source = LabelledScenes(path)
        return [source.build(body) for body in source.bodies()], source.classes


def _recording(given: tuple[str, bytes], folder: Path) -> object:
    """Every frame of a recording."""
    name, data = given
    (folder / name).write_bytes(data)
    return [frame.read() for frame in open_recording(folder / name)]


def _renders(given: Mapping[str, bytes], folder: Path) -> object:
    """Every render of a folder."""
    with _laid_out(given, folder) as path:
        source = open_renders(path)
        return [source.load(key) for key in source.keys()]  # noqa: SIM118  # no dictionary


def _from_file(name: str, reader: Callable[[Path], object]) -> Callable[[bytes, Path], object]:
    def read(data: bytes, folder: Path) -> object:
        path = folder / name
        path.write_bytes(data)
        return reader(path)

    return read


TARGETS: Final[dict[str, Target]] = {
    "bsi": Target(_sample, (BadSample,)),
    "png": Target(_sample, (BadSample,)),
    "sample": Target(_sample, (BadSample,)),
    "tar": Target(lambda data, _: parse_members(KEY, data), (BadSample,)),
    "manifest": Target(_from_file(MANIFEST_NAME, lambda path: read_manifest(path.parent)), (BadShard,)),
    "index": Target(_piece, (BadShard,)),
    "column": Target(_column, (BadShard,)),
    "renders": Target(_renders, (BadConfig, BadSample)),
    "rig": Target(_from_file("rig.toml", load_rig), (BadConfig,)),
    "landmarks": Target(_from_file("l.json", load_landmark_file), (BadLandmarks,)),
    "lnd": Target(_from_file("l.lnd", load_landmark_file), (BadLandmarks,)),
    "ply": Target(_from_file("m.ply", read_mesh), (BadMesh,)),
    "scenes": Target(_scenes, (BadConfig, BadMesh)),
    "recording": Target(_recording, (BadConfig,)),
}
"""Name -> reader."""


def one_input(target: str, seed: int, number: int) -> Any:
    """The input that a campaign of `seed` feeds to a target as input `number`."""
    return MAKERS[target](np.random.default_rng([seed, zlib.crc32(target.encode()), number]))


def _allowed(target: str, given: Any) -> int:
    """The memory that reading an input may take, by what it declares and how long it is."""
    name, data = given if isinstance(given, tuple) else ("", given)
    members = given if isinstance(given, Mapping) else {str(name): data}
    declared = sum(declared_bytes(name, data) for name, data in members.items() if name.endswith((*CODECS, "bsp")))
    return _TIMES_DECLARED * declared + _TIMES_INPUT * sum(map(len, members.values())) + _SLACK


def feed(target: str, seed: int, numbers: range, folder: Path) -> dict[str, Any]:
    """Feed some inputs to one reader in this process.

    Returns how many it read and refused, the longest time, the largest share of the allowed memory, a digest of what
    came out, and the faults.
    """
    its = TARGETS[target]
    counts = {"inputs": len(numbers), "read": 0, "refused": 0}
    worst_s = worst_share = 0.0
    faults: list[str] = []
    outcome = hashlib.sha256()
    _warm_up(target, seed, folder)
    tracemalloc.start()
    try:
        for number in numbers:
            given = one_input(target, seed, number)
            faulthandler.dump_traceback_later(_HANG_S, exit=True)
            tracemalloc.reset_peak()
            before, start = tracemalloc.get_traced_memory()[0], time.process_time()
            try:
                outcome.update(_seen(its.read(given, folder)))
                counts["read"] += 1
            except its.refuses as error:
                counts["refused"] += 1
                outcome.update(b"refused")
                if isinstance(error, BodysegError) and (len(str(error)) > 2000 or not str(error).isprintable()):
                    faults.append(f"input {number}: not one line to read: {str(error)[:120]!r}")
            except Exception as error:
                faults.append(f"input {number}: {type(error).__name__}: {str(error)[:200]}")
            seconds = time.process_time() - start
            share = (tracemalloc.get_traced_memory()[1] - before) / _allowed(target, given)
            faulthandler.cancel_dump_traceback_later()
            if seconds > SECONDS_EACH:
                faults.append(f"input {number}: took {seconds:.1f} s")
            if share > 1:
                faults.append(f"input {number}: took {share:.1f} times the memory allowed")
            worst_s, worst_share = max(worst_s, seconds), max(worst_share, share)
    finally:
        tracemalloc.stop()
    worst = {"longest_s": round(worst_s, 3), "memory_of_allowed": round(worst_share, 3)}
    return {**counts, **worst, "outcome": outcome.hexdigest(), "faults": faults}


def _warm_up(target: str, seed: int, folder: Path) -> None:
    """Import and compile what reading needs, which takes time and memory once; few inputs need some of the loops."""
    for number in range(WARMING):
        with contextlib.suppress(Exception):
            TARGETS[target].read(one_input(target, seed + 1, number), folder)


def _seen(given: object) -> bytes:
    """The pixels of a sample that was read."""
    if not isinstance(given, Sample):
        return b"read"
    images: list[NDArray[Any]] = [given.range, given.labels, given.faces_projector]
    images += [given.planes[name] for name in sorted(given.planes)]
    if given.projector_range is not None:
        images.append(given.projector_range)
    return b"".join(image.tobytes() for image in images)


def campaign(target: str, seed: int, numbers: range, kernels: str = "auto") -> dict[str, Any]:
    """`feed` in a process whose memory is limited; one that dies or hangs is a fault, with its last words."""
    words = [target, str(seed), str(numbers.start), str(numbers.stop)]
    command = [sys.executable, "-c", "from benches.fuzzing.fuzzing import child; child()", *words]
    environment = {**child_environment(), VARIABLE: kernels}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    if done.returncode:
        return {"inputs": len(numbers), "outcome": "", "faults": [f"status {done.returncode}: {done.stderr[-600:]}"]}
    figures: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return figures


def child() -> None:
    """The process that `campaign` starts."""
    target, seed, start, stop = sys.argv[1], *map(int, sys.argv[2:])
    faulthandler.enable()
    warnings.simplefilter("error")  # a warning is a surprise to the user, too
    with tempfile.TemporaryDirectory() as folder:
        _warm_up(target, seed, Path(folder))
        has = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (has + _MEMORY, has + _MEMORY))
        figures = feed(target, seed, range(start, stop), Path(folder))
    sys.stdout.write(json.dumps(figures) + "\n")
