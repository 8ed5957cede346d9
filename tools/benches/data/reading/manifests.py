"""Manifests of any number of samples, and what it takes to open them."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from bodyseg_data.loading import RangeImages
from bodyseg_data.shards import BODY_FIELDS, MANIFEST_NAME, LocalFolder, Manifest, ShardRecord, record_to_json
from bodyseg_data.shards.index import INDEX_NAME, IndexedShards, write_index
from bodyseg_data.shards.records import Descriptions

SHARD_SAMPLES: Final = 1080
VIEWS: Final = 54
"""Samples of a shard and views of a body, those of `bodyseg shard`."""

_ONLY_SHARDS: Final = b'"shards":[]'


def write_large_manifest(example: Manifest, samples: int, folder: Path) -> None:
    """Write the manifest of a set of `samples`, a multiple of `SHARD_SAMPLES`, whose keys, sizes and views are usual.

    example: gives all else. Shards are written one after the other, so that any number fits into memory.
    """
    tree = replace(example, shards=()).to_json()
    del tree["digest"]
    head, tail = _compact(tree).split(_ONLY_SHARDS)
    file = folder / MANIFEST_NAME
    sha256 = hashlib.sha256()
    first = head.index(b'"format"')
    with file.open("wb") as out:
        place = b'"digest":"' + b"0" * 64 + b'",'
        out.write(head[:first] + place + head[first:])
        sha256.update(head)
        for number in range(samples // SHARD_SAMPLES):
            piece = (b"," if number else b'"shards":[') + _compact(record_to_json(_record(number)))
            out.write(piece)
            sha256.update(piece)
        out.write(b"]" + tail + b"\n")
        sha256.update(b"]" + tail)
        out.seek(first + len(b'"digest":"'))
        out.write(sha256.hexdigest().encode())


def write_large_index(example: Manifest, samples: int, folder: Path) -> None:
    """Write manifest and index of a set as `write_large_manifest`, but for all pieces of the index, which are equal.

    Opening a set and finding single samples take the same for equal pieces, which are written in seconds.
    """
    record = _record(0)
    one = write_index([record], folder)
    data, count = (folder / INDEX_NAME).read_bytes(), samples // SHARD_SAMPLES
    sha256 = hashlib.sha256()
    with (folder / INDEX_NAME).open("wb") as out:
        for _ in range(count):
            out.write(data)
            sha256.update(data)
    table = replace(
        one,
        size=count * one.size,
        sha256=sha256.hexdigest(),
        names=tuple(f"train-{number:05d}.tar" for number in range(count)),
        splits=one.splits * count,
        hashes=tuple(hashlib.sha256(str(number).encode()).hexdigest() for number in range(count)),
        **{name: np.tile(getattr(one, name), count) for name in ("samples", "sizes", "crc32")},
        ends=np.arange(1, count + 1) * one.size,
    )
    manifest = replace(example, shards=IndexedShards(table, example.fields, LocalFolder(folder)))
    (folder / MANIFEST_NAME).write_bytes(_compact(manifest.to_json()) + b"\n")


def cost_of_opening(example: Manifest, samples: int, indexed: bool) -> dict[str, Any]:
    """Costs of opening a set of `samples` in a process of its own. indexed: its manifest has an index.

    bytes: of the manifest, which opening reads. cpu_s: processor seconds. memory_bytes: that the process takes in
    addition, at most.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (write_large_index if indexed else write_large_manifest)(example, samples, folder)
        context = multiprocessing.get_context("spawn")
        with context.Pool(1) as pool:
            found = pool.apply(_open, (folder,))
        size = (folder / MANIFEST_NAME).stat().st_size
    return {"samples": samples, "indexed": indexed, "bytes": size, **found}


def fit(rows: Sequence[dict[str, Any]], name: str, at: int) -> dict[str, float]:
    """Straight line through the column `name` of `rows` over their samples, by least squares of the relative errors:
    its value for `at` samples.
    """
    samples = np.array([row["samples"] for row in rows], float)
    values = np.array([row[name] for row in rows], float)
    columns = np.stack([np.ones_like(samples), samples], axis=1)
    constant, slope = np.linalg.lstsq(columns / values[:, None], np.ones_like(values), rcond=None)[0]
    return {"value": float(constant + slope * at)}


def _record(number: int) -> ShardRecord:
    index = np.arange(SHARD_SAMPLES)
    body, view = index // VIEWS, index % VIEWS
    people = [f"person-{number:06d}{each:02d}" for each in range(SHARD_SAMPLES // VIEWS)]
    views = [(215 + 40 * (each % 3), each // 3 * 20, 0, 0, 0) for each in range(VIEWS)]
    lengths = 66_560 + 512 * (index * 7919 % 17)
    offsets = np.cumsum(lengths) - lengths
    keys = (f"open-people-{people[b]}-d{views[v][0]}-a{views[v][1]:03d}" for b, v in zip(body, view, strict=True))
    return ShardRecord(
        name=f"train-{number % 100_000:05d}.tar",
        split="train",
        size=int(lengths.sum()) + 10_240,
        sha256=hashlib.sha256(str(number).encode()).hexdigest(),
        keys=tuple(keys),
        offsets=tuple(offsets.tolist()),
        lengths=tuple(lengths.tolist()),
        crc32=tuple(((number * 1_000_003 + index * 2_654_435_761) % (1 << 32)).tolist()),
        notes=(),
        descriptions=Descriptions(
            BODY_FIELDS,
            (tuple(("open", "people", person, person, "standing") for person in people), tuple(views), (("", 0),)),
            (tuple(body.tolist()), tuple(view.tolist()), (0,) * SHARD_SAMPLES),
        ),
    )


def _open(folder: Path) -> dict[str, float]:
    Path("/proc/self/clear_refs").write_text("5")  # starts the count of the most memory anew
    memory, start = _status("VmRSS"), time.process_time()
    RangeImages(folder, variant="none", split="train")
    seconds = time.process_time() - start
    return {"cpu_s": round(seconds, 3), "memory_bytes": max(0, _status("VmHWM") - memory)}


def _status(field: str) -> int:
    """Memory of this process by the name of the kernel, bytes."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) << 10 for line in lines if line.startswith(f"{field}:"))


def _compact(tree: dict[str, Any]) -> bytes:
    return json.dumps(tree, sort_keys=True, separators=(",", ":")).encode()
