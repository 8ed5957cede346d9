"""Which samples make up which batch: a function of set, seed, epoch, ranks and batch size, and of nothing else.

One order an epoch is shared by all ranks. It is cut into global batches of ranks x batch_size samples, and each of
those into one batch a rank, side by side. So putting the ranks' batches together gives what one process gets, and a
place in an epoch is a number of samples, which means the same for any number of workers, ranks, or batch size.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final, Protocol

import numpy as np
import torch.distributed
from numpy.typing import NDArray
from torch.utils.data import Sampler

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.randomness import check_epoch

STATE_FORMAT: Final = "bodyseg loader 1"

Request = tuple[int, int]
"""(epoch, index): asked for together, so that workers that outlive an epoch need not be told of the next."""


class Ordered(Protocol):
    """What is put in order; `RangeImages` is. identity: what a state belongs to, as plain JSON."""

    split: Any
    epoch: int
    epochs_set: int

    def __len__(self) -> int: ...

    def order(self, epoch: int, shuffle: bool) -> NDArray[np.int64]: ...

    def identity(self) -> dict[str, Any]: ...


def whole_number(name: str, value: Any, least: int) -> int:
    """`value` as an int. Raises BadConfig, calling it `name`, unless it is a whole number of at least `least`."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise BadConfig(f"{name} must be a whole number of at least {least}, found {value!r}")
    return int(value)


def flag(name: str, value: Any) -> bool:
    """`value` as a bool. Raises BadConfig, calling it `name`, unless it is True or False: text would count as True."""
    if not isinstance(value, bool | np.bool_):
        raise BadConfig(f"{name} must be True or False, found {value!r}")
    return bool(value)


def find_rank(rank: int | None = None, world_size: int | None = None) -> tuple[int, int]:
    """(rank, world_size): as given, else torch.distributed's, else torchrun's RANK and WORLD_SIZE, else (0, 1).

    Raises BadConfig.
    """
    if (rank is None) != (world_size is None):
        raise BadConfig(f"rank and world_size are given together or not at all, found {rank!r} of {world_size!r}")
    if rank is None or world_size is None:
        rank, world_size = _surroundings()
    whole_number("world_size", world_size, 1)
    if whole_number("rank", rank, 0) >= world_size:
        raise BadConfig(f"rank must be less than world_size, found {rank} of {world_size}")
    return rank, world_size


def _surroundings() -> tuple[int, int]:
    if torch.distributed.is_available() and torch.distributed.is_initialized():
        return torch.distributed.get_rank(), torch.distributed.get_world_size()
    found = os.environ.get("RANK"), os.environ.get("WORLD_SIZE")
    if found[0] is None or found[1] is None:
        return 0, 1
    try:
        return int(found[0]), int(found[1])
    except ValueError:
        raise BadConfig(f"RANK and WORLD_SIZE must be whole numbers, found {found[0]!r} and {found[1]!r}") from None


def cuts(samples: int, start: int, batch_size: int, world_size: int, drop_last: bool) -> list[int]:
    """Where the global batches of an epoch's rest begin, and at the end where the last one ends.

    The last one is shorter if need be, and takes samples from the one before if it has fewer than one a rank; with
    `drop_last` it is left out. Raises BadConfig where the ranks could not all get equally many batches.
    """
    whole = world_size * batch_size
    found = list(range(start, samples + 1, whole))
    rest = samples - found[-1]
    if drop_last or not rest:
        return found
    if rest < world_size:
        if len(found) == 1:
            raise BadConfig(
                f"{rest} samples cannot give each of {world_size} ranks a batch: use fewer ranks, or drop_last=True"
            )
        if batch_size == 1:
            raise BadConfig(
                f"{samples - start} samples cannot be shared out to {world_size} ranks in equally many batches of 1: "
                "use a larger batch_size, or drop_last=True"
            )
        found[-1] = samples - world_size
    return [*found, samples]


@dataclass(frozen=True)
class Pass:
    """One pass, or the rest of one. order: int64 [samples]; cuts: see `cuts`."""

    epoch: int
    order: NDArray[np.int64]
    cuts: list[int]
    rank: int
    world_size: int

    def __len__(self) -> int:
        return len(self.cuts) - 1

    def batch(self, number: int) -> list[int]:
        """The indices of this rank's part of a global batch: nearly equal parts, side by side."""
        first, end = self.cuts[number], self.cuts[number + 1]
        share = [first + (end - first) * rank // self.world_size for rank in (self.rank, self.rank + 1)]
        indices: list[int] = self.order[slice(*share)].tolist()
        return indices


class BatchOrder(Sampler[list[Request]]):
    """The batches of pass after pass, each pass another epoch, as lists of (epoch, index).

    `Loader` goes by it, and so can torch's DataLoader and torchdata's StatefulDataLoader over `RangeImages`:

        DataLoader(images, batch_sampler=images.batches(20), num_workers=2, persistent_workers=True)

    Its state is that of the batches asked for, which StatefulDataLoader notes batch by batch. A plain DataLoader with
    workers asks ahead: say `state_dict(batches=done)` there.
    """

    def __init__(
        self,
        images: Ordered,
        batch_size: int,
        shuffle: bool | None = None,
        drop_last: bool = False,
        rank: int | None = None,
        world_size: int | None = None,
    ) -> None:
        self.images, self.drop_last = images, flag("drop_last", drop_last)
        self.batch_size = whole_number("batch_size", batch_size, 1)
        self.shuffle = images.split == "train" if shuffle is None else flag("shuffle", shuffle)
        self.rank, self.world_size = find_rank(rank, world_size)
        if len(images) < self.world_size:
            raise BadConfig(f"{len(images)} samples are fewer than {self.world_size} ranks: use fewer ranks")
        if not len(self):
            each = f" on each of {self.world_size} ranks" if self.world_size > 1 else ""
            raise BadConfig(
                f"drop_last=True leaves nothing of {len(images)} samples: they do not fill one batch of "
                f"{self.batch_size}{each}; use a smaller batch_size"
            )
        self._next = (images.epoch, 0)
        self._reached: tuple[int, int] | None = None
        self._epochs_set = images.epochs_set
        self._pass: Pass | None = None

    def _cuts(self, start: int) -> list[int]:
        return cuts(len(self.images), start, self.batch_size, self.world_size, self.drop_last)

    def __len__(self) -> int:
        """Batches of a whole pass, the same for every rank."""
        return len(self._cuts(0)) - 1

    @property
    def largest(self) -> int:
        """The most samples that a batch of one rank can have."""
        return min(self.batch_size, -(-len(self.images) // self.world_size))

    @property
    def epoch(self) -> int:
        """The epoch of the next pass."""
        self._follow_images()
        return self._next[0]

    def set_epoch(self, epoch: int) -> None:
        """Make the next pass that epoch, from its start; or from where a loaded state stands, if it is that epoch."""
        if check_epoch(epoch) != self._next[0]:
            self._next = (int(epoch), 0)
        self._reached = None

    def _follow_images(self) -> None:
        if self._epochs_set != self.images.epochs_set:
            self._epochs_set = self.images.epochs_set
            self.set_epoch(self.images.epoch)

    def begin(self) -> Pass:
        """The next pass, which is then under way."""
        self._follow_images()
        epoch, start = self._next
        order = self.images.order(epoch, self.shuffle)
        self._pass = Pass(epoch, order, self._cuts(start), self.rank, self.world_size)
        self._reached = self._next
        self._next = (epoch + 1, 0)
        return self._pass

    def reach(self, batches: int) -> None:
        """Note that so many batches of the pass under way are done."""
        if self._pass is not None:
            self._reached = (self._pass.epoch, self._pass.cuts[batches])

    def end(self) -> None:
        """Note that the pass under way is over."""
        self._reached = None

    def __iter__(self) -> Iterator[list[Request]]:
        this = self.begin()
        for number in range(len(this)):
            self.reach(number + 1)
            yield [(this.epoch, index) for index in this.batch(number)]
        self.end()

    def state_dict(self, batches: int | None = None) -> dict[str, Any]:
        """Where the pass under way stands, or after `batches` of its batches: plain JSON, the same on every rank."""
        self._follow_images()
        epoch, position = self._next if self._reached is None else self._reached
        if batches is not None:
            if self._pass is None or not 0 <= batches <= len(self._pass):
                raise BadConfig(f"batches must be a number of batches of the pass under way, found {batches!r}")
            epoch, position = self._pass.epoch, self._pass.cuts[batches]
        return {"format": STATE_FORMAT, "epoch": epoch, "position": position, **self._identity()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Make the next pass go on where `state` stands; one at the end of an epoch means the next epoch.

        Takes the same time for every position. Raises BadConfig for the state of other samples, variant, seed, or
        order, and where fewer samples are left than there are ranks.
        """
        epoch, position = _checked(state, self._identity())
        if len(self._cuts(position)) == 1:
            epoch, position = epoch + 1, 0
        self._next, self._reached, self._pass = (epoch, position), None, None
        self._epochs_set = self.images.epochs_set

    def _identity(self) -> dict[str, Any]:
        return {"samples": len(self.images), **self.images.identity(), "shuffle": self.shuffle}


def _checked(state: Any, identity: dict[str, Any]) -> tuple[int, int]:
    found = state.get("format") if isinstance(state, dict) else type(state).__name__
    if found != STATE_FORMAT:
        raise BadConfig(f"a state's 'format' must be {STATE_FORMAT!r}, found {found!r}")
    for field, here in identity.items():
        if state.get(field) != here:
            raise BadConfig(f"the state belongs to another run: {field} {state.get(field)!r}, here {here!r}")
    epoch, position = (state.get(field) for field in ("epoch", "position"))
    if type(epoch) is not int or epoch < 0 or type(position) is not int or not 0 <= position <= identity["samples"]:
        raise BadConfig(f"a state's epoch and position must be whole numbers, found {epoch!r} and {position!r}")
    return epoch, position
