"""One transfer: what is already there is kept, all else is copied and checked, the index comes last."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.shards.manifest import LARGEST_MANIFEST
from bodyseg_data.transfer.bundle import Bundle, superseded
from bodyseg_data.transfer.targets import Target


@dataclass(frozen=True)
class Outcome:
    """Counts of a transfer's large files. copied_bytes: of those that were not there already."""

    files: int
    kept: int
    copied_bytes: int


def transfer(
    bundle: Bundle,
    target: Target,
    report: Callable[[int], None],
    replace: bool = False,
    sizes_only: bool = False,
) -> Outcome:
    """Copy a bundle to a target. Interrupted at any point, it leaves a target that the same call completes.

    report: receives the bytes of the large files that are done so far. replace: a target that holds another bundle
    gets this one; its index is removed first, then the files that the new one has not. sizes_only: files at the target
    are compared by size alone.

    While files are missing or wrong the target has no index, so it is never read as whole. Raises BadConfig for a
    target that holds another bundle without `replace`, BadShard for bytes that are not those of their checksum, OSError
    or Unreachable.
    """
    held = target.store.read_file(bundle.index, LARGEST_MANIFEST)
    other = held is not None and held != bundle.index_bytes
    if other and not replace:
        raise BadConfig(f"{target.store.name} holds another {bundle.index}: choose another place, or --replace it")
    obsolete = superseded(target.store, bundle) if other else []
    done = 0
    missing = []
    for file in bundle.files:
        if target.holds(file, sizes_only):
            done += file.size
            report(done)
        else:
            missing.append(file)
    if held is not None and (other or missing):
        target.remove(bundle.index)
    for name in obsolete:
        target.remove(name)
    kept = len(bundle.files) - len(missing)

    def add(copied: int) -> None:
        nonlocal done
        done += copied
        report(done)

    for file in missing:
        target.receive(file, add, sizes_only)
    for name, data in bundle.pages.items():
        target.write(name, data)
    if held is None or other or missing:
        target.write(bundle.index, bundle.index_bytes)
    return Outcome(len(bundle.files), kept, sum(file.size for file in missing))
