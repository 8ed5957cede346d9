"""`bodyseg verify`: check every byte of a set of shards."""

import contextlib
import sys
from collections.abc import Iterator
from dataclasses import dataclass

from bodyseg_data import shards
from bodyseg_data.commands.options import option
from bodyseg_data.commands.progress import Progress
from bodyseg_data.core import BadConfig, BadShard

EXAMPLE = "bodyseg verify shards"


@dataclass(frozen=True)
class Options:
    folder: str = option("folder or address of a set of shards", positional=True, address=True)


def run(options: Options) -> int:
    """Print one line a fault and return 1, or a line without faults and return 0."""
    store, pattern = shards.open_store(options.folder)
    if pattern != "*":
        raise BadConfig(f"a whole set is verified, found {pattern!r} at the end of its path")
    try:
        manifest = shards.read_manifest(store)
    except BadShard as error:
        sys.stdout.write(f"{error}\n")
        return 1
    faulty = False
    for fault in _faults(store, manifest):
        sys.stdout.write(f"{fault}\n")
        faulty = True
    if not faulty or manifest.index is None:  # else the index, which has the notes, may be what is damaged
        for note in manifest.notes():
            sys.stdout.write(f"note: {note}\n")
    if faulty:
        return 1
    size = sum(shard.size for shard in manifest.shards)
    sys.stdout.write(f"{store.name}: {manifest.counts}, {size / 1e6:.1f} MB: no fault\n")
    if columns := shards.column_names(store):
        sys.stdout.write(f"columns: {', '.join(columns)}: no fault\n")
    return 0


def _faults(store: shards.Store, manifest: shards.Manifest) -> Iterator[object]:
    """Find faults of index, shards and columns, and tars of no shard and no column, which a local folder can list."""
    yield from shards.find_index_faults(store, manifest)
    with Progress("verifying", "samples") as progress:
        done, total = 0, manifest.samples()
        for shard in manifest.shards:
            yield from shards.find_faults(store, manifest, shard)
            done += len(shard)
            progress.update(done, total)
    yield from shards.find_column_faults(store, manifest)
    if not isinstance(store, shards.LocalFolder):
        return
    listed = {shard.name for shard in manifest.shards}
    with contextlib.suppress(BadShard):  # which was printed
        listed |= {shards.column_tar(name, column) for column in shards.column_names(store) for name in listed}
    for name in sorted(path.name for path in store.path.glob("[!.]*.tar") if path.name not in listed):
        yield f"{name}: -: offset 0: not in the manifest"
