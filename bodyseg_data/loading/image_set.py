"""The images that a loader reads, of one set of shards or of a mixture, and their assignment to batches.

Batches are a function of set, seed, epoch, world size and batch size, and of nothing else. All ranks share one order an
epoch. It is cut into global batches of world_size x batch_size samples, and each global batch into consecutive parts,
one a rank. So the ranks' batches put together are the batches of one process, and a position in an epoch is a number of
samples, valid for any number of workers or ranks and any batch size.
"""

from __future__ import annotations

import copy
import operator
import os
import sys
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import FrameType
from typing import Any, Final, Literal, NotRequired, TypedDict

import numpy as np
import torch
import torch.distributed
from numpy.typing import NDArray
from torch.utils.data import Dataset, Sampler

from bodyseg_data.core import BadConfig, check_epoch, check_int
from bodyseg_data.labels import LabelMap
from bodyseg_data.loading.selection import BlockOrder
from bodyseg_data.samples import Sample
from bodyseg_data.shards import Place


def check_bool(name: str, value: Any, choices: str = "True or False") -> bool:
    """Return `value` as a bool. Raises BadConfig, calling it `name`, for anything else: text would count as True."""
    if isinstance(value, bool):
        return value
    if not isinstance(value, np.bool_):
        raise BadConfig(f"{name} must be {choices}, found {value!r}")
    return bool(value)


Range = NDArray[np.uint16]
Labels = NDArray[np.uint8]

Shuffle = bool | Literal["blocks"]
"""Whether samples come in another order in each epoch: of all samples, or by blocks of neighbours."""


Request = tuple[int, int]
"""(epoch, index) of a sample: with its epoch, so that workers kept over several epochs need no other message."""

STATE_FORMAT: Final = "bodyseg loader 1"

_PROGRESS: Final = frozenset({"format", "epoch", "position", "skipped"})  # fields of a state besides its identity


@dataclass(frozen=True)
class Requests:
    """Samples of one epoch in the order of a pass.

    indices: int64 [N], or an order whose slices are that. epochs: int64 [N], of each sample's draws.
    """

    indices: NDArray[np.int64] | BlockOrder
    epochs: NDArray[np.int64]

    def part(self, first: int, end: int) -> list[Request]:
        """Requests of the positions from `first` to before `end`."""
        return list(zip(self.epochs[first:end].tolist(), self.indices[first:end].tolist(), strict=True))


class Batch(TypedDict):
    """A batch of B samples, as a loader gives it: a dictionary.

    range: float32 [B, 1, H, W], metres, 0 is background; with `metres=False` uint16 in steps.
    labels: uint8 [B, H, W], classes of `RangeImages.label_map`, by default the set's own; 255 is background.
    key: keys of the B samples. epoch: the B epochs of their draws, which differ only in a batch of a `Mixture`.
    index: their places in `images.keys`, as `describe` and `table` take them; a `Mixture` has only `keys`.
    planes: name -> uint8 or uint16 [B, H, W]; there only if the images were opened with `planes`.
    """

    range: torch.Tensor
    labels: torch.Tensor
    key: list[str]
    index: list[int]
    epoch: list[int]
    planes: NotRequired[dict[str, torch.Tensor]]


class ImageSet(ABC, Dataset[dict[str, Any]]):
    """Images that `loader` and `BatchOrder` read, epoch after epoch: base of `RangeImages` and `Mixture`.

    `len()` is the number of samples in an epoch. An index is that of a stored sample. epoch: of the next pass.
    epochs_set: number of calls of `set_epoch` so far. sets: the sets of shards that are read, in their order. planes:
    name -> type of the further images that batches hold.
    """

    epoch: int
    epochs_set: int = 0
    split: str | None
    variant: str
    shape: tuple[int, int]
    step_m: float
    label_map: LabelMap
    planes: Mapping[str, np.dtype[Any]]

    @property
    @abstractmethod
    def sets(self) -> tuple[Any, ...]: ...  # `RangeImages`, which are made from what stands here

    @abstractmethod
    def __len__(self) -> int: ...

    @abstractmethod
    def identity(self) -> dict[str, Any]:
        """All that batches depend on besides their order, as plain JSON."""

    @abstractmethod
    def requests(self, epoch: int, shuffle: Shuffle = True) -> Requests:
        """Samples of an epoch in the order of a pass: a function of the seeds and the epoch alone."""

    @abstractmethod
    def location(self, index: int) -> tuple[str, str, int]:
        """(shard name, key, byte offset in the shard) of a sample."""

    @abstractmethod
    def places(self, index: int) -> list[Place]:
        """Places of a sample's bytes."""

    @abstractmethod
    def clean(self, index: int) -> Sample:
        """Return the stored sample, without artifacts."""

    @abstractmethod
    def write(self, index: int, epoch: int, image: Range, labels: Labels, planes: Sequence[NDArray[Any]] = ()) -> None:
        """Write a sample, as drawn in `epoch`, into arrays [H, W]; planes: one for each of `self.planes`."""

    @abstractmethod
    def evenly_sampled(self, count: int) -> NDArray[np.int64]:
        """Return indices of about `count` samples that stand for the whole, int64 [M]."""

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch of the draws for indexing, and of a loader's next pass."""
        self.epoch = check_epoch(epoch)
        self.epochs_set += 1

    def batches(
        self,
        batch_size: int,
        shuffle: Shuffle | None = None,
        drop_last: bool = False,
        rank: int | None = None,
        world_size: int | None = None,
    ) -> BatchOrder:
        """`batch_sampler` for torch's DataLoader or torchdata's StatefulDataLoader; options as for `loader`."""
        return BatchOrder(self, batch_size, shuffle, drop_last, rank, world_size)


def check_index(index: Any, count: int) -> int:
    """Return the index, 0 to before `count`, of a sample of `count`; a negative one counts from the end.

    Raises BadConfig for anything but a whole number, IndexError beyond the samples.
    """
    try:
        number = operator.index(index)
    except TypeError:
        raise BadConfig(f"a sample's index must be a whole number, found {index!r}") from None
    if not -count <= number < count:
        raise IndexError(f"index {number} of {count} samples")
    return number % count


def find_rank(rank: int | None = None, world_size: int | None = None) -> tuple[int, int]:
    """Return (rank, world_size): as given, else torch.distributed's, else torchrun's variables, else (0, 1).

    torchrun sets RANK and WORLD_SIZE in the environment. Raises BadConfig for values that are no rank.
    """
    if (rank is None) != (world_size is None):
        raise BadConfig(f"rank and world_size are given together or not at all, found {rank!r} of {world_size!r}")
    if rank is None or world_size is None:
        rank, world_size = _distributed_rank()
    rank, world_size = check_int("rank", rank, 0), check_int("world_size", world_size, 1)
    if rank >= world_size:
        raise BadConfig(f"rank must be less than world_size, found {rank} of {world_size}")
    return rank, world_size


def _distributed_rank() -> tuple[int, int]:
    if torch.distributed.is_available() and torch.distributed.is_initialized():
        return torch.distributed.get_rank(), torch.distributed.get_world_size()
    found = os.environ.get("RANK"), os.environ.get("WORLD_SIZE")
    if found[0] is None or found[1] is None:
        return 0, 1
    try:
        return int(found[0]), int(found[1])
    except ValueError:
        raise BadConfig(f"RANK and WORLD_SIZE must be whole numbers, found {found[0]!r} and {found[1]!r}") from None


_FRAMES_UP: Final = 8
_DISPATCHER: Final = "DataLoaderDispatcher"  # of Accelerate: reads on rank 0 alone, and cuts each batch


def _other_sharding(frame: FrameType | None) -> str | None:
    """Name the object that divides batches among ranks, if a method of one is on the stack from `frame` up, else None.

    Frameworks wrap a loader's batch sampler, or the loader, without telling it: only the stack of calls shows them.
    """
    for _ in range(_FRAMES_UP):
        if frame is None:
            return None
        # Only of methods: the locals of a function, once asked for, live as long as its frame.
        caller = frame.f_locals.get("self") if "self" in frame.f_code.co_varnames[:1] else None
        ranks = getattr(caller, "num_processes", getattr(caller, "num_replicas", 1))
        if (isinstance(caller, Sampler) and ranks > 1) or type(caller).__name__ == _DISPATCHER:
            return type(caller).__name__
        frame = frame.f_back
    return None


def batch_bounds(samples: int, start: int, batch_size: int, world_size: int, drop_last: bool) -> list[int]:
    """Positions at which the global batches of an epoch begin, from `start` on, and the end of the last one.

    The last batch may be shorter; if it has fewer samples than ranks, it takes some from the batch before. `drop_last`
    leaves it out. Raises BadConfig if the ranks cannot all get the same number of batches.
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
    """One pass over an epoch, or the rest of one. order: of the epoch's samples; bounds: see `batch_bounds`."""

    epoch: int
    order: Requests
    bounds: list[int]
    rank: int
    world_size: int

    def __len__(self) -> int:
        return len(self.bounds) - 1

    def batch(self, number: int) -> list[Request]:
        """Requests of this rank's part of a global batch: nearly equal parts, side by side."""
        first, end = self.bounds[number], self.bounds[number + 1]
        own, after = (first + (end - first) * rank // self.world_size for rank in (self.rank, self.rank + 1))
        return self.order.part(own, after)

    def places(self, images: ImageSet) -> Iterator[Place]:
        """Places of the bytes of this rank's samples, in their order."""
        apart = replace(self, order=replace(self.order, indices=copy.copy(self.order.indices)))
        for number in range(len(self)):
            for _, index in apart.batch(number):
                yield from images.places(index)


class BatchOrder(Sampler[list[Request]]):
    """Batch sampler that yields lists of (epoch of the draws, index); every pass is the next epoch.

    `Loader` uses it, and torch's DataLoader and torchdata's StatefulDataLoader over `RangeImages` or a `Mixture` can:

        DataLoader(images, batch_sampler=images.batches(20), num_workers=2, persistent_workers=True)

    Its state counts the batches it has yielded, which StatefulDataLoader records batch by batch. A plain DataLoader
    with workers draws batches in advance: call `state_dict(batches=done)` there. Where a framework shares batches out,
    too, a pass raises BadConfig: see docs/how-to/frameworks.md.
    """

    def __init__(
        self,
        images: ImageSet,
        batch_size: int,
        shuffle: Shuffle | None = None,
        drop_last: bool = False,
        rank: int | None = None,
        world_size: int | None = None,
    ) -> None:
        if isinstance(images, Sampler):  # Lightning makes a loader's batch sampler anew, around a sampler of its own
            raise BadConfig(
                f"batches() shares samples out itself and cannot take a {type(images).__name__}: give Lightning's "
                "Trainer, or Fabric's setup_dataloaders, use_distributed_sampler=False; to predict, give it a loader()"
            )
        self.images, self.drop_last = images, check_bool("drop_last", drop_last)
        self.batch_size = check_int("batch_size", batch_size, 1)
        if shuffle is None:
            shuffle = images.split == "train"
        choices = "True, False or 'blocks'"
        self.shuffle: Shuffle = "blocks" if shuffle == "blocks" else check_bool("shuffle", shuffle, choices)
        self._found_rank = rank is None
        self.rank, self.world_size = find_rank(rank, world_size)
        if len(images) < self.world_size:
            raise BadConfig(f"{len(images)} samples are fewer than {self.world_size} ranks: use fewer ranks")
        if not len(self):
            each = f" on each of {self.world_size} ranks" if self.world_size > 1 else ""
            raise BadConfig(
                f"{len(images)} samples are too few: they do not fill one batch of {self.batch_size}{each}, and what "
                "does not is left out (drop_last=True); use a smaller batch_size"
            )
        self.largest = min(self.batch_size, -(-len(images) // self.world_size))
        """Size of the largest batch that one rank can get, in samples."""
        self._next = (images.epoch, 0)
        self._reached: tuple[int, int] | None = None
        self._epochs_set = images.epochs_set
        self._pass: Pass | None = None

    def __repr__(self) -> str:
        return (
            f"BatchOrder({self.images!r}, batch_size={self.batch_size}, shuffle={self.shuffle}, "
            f"drop_last={self.drop_last}, rank={self.rank}, world_size={self.world_size}, batches={len(self)})"
        )

    def _bounds(self, start: int) -> list[int]:
        return batch_bounds(len(self.images), start, self.batch_size, self.world_size, self.drop_last)

    def __len__(self) -> int:
        """Number of batches in a whole pass, the same for every rank."""
        return len(self._bounds(0)) - 1

    @property
    def epoch(self) -> int:
        """The epoch of the next pass."""
        self._follow_images()
        return self._next[0]

    def set_epoch(self, epoch: int) -> None:
        """Make `epoch` the next pass: from its start, or from the position of a loaded state of the same epoch."""
        if check_epoch(epoch) != self._next[0]:
            self._next = (int(epoch), 0)
        self._reached = None

    def _follow_images(self) -> None:
        if self._epochs_set != self.images.epochs_set:
            self._epochs_set = self.images.epochs_set
            self.set_epoch(self.images.epoch)

    def begin_pass(self, sharded: bool = False) -> Pass:
        """Start the next pass and return it. sharded: whether its batches are shared out to ranks afterwards.

        Raises BadConfig if the rank was looked for before there were several.
        """
        if self._found_rank and not sharded and (ranks := find_rank()[1]) > self.world_size:
            raise BadConfig(
                f"batches were made for {self.world_size} rank, before the process group of {ranks}: create them after "
                "it, or give rank and world_size"
            )
        self._follow_images()
        epoch, start = self._next
        order = self.images.requests(epoch, self.shuffle)
        self._pass = Pass(epoch, order, self._bounds(start), self.rank, self.world_size)
        self._reached = self._next
        self._next = (epoch + 1, 0)
        return self._pass

    def mark_delivered(self, batches: int) -> None:
        """Record that so many batches of the current pass are delivered."""
        if self._pass is not None:
            self._reached = (self._pass.epoch, self._pass.bounds[batches])

    def end_pass(self) -> None:
        """Record that the current pass is complete."""
        self._reached = None

    def __iter__(self) -> Iterator[list[Request]]:
        """Batches of the next pass. Raises BadConfig where they are shared out to ranks twice, or never."""
        caller = sys._getframe(1)
        above = caller.f_back if caller.f_code.co_name == "_restore_main_state" else None
        state = {} if above is None else above.f_locals.get("next_iter_state", {})
        if state.get("_iterator_finished") and not state.get("_steps_since_snapshot"):
            return iter(())  # torchdata's loader, with workers, resumes a pass that had ended: it drops what this gives
        other = _other_sharding(caller)
        if other is not None and self.world_size > 1:
            raise BadConfig(
                f"batches are shared out to {self.world_size} ranks, and {other} would share them out again and lose "
                f"samples: use batches({self.batch_size}, rank=0, world_size=1) or loader() there, or leave the loader "
                "out of Accelerate's prepare"
            )
        return self._batches(other is not None)

    def _batches(self, sharded: bool) -> Iterator[list[Request]]:
        this = self.begin_pass(sharded)
        for number in range(len(this)):
            self.mark_delivered(number + 1)
            yield this.batch(number)
        self.end_pass()

    def state_dict(self, batches: int | None = None) -> dict[str, Any]:
        """Position in the current pass, or after `batches` of its batches: plain JSON, the same on every rank."""
        self._follow_images()
        epoch, position = self._next if self._reached is None else self._reached
        if batches is not None:
            if self._pass is None or not 0 <= batches <= len(self._pass):
                raise BadConfig(f"batches must be a number of batches of the current pass, found {batches!r}")
            epoch, position = self._pass.epoch, self._pass.bounds[batches]
        return {"format": STATE_FORMAT, "epoch": epoch, "position": position, **self._identity()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Make the next pass continue at the position of `state`; the end of an epoch means the next epoch.

        Takes the same time for every position. Raises BadConfig for the state of other samples, variant, seed, or
        order, and if fewer samples are left than there are ranks.
        """
        epoch, position = _checked_position(state, self._identity())
        if len(self._bounds(position)) == 1:
            epoch, position = epoch + 1, 0
        self._next, self._reached, self._pass = (epoch, position), None, None
        self._epochs_set = self.images.epochs_set

    def _identity(self) -> dict[str, Any]:
        return {"samples": len(self.images), **self.images.identity(), "shuffle": self.shuffle}


def _checked_position(state: Any, identity: dict[str, Any]) -> tuple[int, int]:
    found = state.get("format") if isinstance(state, dict) else type(state).__name__
    if found != STATE_FORMAT:
        raise BadConfig(f"a state's 'format' must be {STATE_FORMAT!r}, found {found!r}")
    there = {field: value for field, value in state.items() if field not in _PROGRESS}
    for field in identity | there:
        if there.get(field) != identity.get(field):
            name, before, now = first_difference(field, there.get(field), identity.get(field))
            raise BadConfig(f"the state belongs to another run: {name} {before!r}, here {now!r}")
    epoch, position = (state.get(field) for field in ("epoch", "position"))
    if type(epoch) is not int or epoch < 0 or type(position) is not int or not 0 <= position <= identity["samples"]:
        numbers = f"whole numbers from 0 on, position at most {identity['samples']}"
        raise BadConfig(f"a state's epoch and position must be {numbers}, found {epoch!r} and {position!r}")
    return epoch, position


def first_difference(name: str, there: Any, here: Any) -> tuple[str, Any, Any]:
    """Name and values of the innermost part in which two JSON values differ, as `mixture[1].variant`; None: absent."""
    if isinstance(there, dict) and isinstance(here, dict):
        pairs = [(f"{name}.{field}", there.get(field), here.get(field)) for field in [*here, *there]]
    elif isinstance(there, list) and isinstance(here, list) and len(there) == len(here):
        pairs = [(f"{name}[{at}]", *both) for at, both in enumerate(zip(there, here, strict=True))]
    else:
        return name, there, here
    return next((first_difference(*pair) for pair in pairs if pair[1] != pair[2]), (name, there, here))
