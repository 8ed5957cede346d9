"""Faults of stored shards: all that differs from what was written, found by reading whole files."""

import hashlib
import zlib
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadSample, BadShard
from bodyseg_data.samples import SampleInfo
from bodyseg_data.shards.columns import column_names, read_column
from bodyseg_data.shards.index import IndexedShards
from bodyseg_data.shards.manifest import Manifest
from bodyseg_data.shards.records import ShardRecord, check_bytes, location
from bodyseg_data.shards.remote import Unreachable
from bodyseg_data.shards.sample_codec import decode_sample, parse_info
from bodyseg_data.shards.store import Store, open_file
from bodyseg_data.shards.tar import check_sizes, decode_piece, parse_members


@dataclass(frozen=True)
class Fault:
    """A fault in a set of shards: the shard, the sample's key ("-" if none is affected), byte offset, problem."""

    shard: str
    key: str
    offset: int
    problem: str

    def __str__(self) -> str:
        return f"{self.shard}: {self.key}: offset {self.offset}: {self.problem}"


def find_index_faults(store: Store, manifest: Manifest) -> Iterator[Fault]:
    """Find all faults of a set's index, if it has one: in its size, in every piece, in its hash, and keys used twice.

    A fault inside a piece is reported with the name of its shard as key.
    """
    if not isinstance(manifest.shards, IndexedShards):
        return
    table = manifest.shards.table
    try:
        with open_file(store, table.name) as file:
            found = hashlib.file_digest(file, "sha256").hexdigest()
        size = store.size(table.name)
    except (OSError, Unreachable) as error:
        yield Fault(table.name, "-", 0, f"cannot be read: {error}")
        return
    sound = True
    digests = []
    for number, shard in enumerate(manifest.shards):
        try:
            digests.append(np.array([_short_digest(key) for key in shard.keys], np.uint64))
        except BadShard as error:
            sound = False
            place = table.entry(number)
            problem = str(error).removeprefix(f"{manifest.shards.where(number)}: ")
            problem = problem.removeprefix(f"{location(table, number)}: ")
            yield Fault(table.name, place.key, place.offset, problem)
    if size != table.size:
        yield Fault(table.name, "-", min(size, table.size), f"{table.size} bytes expected, found {size}")
    elif sound and found != table.sha256:
        yield Fault(table.name, "-", 0, f"altered: SHA-256 {table.sha256} expected, found {found}")
    if sound:
        yield from _repeated_keys(manifest, np.concatenate(digests))


def _short_digest(key: str) -> int:
    return int.from_bytes(hashlib.blake2b(key.encode(), digest_size=8).digest(), "little")


def _repeated_keys(manifest: Manifest, digests: NDArray[np.uint64]) -> Iterator[Fault]:
    """Find samples whose key an earlier sample has. digests: of all keys, 8 bytes each, so they fit into memory."""
    order = np.sort(digests)
    suspects = set(order[1:][order[1:] == order[:-1]].tolist())
    seen: set[str] = set()
    for shard in manifest.shards if suspects else ():
        for index, key in enumerate(shard.keys):
            if key in seen:
                yield Fault(shard.name, key, shard.offsets[index], "a sample before it has the same key")
            elif _short_digest(key) in suspects:
                seen.add(key)


def find_column_faults(store: Store, manifest: Manifest) -> Iterator[str]:
    """Find all faults of a set's columns, one line each: of their list, their manifests, and their tars."""
    try:
        names = column_names(store)
    except BadShard as error:
        yield str(error)
        return
    for name in names:
        try:
            column = read_column(store, manifest, name)
        except BadShard as error:
            yield str(error)
            continue
        for shard in column.shards:
            yield from map(str, find_faults(store, column, shard, is_column=True))


def find_faults(store: Store, manifest: Manifest, shard: ShardRecord, is_column: bool = False) -> Iterator[Fault]:
    """Find all faults of one shard: in its size, in every sample's bytes and content, in its hash.

    is_column: the manifest is that of a column, whose samples hold one plane or one field.

    A fault inside a sample is reported at that sample, any other at the end of the archive.
    """
    try:
        keys = shard.keys
    except BadShard as error:
        yield Fault(shard.name, "-", 0, f"its samples are not known: {error}")
        return
    sha256, sound = hashlib.sha256(), True
    end = size = 0
    try:
        with open_file(store, shard.name) as file:
            for index, key in enumerate(keys):
                _, offset, length, checksum = shard.entry(index)
                data = file.read(length)
                if len(data) == length and zlib.crc32(data) != checksum and store.prepare_reread(shard.name):
                    data = store.read(shard.name, offset, length)  # it was altered on its way, or is so in the file
                end += len(data)
                sha256.update(data)
                try:
                    check_bytes(data, shard, index)
                    (_check_piece if is_column else _check_content)(manifest, shard, index, data)
                except (BadShard, BadSample) as error:
                    sound = False
                    problem = str(error).removeprefix(f"{location(shard, index)}: ").removeprefix(f"{key}: ")
                    yield Fault(shard.name, key, shard.offsets[index], problem)
            size = end
            while rest := file.read(1 << 20):
                sha256.update(rest)
                size += len(rest)
    except (OSError, Unreachable) as error:
        yield Fault(shard.name, "-", 0, f"cannot be read: {getattr(error, 'strerror', None) or error}")
        return
    if size != shard.size:
        yield Fault(shard.name, "-", min(size, shard.size), f"{shard.size} bytes expected, found {size}")
    elif sound and sha256.hexdigest() != shard.sha256:
        found = sha256.hexdigest()
        yield Fault(shard.name, "-", end, f"end of archive altered: SHA-256 {shard.sha256} expected, found {found}")


def _check_piece(column: Manifest, shard: ShardRecord, index: int, data: bytes) -> None:
    key = shard.keys[index]
    if column.planes:
        decode_piece(column, key, data)
        return
    info = parse_info(parse_members(key, data).get("json", b""), key)
    _check_described(column, shard, index, info, "the value differs from the column's manifest")


def _check_content(manifest: Manifest, shard: ShardRecord, index: int, data: bytes) -> None:
    key = shard.keys[index]
    sample = decode_sample(key, parse_members(key, data), projectors=len(manifest.rig.projectors))
    sample.check(len(manifest.classes))
    check_sizes(sample, manifest.rig)
    if sample.info.split != shard.split:
        raise BadSample(f"{key}: belongs to {sample.info.split}, stored among {shard.split}")
    _check_described(manifest, shard, index, sample.info, "the description differs from the manifest's")
    found = {name: plane.dtype.name for name, plane in sample.planes.items()}
    if found != dict(manifest.planes):
        raise BadSample(f"{key}: the set has the planes {dict(manifest.planes) or 'none'}, found {found or 'none'}")
    if (sample.projector_range is None) != (manifest.projector == "none"):
        raise BadSample(f"{key}: the set's projector range is {manifest.projector!r}, the sample says otherwise")
    manifest.rig_of(sample)


def _check_described(manifest: Manifest, shard: ShardRecord, index: int, info: SampleInfo, differs: str) -> None:
    """Raise BadSample, with the words `differs`, unless a sample's own fields have the values in the manifest."""
    listed = shard.descriptions.info(index, shard.split)
    for field in manifest.fields.kinds:
        if (own := info.get(field)) != (other := listed.get(field)):
            raise BadSample(f"{shard.keys[index]}: {differs}: {field!r} is {own!r}, in the manifest {other!r}")
