"""Batches of range images, made in worker processes."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from torch.utils.data import DataLoader, Dataset, Sampler

from bodyseg_data.errors import BadConfig, BodysegError
from bodyseg_data.streaming import Batch, PackedBatch, RangeImages, metres, pack_batch

Order = tuple[int, int]
"""(epoch, index): what a worker is asked for, so that workers that outlive an epoch need not be told of the next."""


class _Requests(Dataset["PackedBatch | BodysegError"]):
    """What runs in a worker: a whole batch a request."""

    def __init__(self, images: RangeImages) -> None:
        self._images = images

    def __getitem__(self, orders: list[Order]) -> PackedBatch | BodysegError:
        try:
            return pack_batch([self._images.image(index, epoch) for epoch, index in orders])
        except BodysegError as error:
            return error  # raised where the user is, as one line, without the traceback a worker would add


class _Plan(Sampler[list[Order]]):
    """The requests of the pass under way."""

    def __init__(self) -> None:
        self.requests: list[list[Order]] = []

    def __iter__(self) -> Iterator[list[Order]]:
        return iter(self.requests)

    def __len__(self) -> int:
        return len(self.requests)


class Loader:
    """Iterates over batches, pass after pass; every pass is another epoch with another order and other draws.

    The first pass is the images' `epoch`. `images.set_epoch(n)` makes the next pass epoch n. Make one loader and use it
    for all epochs: a new one starts where `images.epoch` says, and starts its workers anew. One pass runs at a time.
    """

    def __init__(self, images: RangeImages, batch_size: int, workers: int, shuffle: bool, drop_last: bool) -> None:
        for name, value, least in (("batch_size", batch_size, 1), ("workers", workers, 0)):
            if isinstance(value, bool) or not isinstance(value, int) or value < least:
                raise BadConfig(f"{name} must be a whole number of at least {least}, found {value!r}")
        self.images, self.batch_size, self.shuffle, self.drop_last = images, batch_size, shuffle, drop_last
        self._next_epoch, self._epochs_set = images.epoch, images.epochs_set
        self._plan = _Plan()
        self._passes = 0
        self._worker_count = workers
        self._workers = self._new_workers()

    def _new_workers(self) -> DataLoader[PackedBatch | BodysegError]:
        """Starts no process yet; the first pass does."""
        return DataLoader(
            _Requests(self.images),
            batch_size=None,  # a request is a batch already
            collate_fn=_as_it_is,
            sampler=self._plan,
            num_workers=self._worker_count,
            persistent_workers=self._worker_count > 0,
        )

    def __len__(self) -> int:
        whole, rest = divmod(len(self.images), self.batch_size)
        return whole + (rest > 0 and not self.drop_last)

    @property
    def epoch(self) -> int:
        """The epoch of the next pass."""
        return self.images.epoch if self._epochs_set != self.images.epochs_set else self._next_epoch

    def __iter__(self) -> Iterator[Batch]:
        epoch = self.epoch
        self._next_epoch, self._epochs_set = epoch + 1, self.images.epochs_set
        order = self.images.order(epoch, self.shuffle).tolist()
        starts = range(0, len(self) * self.batch_size, self.batch_size)
        self._plan.requests = [[(epoch, index) for index in order[s : s + self.batch_size]] for s in starts]
        self._passes += 1
        this = self._passes
        for packed in self._workers:
            if isinstance(packed, BodysegError):
                # Let the workers end now, and raise another object than `packed`, which would tie itself and this
                # frame into a cycle: ended by the garbage collector, workers are waited for until a time-out.
                self._workers = self._new_workers()
                raise type(packed)(str(packed))
            yield metres(packed)
            if self._passes != this:
                raise BadConfig("a loader gives one pass at a time, and a newer one has begun: make another loader")


def _as_it_is(packed: Any) -> Any:
    return packed


def loader(
    images: RangeImages,
    batch_size: int,
    workers: int = 0,
    shuffle: bool | None = None,
    drop_last: bool = False,
) -> Loader:
    """Batches of `images`, made in `workers` processes (0: in this one); see `Batch` for what a batch holds.

    shuffle: None shuffles the train split and nothing else. drop_last: leave out a last batch that is not full.

    Raises BadConfig.
    """
    shuffled = images.split == "train" if shuffle is None else shuffle
    return Loader(images, batch_size, workers, shuffled, drop_last)
