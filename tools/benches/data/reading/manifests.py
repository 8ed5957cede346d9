"""Manifests of any number of samples, and what it takes to open them."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import resource
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from bodyseg_data.shards.descriptions import Descriptions
from bodyseg_data.shards.manifest import MANIFEST_NAME, Manifest, read_manifest
from bodyseg_data.shards.records import ShardRecord, record_to_json

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


def cost_of_opening(example: Manifest, samples: int) -> dict[str, Any]:
    """Bytes of a manifest of `samples`; processor seconds of reading it, and peak memory of the process, bytes."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_large_manifest(example, samples, folder)
        context = multiprocessing.get_context("spawn")
        with context.Pool(1) as pool:
            seconds, memory = pool.apply(_open, (folder,))
        size = (folder / MANIFEST_NAME).stat().st_size
    return {"samples": samples, "bytes": size, "cpu_s": round(seconds, 3), "memory_bytes": memory}


def fit(rows: Sequence[dict[str, Any]], name: str, at: int) -> dict[str, float]:
    """Straight line through the column `name` of `rows` over their samples, by least squares of the relative errors.

    Returns its constant and its slope a sample, the largest error of a row, relative, and its value for `at` samples.
    """
    samples = np.array([row["samples"] for row in rows], float)
    values = np.array([row[name] for row in rows], float)
    columns = np.stack([np.ones_like(samples), samples], axis=1)
    constant, slope = np.linalg.lstsq(columns / values[:, None], np.ones_like(values), rcond=None)[0]
    errors = np.abs(columns @ (constant, slope) / values - 1)
    return {
        "constant": float(constant),
        "a_sample": float(slope),
        "largest_error": round(float(errors.max()), 4),
        "value": float(constant + slope * at),
    }


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
            tuple(("open", "people", person, person, "standing") for person in people),
            tuple(views),
            tuple(body.tolist()),
            tuple(view.tolist()),
        ),
    )


def _open(folder: Path) -> tuple[float, int]:
    start = time.process_time()
    manifest = read_manifest(folder)
    seconds = time.process_time() - start
    del manifest  # held until here, as a reader holds it
    return seconds, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def _compact(tree: dict[str, Any]) -> bytes:
    return json.dumps(tree, sort_keys=True, separators=(",", ":")).encode()
