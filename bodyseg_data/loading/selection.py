"""Selection of a set's samples by shard, split, key and description, from the manifest alone, and their orders.

`mark_val` divides the train split: whole groups of bodies are left to validate on (docs/how-to/splits.md has the rule).
The chosen samples take memory that grows with them only where single ones were chosen.
"""

from __future__ import annotations

import fnmatch
import hashlib
import re
from bisect import bisect_right
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig, Draws, check_choice
from bodyseg_data.loading.conditions import Condition, SampleTable, parse_condition, texts_of
from bodyseg_data.rigs import Rig
from bodyseg_data.samples import READ_SPLITS, SPLITS, ReadSplit, holds_postures
from bodyseg_data.shards import Fields, Manifest

BodyRow = tuple[str, ...]
"""A body: source, subset, subject, mesh, pose."""

BLOCK_SAMPLES: Final = 32
"""Samples of a block of `BlockOrder`, neighbours in the manifest's order."""

_FIRST_PARTS: Final = (0, 4, 12, 28)  # first block of each of its first parts; further parts have 32 blocks each


def permutation(count: int, seed: int, epoch: int, purpose: str = "order") -> NDArray[np.int64]:
    """An order of `count` things in an epoch, int64 [count]: sorts raw Philox words, whose bits NumPy guarantees."""
    words = np.random.Philox(key=Draws(seed, epoch, "").stream(purpose)).random_raw(count)
    return np.argsort(words, kind="stable")


class BlockOrder:
    """An order, computed part by part as slices of it are read, int64, in which neighbours come near each
    other, so that few files are read at a time.

    Blocks of `BLOCK_SAMPLES` neighbours are permuted. A part holds 4, 8, 16 and from then on 32 of the blocks that
    follow each other, and its things are permuted: the first batches come from few places, later ones from many. The
    part read last is held: who reads elsewhere at the same time needs a copy.
    """

    def __init__(self, count: int, seed: int, epoch: int) -> None:
        self._count, self._key = count, Draws(seed, epoch, "").stream("order in blocks")
        self._held = (-1, np.empty(0, np.int64))
        self._permuted = permutation(-(-count // BLOCK_SAMPLES), seed, epoch, "blocks")
        starts = [*_FIRST_PARTS, *range(2 * _FIRST_PARTS[-1] + 4, len(self._permuted), _FIRST_PARTS[-1] + 4)]
        self._starts = [start for start in starts if start < len(self._permuted)]

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, positions: slice) -> NDArray[np.int64]:
        first, end, _ = positions.indices(self._count)
        found = [np.empty(0, np.int64)]
        while first < end:
            part = int(np.searchsorted(self._ends, first, side="right"))
            start = int(self._ends[part - 1]) if part else 0
            if self._held[0] != part:
                self._held = (part, self._part(part))
            found.append(self._held[1][first - start : end - start])
            first += len(found[-1])
        return np.concatenate(found)

    @cached_property
    def _ends(self) -> NDArray[np.int64]:
        """Number of things up to the end of each part, int64 [P]."""
        sizes = np.full(len(self._permuted), BLOCK_SAMPLES)
        sizes[self._permuted == len(sizes) - 1] -= BLOCK_SAMPLES * len(sizes) - self._count
        return np.cumsum(np.add.reduceat(sizes, self._starts))

    def _part(self, part: int) -> NDArray[np.int64]:
        blocks = self._permuted[self._starts[part] : [*self._starts, len(self._permuted)][part + 1]]
        things = (blocks[:, None] * BLOCK_SAMPLES + np.arange(BLOCK_SAMPLES)).ravel()
        things = things[things < self._count]
        words = np.random.Philox(key=self._key, counter=[0, part, 0, 0]).random_raw(len(things))
        return things[np.argsort(words, kind="stable")]


Group = tuple[str, ...]
"""What the bodies of a group have in common: subset, subject and, where people are few, pose or mesh."""


@dataclass(frozen=True)
class Selection:
    """Choice of samples of a set.

    pattern: of the shards' names. split: "train", "val", "test", or None for train and test. only: patterns as for file
    names; a sample's key must match one of them, if there are any. where: conditions, all of which a sample must meet.
    val_share: share of train that is read as "val" and not as "train" (docs/how-to/splits.md).
    """

    pattern: str
    split: ReadSplit | None
    only: tuple[str, ...] = ()
    where: tuple[Condition, ...] = ()
    val_share: float = 0.0

    @classmethod
    def of(
        cls, pattern: str, split: Any, only: Any, where: Any, val_share: Any, fields: Fields, rigs: Sequence[Rig] = ()
    ) -> Selection:
        """Check the options of a user. only, where: one text or several. fields, rigs: of the set. Raises BadConfig."""
        check_choice("the split", split, (*READ_SPLITS, None))
        if isinstance(val_share, bool) or not isinstance(val_share, int | float | np.number) or not 0 <= val_share < 1:
            raise BadConfig(f"val_share must be a number of at least 0 and below 1, found {val_share!r}")
        if split == "val" and not val_share:
            raise BadConfig("the split 'val' is a share of train: give val_share, like 0.1")
        if isinstance(only, list) and not only:
            raise BadConfig("an empty list of 'only' matches no sample: leave it out for all of them")
        conditions = tuple(parse_condition(text, fields, rigs) for text in texts_of("where", where))
        return cls(pattern, split, texts_of("only", only), conditions, float(val_share))

    @property
    def divides_train(self) -> bool:
        """True if the split is a part of the stored train split, val or the rest."""
        return bool(self.val_share) and self.split in ("train", "val")

    def filters(self) -> dict[str, Any]:
        """Return the options that are given, besides the split, as plain JSON."""
        return {
            **({"only": list(self.only)} if self.only else {}),
            **({"where": [condition.text for condition in self.where]} if self.where else {}),
            **({"val_share": self.val_share} if self.divides_train else {}),
        }

    def choose(self, manifest: Manifest, path: str) -> ChosenSamples:
        """Choose the samples of a set. The index of one that has it is read only where single samples are chosen.

        Raises BadConfig, naming `path`, if there is none, or if train cannot be divided.
        """
        stored = "train" if self.split == "val" else self.split
        counts = {
            number: len(shard)
            for number, shard in enumerate(manifest.shards)
            if stored in (None, shard.split) and (self.pattern == "*" or Path(shard.name).match(self.pattern))
        }
        chosen = ChosenSamples(tuple(counts), tuple(counts.values()))
        if counts and (self.where or self.only or self.divides_train):
            chosen = self._filtered(manifest, chosen.shards)
        if not len(chosen):
            held = ", ".join(f"{manifest.samples(name)} {name}" for name in SPLITS)
            shards = () if self.pattern == "*" else (self.pattern,)
            wanted = " ".join((*shards, *self.only, *(condition.text for condition in self.where)))
            of_split = "" if self.split is None else f" of split {self.split!r}"
            matching = f" that matches {wanted!r}" if wanted else ""
            raise BadConfig(f"{path} has no sample{of_split}{matching}; the set holds {held}")
        return chosen

    def _filtered(self, manifest: Manifest, numbers: Sequence[int]) -> ChosenSamples:
        """Choose the samples of some shards whose keys and descriptions fit, one shard after the other."""
        parts = self._parts_of_train(manifest) if self.divides_train else {}
        named = set(self.only)  # keys, perhaps as many as samples, and patterns, whose marks no key has
        patterns = [re.compile(fnmatch.translate(each)).match for each in named if any(mark in each for mark in "*?[")]
        held: list[tuple[int, NDArray[np.uint32]]] = []
        for number in numbers:
            shard = manifest.shards[number]
            own = parts.get(number, np.ones(len(shard), np.bool_))
            if self.where:
                table = SampleTable.of(manifest.fields, [shard])
                for condition in self.where:
                    own &= condition.marks(table)
            if named:
                for sample in np.flatnonzero(own).tolist():
                    key = shard.keys[sample]
                    own[sample] = key in named or any(match(key) for match in patterns)
            if own.any():
                held.append((number, np.flatnonzero(own).astype(np.uint32)))
        within = np.concatenate([own for _, own in held]) if held else np.empty(0, np.uint32)
        return ChosenSamples(tuple(number for number, _ in held), tuple(len(own) for _, own in held), within)

    def _parts_of_train(self, manifest: Manifest) -> dict[int, NDArray[np.bool_]]:
        """Mark the samples of all shards of train that belong to the split: shard number -> bool [M]."""
        train = [number for number, shard in enumerate(manifest.shards) if shard.split == "train"]
        table = SampleTable.of(manifest.fields, (manifest.shards[number] for number in train))
        val = mark_val(table, self.val_share)
        ends = np.cumsum([len(manifest.shards[number]) for number in train])
        return dict(zip(train, np.split(val == (self.split == "val"), ends[:-1]), strict=True))


@dataclass(frozen=True)
class ChosenSamples:
    """Samples of a set, in stored order.

    shards: numbers of the shards that hold any. counts: chosen samples of each. within: uint32 [N], indices of the
    chosen samples within their shards, shard by shard; None if all samples of these shards are chosen.
    """

    shards: tuple[int, ...]
    counts: tuple[int, ...]
    within: NDArray[np.uint32] | None = None

    def __len__(self) -> int:
        return self._ends[-1] if self._ends else 0

    def place(self, index: int) -> tuple[int, int]:
        """Return (shard number, index within the shard) of a sample, `index` of all chosen ones."""
        at = bisect_right(self._ends, index)
        within = index - self._ends[at] + self.counts[at] if self.within is None else int(self.within[index])
        return self.shards[at], within

    def by_shard(self) -> Iterator[tuple[int, list[int]]]:
        """Yield each shard's number and the indices of its chosen samples."""
        for shard, count, end in zip(self.shards, self.counts, self._ends, strict=True):
            yield shard, list(range(count)) if self.within is None else self.within[end - count : end].tolist()

    @cached_property
    def _ends(self) -> list[int]:
        """Number of samples up to the end of each shard."""
        return list(accumulate(self.counts))


def mark_val(table: SampleTable, share: float) -> NDArray[np.bool_]:
    """Mark the samples of val, bool [N].

    table: of all samples of the stored train split. share: of them, above 0. Samples of bodies are divided by people
    and motions, others by their subject, and where they have none, one by one. Raises BadConfig if they are one group.
    """
    keys = _group_keys(table, share)
    sizes = Counter[Group](keys)
    if len(sizes) < 2:
        raise BadConfig(f"val_share={share:g} divides train by people and motions, which are {len(sizes)} group")
    chosen = choose_groups(sizes, share)
    return np.array([key in chosen for key in keys], np.bool_)


def _group_keys(table: SampleTable, share: float) -> list[Group]:
    places = table.fields.places
    if table.fields.of_bodies:
        rows = [tuple(map(str, row)) for row in table.tables[0]]
        group_of = groups(rows, share)
        return [group_of[rows[number]] for number in table.rows[0].tolist()]
    if "subject" in places:
        at, column = places["subject"]
        subjects = [table.tables[at][row][column] for row in table.rows[at].tolist()]
        return [("", "", str(number)) if own is None else ("", str(own)) for number, own in enumerate(subjects)]
    return [("", str(number)) for number in range(table.samples)]


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
        if people[subset] * share < 1 - 1e-12:  # rounded: 49 people are enough for a share of 1 / 49
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
