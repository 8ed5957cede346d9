"""The part of a set's train split to validate on: whole groups of bodies, chosen from the descriptions alone.

docs/how-to/splits.md has the rule in words.
"""

from __future__ import annotations

import hashlib
import math
from collections import Counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.splits import holds_postures
from bodyseg_data.loading.selection.sample_table import BodyRow, SampleTable

Group = tuple[str, ...]
"""What the bodies of a group have in common: subset, subject and, where people are few, pose or mesh."""


def check_val_share(share: Any) -> float:
    """Return `share` as a float. Raises BadConfig unless it is a number of at least 0 and below 1."""
    if isinstance(share, bool) or not isinstance(share, int | float | np.number) or not 0 <= share < 1:
        raise BadConfig(f"val_share must be a number of at least 0 and below 1, found {share!r}")
    return float(share)


def mark_val(table: SampleTable, train: NDArray[np.bool_], share: float) -> NDArray[np.bool_]:
    """Mark the samples of val, bool [N].

    train: bool [N], the samples of the stored train split. share: of them, above 0. Raises BadConfig if they are one
    group, which cannot be divided.
    """
    counts = np.bincount(table.body[train], minlength=len(table.bodies))
    rows = [row for row, count in zip(table.bodies, counts, strict=True) if count]
    group_of = groups(rows, share)
    sizes = Counter[Group]()
    for row, count in zip(table.bodies, counts.tolist(), strict=True):
        if count:
            sizes[group_of[row]] += count
    if len(sizes) < 2:
        raise BadConfig(f"val_share={share:g} divides train by people and motions, found {len(sizes)} group of them")
    chosen = choose_groups(sizes, share)
    return train & table.where_body(lambda row: group_of.get(row) in chosen)


def groups(bodies: list[BodyRow], share: float) -> dict[BodyRow, Group]:
    """Assign bodies to groups that are never divided.

    A group is a person where the subset has enough people for the share, 1 / share or more; otherwise the person in
    one pose, such as a whole motion; in the paper's subset A, where each mesh is a posture of its own, the mesh.
    """
    people = Counter(subset for subset, _ in {(subset, subject) for _, subset, subject, _, _ in bodies})
    found: dict[BodyRow, Group] = {}
    for row in bodies:
        _, subset, subject, mesh, pose = row
        within: Group = ()
        if people[subset] < math.ceil(1 / share):
            within = (mesh,) if holds_postures(subset) else (pose,)
        found[row] = (subset, subject, *within)
    return found


def choose_groups(sizes: dict[Group, int], share: float) -> set[Group]:
    """Choose groups that hold about a share of the samples, in every subset where they are small enough.

    sizes: samples of each group. Subsets of the largest groups come first; what they have too few or too many is made
    up for by the next ones, which give between half and twice their own share, and leave at least half of their own
    rest. At least one group is chosen, and at least one left.
    """
    subsets: dict[str, list[Group]] = {}
    for group in sizes:
        subsets.setdefault(group[0], []).append(group)
    chosen: set[Group] = set()
    short = 0.0
    for _, members in sorted(subsets.items(), key=lambda item: (-max(sizes[group] for group in item[1]), item[0])):
        held = sum(sizes[group] for group in members)
        own = share * held
        taken = _choose(members, sizes, min(max(own + short, own / 2), 2 * own, (held + own) / 2))
        short += own - sum(sizes[group] for group in taken)
        chosen |= taken
    smallest = {min(sizes, key=lambda group: (sizes[group], _hash(group)))}
    return (chosen - smallest if len(chosen) == len(sizes) else chosen) or smallest


def _choose(members: list[Group], sizes: dict[Group, int], due: float) -> set[Group]:
    """Choose groups of one subset: in the order of a hash, those that fit, and one more if that is nearer to `due`."""
    order = sorted(members, key=_hash)
    chosen: set[Group] = set()
    for group in order:
        if sizes[group] <= due:
            chosen.add(group)
            due -= sizes[group]
    others = [group for group in order if group not in chosen]
    nearest = min(others, key=lambda group: abs(due - sizes[group]), default=None)
    if nearest is not None and abs(due - sizes[nearest]) < due:
        chosen.add(nearest)
    return chosen


def _hash(group: Group) -> bytes:
    text = "\0".join(group)
    return hashlib.blake2b(text.encode(errors="surrogatepass"), digest_size=16, person=b"bodyseg val").digest()
