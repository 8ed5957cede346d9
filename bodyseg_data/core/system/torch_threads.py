"""Threads in which torch computes: their number, on which the bits of its sums depend, and how they wait."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager


def wait_briefly() -> None:
    """Let torch's threads sleep after 10 000 turns of waiting for each other instead of 300 000.

    The user's own GOMP_SPINCOUNT or OMP_WAIT_POLICY is left as it is. A thread that waits busily takes a processor from
    the very thread it waits for, as soon as another program is running: the network of bodies then takes 0.4 s a frame
    instead of 0.04. GNU's OpenMP reads the variable when it is loaded, so this comes before `import torch`.
    """
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", "10000")


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Set the number of threads in which torch computes while the context lasts."""
    import torch  # not above: most of what loads this module never computes with it

    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
