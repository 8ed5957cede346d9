"""Parts of a set, written side by side by a `ShardWriter` each, cut anew into the shards of one set.

The samples of each split are put in the order of their keys, so the files are the same bytes however the scenes were
divided among writers, and the same as of one writer that wrote them in that order.
"""

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from bodyseg_data.core import BadConfig, BadShard, ProgressCallback, check_int, reported, silent
from bodyseg_data.packing.options import PACKING_VERSION
from bodyseg_data.packing.scene_layout import fields_of
from bodyseg_data.packing.shard_writer import EMPTY_PART, part_name
from bodyseg_data.packing.writing import claimed, digest_of, finished_shards, record_shard, writing_into
from bodyseg_data.samples import SPLITS, Split
from bodyseg_data.shards import (
    EXTERNAL,
    MANIFEST_NAME,
    Fields,
    LocalFolder,
    Manifest,
    ShardReader,
    TarWriter,
    column_names,
    read_manifest,
    shard_name,
    write_manifest,
)

_SAME: Final = ("plan", "rigs", "classes", "projector", "planes", "codec", "source", "renderer")
"""Fields of manifests that parts of one set have in common; `plan` differs wherever a writer's options do."""

_Place = tuple[str, int, int, int]  # a sample: key, number of its part, number of its shard there, its own in that


def join(
    folders: Sequence[Path], out: Path, shard_samples: int = 1080, progress: ProgressCallback = silent
) -> Manifest:
    """Join sets into one in the folder `out` and return its manifest; the sets stay. Carries on where it was stopped.

    folders: of the sets, or one that holds all parts of a set. shard_samples: samples a shard. progress: called with
    samples done and in all. Raises BadConfig for a part that is missing or has columns, sets that are no parts of one,
    a key that two of them have, or a folder `out` that holds something else; BadShard for a set that is damaged.
    """
    check_int("shard_samples", shard_samples, 1)
    folders = _parts(folders)
    parts = [read_manifest(folder) for folder in folders]
    for part, folder in zip(parts, folders, strict=True):
        _check_part(part, folder, parts[0], folders[0])
    readers = [ShardReader(folder, part) for folder, part in zip(folders, parts, strict=True)]
    joined = replace(parts[0], fields=_all_fields(parts, folders), shards=())
    shards = _cut(parts, folders, shard_samples)
    if (out / MANIFEST_NAME).exists():
        raise BadConfig(f"{out} already holds a set: choose another folder, or delete it")
    digests = sorted(part.digest for part in parts)
    description = {"version": PACKING_VERSION, "parts": digests, "shard_samples": shard_samples}
    total = sum(len(places) for _, places in shards.values())
    with writing_into(out), claimed(out, description, digest_of(description)) as state:
        records = finished_shards(out, state, list(shards), joined.fields)
        done = sum(map(len, records.values()))
        progress(done, total)
        for name, (split, places) in shards.items():
            if name in records:
                continue
            with TarWriter(out / name, state / f"{name}.part", split, joined.fields) as writer:
                for _, part_number, shard, number in places:
                    with reported(str(folders[part_number]), BadShard):
                        writer.write(*readers[part_number].members(shard, number))
                    done += 1
                    progress(done, total)
            records[name] = writer.record
            record_shard(state, writer.record)
        manifest = write_manifest(replace(joined, shards=tuple(records[name] for name in shards)), out)
        shutil.rmtree(state)
    return manifest


def _parts(folders: Sequence[Path]) -> list[Path]:
    """The folders of sets, and of parts that got scenes in a folder of parts. Raises BadConfig for a missing part."""
    found: list[Path] = []
    for folder in folders:
        inside = sorted(folder.glob("part-?????-of-?????"))
        if (folder / MANIFEST_NAME).exists() or not inside:
            found.append(folder)
            continue
        count = int(inside[0].name[-5:])
        wanted = [part_name(number, count) for number in range(count)]
        names = [path.name for path in inside]
        missing = sorted(set(wanted) - set(names))
        if missing or len(names) > count:
            wrong = f"{missing[0]} is missing" if missing else f"found {len(names)} parts"
            raise BadConfig(f"{folder} must hold {count} parts: {wrong}")
        found += [part for part in inside if not (part / EMPTY_PART).exists()]
    if not found:
        raise BadConfig("join needs the folder of at least one part")
    if len({folder.resolve() for folder in found}) < len(found):
        raise BadConfig("a part is joined once: a folder is given twice")
    return found


def _check_part(part: Manifest, folder: Path, first: Manifest, first_folder: Path) -> None:
    """Raise BadConfig unless a set can be joined with the first."""
    if not part.renderer.startswith(EXTERNAL):
        raise BadConfig(f"{folder}: parts are sets that a ShardWriter wrote, found one rendered by {part.renderer!r}")
    for name in _SAME:
        if getattr(part, name) != getattr(first, name):
            what = "options of their writers" if name == "plan" else f"{name!r}"
            raise BadConfig(f"{folder} and {first_folder} are no parts of one set: their {what} differ")
    if columns := column_names(LocalFolder(folder)):
        raise BadConfig(f"{folder}: parts must have no columns, found {columns[0]!r}: write it for the joined set")


def _all_fields(parts: Sequence[Manifest], folders: Sequence[Path]) -> Fields:
    """The fields of all parts, which each may have learned from its first scene, in the order of their names."""
    kinds: dict[str, str] = {}
    for part, folder in zip(parts, folders, strict=True):
        for name, kind in part.fields.kinds.items():
            if kinds.setdefault(name, kind) != kind:
                raise BadConfig(f"{folder}: field {name!r} is {kind}, elsewhere {kinds[name]}: say it in 'fields'")
    return fields_of(kinds, len(parts[0].rigs))


def _cut(
    parts: Sequence[Manifest], folders: Sequence[Path], shard_samples: int
) -> dict[str, tuple[Split, list[_Place]]]:
    """Name of each shard -> its split, and its samples by key. Raises BadConfig for a key that two parts have."""
    homes: dict[str, int] = {}
    places: dict[Split, list[_Place]] = {split: [] for split in SPLITS}
    for number, part in enumerate(parts):
        for at, record in enumerate(part.shards):
            for index, key in enumerate(record.keys):
                if homes.setdefault(key, number) != number:
                    raise BadConfig(f"{key} is in {folders[homes[key]]} and in {folders[number]}")
                places[record.split].append((key, number, at, index))
    for found in places.values():
        found.sort()
    return {
        shard_name(split, start // shard_samples): (split, found[start : start + shard_samples])
        for split, found in places.items()
        for start in range(0, len(found), shard_samples)
    }
