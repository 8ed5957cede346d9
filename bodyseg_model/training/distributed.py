"""Distributed training: torchrun's process group, and the device of each process."""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass

import torch
import torch.distributed

from bodyseg_data.core import check_int
from bodyseg_data.loading import find_rank
from bodyseg_data.machine import MOST_THREADS, processors
from bodyseg_model.networks import find_device


@dataclass(frozen=True)
class ProcessGroup:
    """Process number `rank` of `world_size`, which computes on `device`."""

    rank: int
    world_size: int
    device: torch.device

    @property
    def first(self) -> bool:
        """True in the one process that writes files and reports."""
        return self.rank == 0

    def add_up(self, values: torch.Tensor) -> torch.Tensor:
        """Sum `values` over all processes, in place; every process gets the sum."""
        if self.world_size > 1:
            torch.distributed.all_reduce(values)
        return values

    def wait(self) -> None:
        """Wait until all processes call this."""
        self.add_up(torch.zeros((), device=self.device)).item()


@contextlib.contextmanager
def joined_process_group(device: str | None = None) -> Iterator[ProcessGroup]:
    """Join torchrun's process group, if there is one, while the context lasts; the caller's own, if it has joined.

    device: see `find_device`. Raises BadConfig.
    """
    rank, world_size = find_rank()
    chosen = find_device(device)
    if joins := world_size > 1 and not torch.distributed.is_initialized():
        torch.distributed.init_process_group("nccl" if chosen.type == "cuda" else "gloo")
    try:
        yield ProcessGroup(rank, world_size, chosen)
    finally:
        if joins:
            torch.distributed.destroy_process_group()


def use_threads(count: int | None) -> int:
    """Set the number of threads of torch, 1 to `MOST_THREADS`, and return it; None: `processors` at most."""
    most = min(torch.get_num_threads(), processors())
    torch.set_num_threads(most if count is None else check_int("--threads", count, 1, MOST_THREADS))
    return torch.get_num_threads()
