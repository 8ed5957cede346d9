"""Number of threads in which torch computes, on which the bits of its sums depend."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


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
