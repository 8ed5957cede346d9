"""Faults of stored shards: all that differs from what was written, found by reading whole files."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from bodyseg_data.core.errors import BadSample, BadShard, Unreachable
from bodyseg_data.shards.descriptions import difference
from bodyseg_data.shards.manifest import Manifest, ShardRecord
from bodyseg_data.shards.sample_codec import decode_sample
from bodyseg_data.shards.stores.store import Store, open_file, store_at
from bodyseg_data.shards.tar import check_bytes, check_sizes, image_sizes, parse_members, sample_location


@dataclass(frozen=True)
class Fault:
    """A fault in a set of shards: the shard, the sample's key ("-" if none is affected), byte offset, problem."""

    shard: str
    key: str
    offset: int
    problem: str

    def __str__(self) -> str:
        return f"{self.shard}: {self.key}: offset {self.offset}: {self.problem}"


def find_faults(where: Path | Store, manifest: Manifest, shard: ShardRecord) -> Iterator[Fault]:
    """Find all faults of one shard: in its size, in every sample's bytes and content, in its hash.

    A fault inside a sample is reported at that sample, any other at the end of the archive.
    """
    sha256 = hashlib.sha256()
    sound = True
    end = size = 0
    try:
        with open_file(store_at(where), shard.name) as file:
            for index, key in enumerate(shard.keys):
                data = file.read(shard.lengths[index])
                end += len(data)
                sha256.update(data)
                try:
                    check_bytes(data, shard, index)
                    _check_content(manifest, shard, index, data)
                except (BadShard, BadSample) as error:
                    sound = False
                    problem = str(error).removeprefix(f"{sample_location(shard, index)}: ").removeprefix(f"{key}: ")
                    yield Fault(shard.name, key, shard.offsets[index], problem)
            size = end
            while rest := file.read(1 << 20):
                sha256.update(rest)
                size += len(rest)
    except OSError as error:
        yield Fault(shard.name, "-", 0, f"cannot be read: {error.strerror or error}")
        return
    except Unreachable as error:
        yield Fault(shard.name, "-", 0, f"cannot be read: {error}")
        return
    if size != shard.size:
        yield Fault(shard.name, "-", min(size, shard.size), f"{shard.size} bytes expected, found {size}")
    elif sound and sha256.hexdigest() != shard.sha256:
        found = sha256.hexdigest()
        yield Fault(shard.name, "-", end, f"end of archive altered: SHA-256 {shard.sha256} expected, found {found}")


def _check_content(manifest: Manifest, shard: ShardRecord, index: int, data: bytes) -> None:
    key = shard.keys[index]
    sample = decode_sample(key, parse_members(key, data), projectors=len(manifest.rig.projectors))
    sample.check()
    if sample.info.split != shard.split:
        raise BadSample(f"{key}: belongs to {sample.info.split}, stored among {shard.split}")
    differs = difference(sample.info, shard.descriptions.info(index, shard.split))
    if differs is not None:
        raise BadSample(f"{key}: the description differs from the manifest's: {differs}")
    check_sizes(sample, *image_sizes(manifest.rig))
