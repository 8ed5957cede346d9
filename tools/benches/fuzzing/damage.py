"""Sets of shards damaged in every way that disks, networks and people damage files, and the readers that detect it.

Three readers are tried each time: random access (`RangeImages`), the WebDataset pipeline, and `bodyseg verify`. A
reader may refuse; it may never give other pixels than were packed, and verify has to report every damage.
"""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.random import Generator

from benches.fuzzing.hostile import one_of
from bodyseg_data.core import BadShard, BodysegError
from bodyseg_data.loading import RangeImages
from bodyseg_data.shards import MANIFEST_NAME, LocalFolder, ShardRecord, find_faults, read_manifest

BLOCK: Final = 512


@dataclass
class Tally:
    """Counts of damages done and of refusals by each reader, and the faults found."""

    damages: int = 0
    reported_by_verify: int = 0
    refused_by_access: int = 0
    refused_by_pipeline: int = 0
    samples_given: int = 0
    faults: list[str] = field(default_factory=list)

    def figures(self) -> dict[str, Any]:
        """The counts as plain JSON."""
        return asdict(self)


class Damaged:
    """A copy of a set in which one file at a time is damaged. whole: the sound set; folder: an empty one."""

    def __init__(self, whole: Path, folder: Path) -> None:
        self.folder = Path(shutil.copytree(whole, folder, dirs_exist_ok=True))
        self.manifest = read_manifest(whole)
        images = RangeImages(whole, variant="all")
        self._pixels = {key: _digest(images[index]) for index, key in enumerate(images.keys)}

    def try_out(self, name: str, spoil: Callable[[bytes], bytes], what: str, tally: Tally) -> None:
        """Damage the file `name` of the set, try all readers, and repair it; `what` names the damage in faults."""
        path = self.folder / name
        sound = path.read_bytes()
        damaged = spoil(sound)
        if damaged == sound or (name == MANIFEST_NAME and damaged.strip() == sound.strip()):
            return  # the newline that ends a manifest holds no data
        path.write_bytes(damaged)
        try:
            tally.damages += 1
            record = next((record for record in self.manifest.shards if record.name == name), None)
            tally.faults += [f"{what}: {fault}" for fault in self._verify(tally)]
            tally.faults += [f"{what}: {fault}" for fault in self._access(record, damaged, sound, tally)]
            tally.faults += [f"{what}: {fault}" for fault in self._pipeline(record, damaged, sound, tally)]
        finally:
            path.write_bytes(sound)

    def _verify(self, tally: Tally) -> Iterator[str]:
        """Verify the damaged set as `bodyseg verify` does."""
        try:
            manifest = read_manifest(self.folder)
            store = LocalFolder(self.folder)
            faults = [fault for shard in manifest.shards for fault in find_faults(store, manifest, shard)]
        except BadShard:
            tally.reported_by_verify += 1
            return
        tally.reported_by_verify += bool(faults)
        if not faults:
            yield "verify found no fault"

    def _access(self, record: ShardRecord | None, damaged: bytes, sound: bytes, tally: Tally) -> Iterator[str]:
        refused = False
        try:
            images = RangeImages(self.folder / (record.name if record else ""), variant="all")
        except BodysegError as error:
            tally.refused_by_access += 1
            if record is not None:
                yield f"the set cannot be opened: {error}"
            return
        if record is None:
            yield "a set with an altered manifest was opened"
            return
        for index, key in enumerate(images.keys):
            span = slice(record.offsets[index], record.offsets[index] + record.lengths[index])
            altered = damaged[span] != sound[span]
            try:
                given = images[index]
            except BodysegError as error:
                refused = True
                if not altered:
                    yield f"{key} is sound and was refused: {error}"
                elif f"{record.name}: {key}: offset {record.offsets[index]}" not in str(error):
                    yield f"a refusal does not say where: {error}"
                continue
            tally.samples_given += 1
            if altered or _digest(given) != self._pixels[key]:
                yield f"{key} was given though it was altered"
        tally.refused_by_access += refused

    def _pipeline(self, record: ShardRecord | None, damaged: bytes, sound: bytes, tally: Tally) -> Iterator[str]:
        if record is None:
            return  # opening the set is the same
        images = RangeImages(self.folder / record.name, variant="all")
        end = record.offsets[-1] + record.lengths[-1]
        count = 0
        try:
            for given in images.webdataset():
                count += 1
                if _digest(given) != self._pixels[given["key"]]:
                    yield f"the pipeline gave {given['key']} though it was altered"
        except BodysegError:
            tally.refused_by_pipeline += 1
            return
        tally.samples_given += count
        if damaged[:end] != sound[:end] and count < len(record):
            yield f"the pipeline ended after {count} of {len(record)} samples as if that were all"


def _digest(image: dict[str, Any]) -> str:
    pixels = image["range"].numpy().tobytes() + image["labels"].numpy().tobytes()
    return hashlib.sha256(image["key"].encode() + pixels).hexdigest()


def cut_everywhere(damaged: Damaged, name: str, step: int, tally: Tally) -> None:
    """Cut a file at every `step` bytes."""
    length = (damaged.folder / name).stat().st_size
    for end in range(0, length, step):
        damaged.try_out(name, lambda data, end=end: data[:end], f"{name} cut at {end}", tally)  # type: ignore[misc]


def flip_bits(damaged: Damaged, count: int, seed: int, tally: Tally) -> None:
    """Flip one bit, `count` times, anywhere in any file of the set."""
    generator = np.random.default_rng(seed)
    names = _files(damaged)
    sizes = [(damaged.folder / name).stat().st_size for name in names]
    for offset in generator.integers(0, sum(sizes), count).tolist():
        number = int(np.searchsorted(np.cumsum(sizes), offset, side="right"))
        at, bit = offset - sum(sizes[:number]), int(generator.integers(8))

        def flip(data: bytes, at: int = at, bit: int = bit) -> bytes:
            return data[:at] + bytes([data[at] ^ (1 << bit)]) + data[at + 1 :]

        damaged.try_out(names[number], flip, f"{names[number]}, bit {bit} of byte {at}", tally)


def mangle(damaged: Damaged, count: int, seed: int, tally: Tally) -> None:
    """Bytes lost, put in, zeroed, doubled; blocks exchanged; a file emptied, or exchanged for another of the set."""
    generator = np.random.default_rng(seed)
    names = _files(damaged)
    contents = {name: (damaged.folder / name).read_bytes() for name in names}
    for number in range(count):
        name = one_of(names, generator)
        kind = list(_MANGLES)[number % len(_MANGLES)]
        other = contents[one_of(names, generator)]

        def spoil(data: bytes, kind: str = kind, other: bytes = other) -> bytes:
            return _MANGLES[kind](data, other, generator)

        damaged.try_out(name, spoil, f"{name}, {kind} ({number})", tally)


def _files(damaged: Damaged) -> list[str]:
    return [*(record.name for record in damaged.manifest.shards), MANIFEST_NAME]


def _run(data: bytes, generator: Generator) -> tuple[int, int]:
    start = int(generator.integers(len(data)))
    return start, min(start + int(generator.integers(1, 2000)), len(data))


def _lost(data: bytes, other: bytes, generator: Generator) -> bytes:
    start, end = _run(data, generator)
    return data[:start] + data[end:]


def _put_in(data: bytes, other: bytes, generator: Generator) -> bytes:
    start, end = _run(data, generator)
    return data[:start] + generator.bytes(end - start) + data[start:]


def _zeroed(data: bytes, other: bytes, generator: Generator) -> bytes:
    start, end = _run(data, generator)
    return data[:start] + bytes(end - start) + data[end:]


def _doubled(data: bytes, other: bytes, generator: Generator) -> bytes:
    start, end = _run(data, generator)
    return data[:end] + data[start:]


def _exchanged(data: bytes, other: bytes, generator: Generator) -> bytes:
    blocks = [data[start : start + BLOCK] for start in range(0, len(data), BLOCK)]
    a, b = generator.integers(0, len(blocks), 2).tolist()
    blocks[a], blocks[b] = blocks[b], blocks[a]
    return b"".join(blocks)


_MANGLES: Final[dict[str, Callable[[bytes, bytes, Generator], bytes]]] = {
    "bytes lost": _lost,
    "bytes put in": _put_in,
    "bytes zeroed": _zeroed,
    "bytes doubled": _doubled,
    "blocks exchanged": _exchanged,
    "all zeros": lambda data, other, generator: bytes(len(data)),
    "empty": lambda data, other, generator: b"",
    "another file": lambda data, other, generator: other,
    "more at the end": lambda data, other, generator: data + generator.bytes(700),
}
