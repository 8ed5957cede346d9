"""Protocol of the images that a loader reads, of one set of shards or of a mixture; and the batches it delivers."""

from __future__ import annotations

import operator
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Protocol, TypedDict, runtime_checkable

import numpy as np
import torch
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.kernels import compiled, use_compiled
from bodyseg_data.core.labels.label_map import LabelMap
from bodyseg_data.core.randomness import Permutation
from bodyseg_data.core.sample import Sample

if TYPE_CHECKING:
    from bodyseg_data.loading.batch_order import BatchOrder

Request = tuple[int, int]
"""(epoch, index) of a sample: with its epoch, so that workers kept over several epochs need no other message."""


@dataclass(frozen=True)
class Requests:
    """Samples of one epoch in the order of a pass.

    indices: int64 [N], or a `Permutation`, whose slices are. epochs: int64 [N], of each sample's draws.
    """

    indices: NDArray[np.int64] | Permutation
    epochs: NDArray[np.int64]

    def part(self, first: int, end: int) -> list[Request]:
        """Requests of the positions from `first` to before `end`."""
        return list(zip(self.epochs[first:end].tolist(), self.indices[first:end].tolist(), strict=True))


class Batch(TypedDict):
    """Batch of B samples. range: float32 [B, 1, H, W], metres, 0 is background; with `metres=False` uint16 in steps.

    labels: uint8 [B, H, W], classes of `RangeImages.label_map`, by default the parts 0 to 32; 255 is background. key:
    the B samples' keys. epoch: the B epochs of their draws, which differ in a batch of a `Mixture` only.
    """

    range: torch.Tensor
    labels: torch.Tensor
    key: list[str]
    epoch: list[int]


@runtime_checkable
class ImageSet(Protocol):
    """Images that `loader` and `BatchOrder` read: `RangeImages` or a `Mixture`.

    `len()` is the number of samples in an epoch. An index is that of a stored sample. epoch: of the next pass.
    epochs_set: number of calls of `set_epoch` so far. sets: the sets of shards that are read, in their order.
    """

    @property
    def epoch(self) -> int: ...
    @property
    def epochs_set(self) -> int: ...
    @property
    def split(self) -> str | None: ...
    @property
    def variant(self) -> str: ...
    @property
    def shape(self) -> tuple[int, int]: ...
    @property
    def step_m(self) -> float: ...
    @property
    def label_map(self) -> LabelMap: ...
    @property
    def sets(self) -> tuple[Any, ...]: ...  # `RangeImages`, which are made from what stands here

    def __len__(self) -> int: ...

    def identity(self) -> dict[str, Any]:
        """All that batches depend on besides their order, as plain JSON."""
        ...

    def requests(self, epoch: int, shuffle: bool = True) -> Requests:
        """Samples of an epoch in the order of a pass: a function of the seeds and the epoch alone."""
        ...

    def location(self, index: int) -> tuple[str, str, int]:
        """(shard name, key, byte offset in the shard) of a sample."""
        ...

    def clean(self, index: int) -> Sample:
        """Return the stored sample, without artifacts."""
        ...

    def write(self, index: int, epoch: int, image: NDArray[np.uint16], labels: NDArray[np.uint8]) -> None:
        """Write a sample, as drawn in `epoch`, into arrays [H, W]."""
        ...

    def evenly_sampled(self, count: int) -> NDArray[np.int64]:
        """Return indices of about `count` samples that stand for the whole, int64 [M]."""
        ...

    def batches(
        self,
        batch_size: int,
        shuffle: bool | None = None,
        drop_last: bool = False,
        rank: int | None = None,
        world_size: int | None = None,
    ) -> BatchOrder:
        """Return the assignment of samples to batches; options as for `loader`."""
        ...


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


def metres(steps: NDArray[np.uint16], step_m: float, out: NDArray[np.float32] | None = None) -> NDArray[np.float32]:
    """Convert stored steps to metres, rounded once: float32(steps) * float32(step_m).

    step_m: one step, metres (`RangeImages.step_m`). out: float32 array to write into, of the same shape.
    """
    if out is not None and steps.shape == out.shape and steps.flags.carray and out.flags.carray and use_compiled():
        _compiled_scale()(steps.reshape(-1), np.float32(step_m), out.reshape(-1))
        return out
    found: NDArray[np.float32] = np.multiply(steps, np.float32(step_m), out=out)
    return found


def _scale(steps: Any, step_m: Any, out: Any) -> None:
    """Write float32(steps) * step_m in one pass; steps: uint16 [N], step_m: float32, out: float32 [N]."""
    for i in range(np.uint64(out.size)):
        out[i] = np.float32(steps[i]) * step_m


@lru_cache(maxsize=1)
def _compiled_scale() -> Any:
    return compiled(_scale, "converting ranges in a compiled loop")
