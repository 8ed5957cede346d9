"""Threads of this process: work divided among them, and those of torch.

Compiled loops run side by side, as they leave Python's lock. The bits of torch's sums depend on its number of threads.
"""

import itertools
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import lru_cache
from typing import Final, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")

MOST_THREADS: Final = 1024  # or processes that a user may ask for: OpenMP ends the process if it cannot start them


def pieces(count: int, parts: int) -> list[tuple[int, int]]:
    """Divide 0 .. count into `parts` runs of nearly equal length, each (first, behind the last)."""
    return list(itertools.pairwise(count * part // parts for part in range(parts + 1)))


def of_each(function: Callable[[Item], Result], items: Sequence[Item], threads: int) -> list[Result]:
    """Call `function` with each item, in at most so many threads, this one among them: each takes the next that is
    left. Returns the results in the order of the items; raises what `function` does.
    """
    left: Iterator[tuple[int, Item]] = iter(list(enumerate(items)))  # no two threads get the same item
    found: dict[int, Result] = {}

    def work() -> None:
        for number, item in left:
            found[number] = function(item)

    others = [_threads().submit(work) for _ in range(min(threads, len(items)) - 1)]
    try:
        work()
    finally:
        for other in others:
            other.result()
    return [found[number] for number in range(len(items))]


@lru_cache(maxsize=1)
def _threads() -> ThreadPoolExecutor:
    """Threads that stay: to start one for each call takes a third of a millisecond, as long as much of the work."""
    return ThreadPoolExecutor(os.cpu_count(), "divided work")


os.register_at_fork(after_in_child=_threads.cache_clear)  # a child has none of its parent's threads


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
