"""One process or several: torchrun's surroundings, and which device each process computes on."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from dataclasses import dataclass

import torch
import torch.distributed

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.loading.batch_order import find_rank


@dataclass(frozen=True)
class ProcessGroup:
    """Process number `rank` of `world_size`, which computes on `device`."""

    rank: int
    world_size: int
    device: torch.device

    @property
    def first(self) -> bool:
        """Whether this is the process that writes files and talks."""
        return self.rank == 0

    def add_up(self, values: torch.Tensor) -> torch.Tensor:
        """The sum of `values` over all processes, in every one of them."""
        if self.world_size > 1:
            torch.distributed.all_reduce(values)
        return values


@contextlib.contextmanager
def joined_process_group(device: str | None = None) -> Iterator[ProcessGroup]:
    """Join torchrun's other processes, if there are any, for as long as the context lasts.

    device: see `find_device`. Raises BadConfig.
    """
    rank, world_size = find_rank()
    chosen = find_device(device)
    if world_size > 1:
        torch.distributed.init_process_group("nccl" if chosen.type == "cuda" else "gloo")
    try:
        yield ProcessGroup(rank, world_size, chosen)
    finally:
        if world_size > 1:
            torch.distributed.destroy_process_group()


def use_threads(count: int | None) -> None:
    """Let torch compute in so many threads of the processor; None: as it is. Raises BadConfig for less than one."""
    if count is None:
        return
    if count < 1:
        raise BadConfig(f"--threads must be at least 1, found {count}")
    torch.set_num_threads(count)


@contextlib.contextmanager
def threads(count: int) -> Iterator[None]:
    """So many threads of the processor for torch, and afterwards as many as before."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def find_device(name: str | None = None) -> torch.device:
    """The device called "cpu", "cuda", "cuda:1" ...; None is the GPU of this process's number, else the processor.

    Raises BadConfig for a device that is not there.
    """
    if name is None:
        name = f"cuda:{os.environ.get('LOCAL_RANK', '0')}" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(name)
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError, ValueError) as error:
        raise BadConfig(f"cannot compute on the device {name!r}: {str(error).splitlines()[0]}") from error
    return device
