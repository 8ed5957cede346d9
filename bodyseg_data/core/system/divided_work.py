"""Loops over many elements, divided among threads: compiled ones run side by side, as they leave Python's lock."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


def pieces(count: int, parts: int) -> list[tuple[int, int]]:
    """Divide 0 .. count into `parts` runs of nearly equal length, each (first, behind the last)."""
    return list(itertools.pairwise(count * part // parts for part in range(parts + 1)))


def in_threads(work: Callable[[int, int], object], runs: list[tuple[int, int]]) -> None:
    """Call `work` with the ends of each run, all at once: the first in this thread. Raises what `work` does."""
    others = [_threads().submit(work, *run) for run in runs[1:]]
    try:
        work(*runs[0])
    finally:
        for other in others:
            other.result()


def of_each(function: Callable[[Item], Result], items: Sequence[Item], threads: int) -> list[Result]:
    """Call `function` with each item, in at most so many threads, this one among them: each takes the next that is
    left. Returns the results in the order of the items; raises what `function` does.
    """
    left: Iterator[tuple[int, Item]] = iter(list(enumerate(items)))  # one step of it is never taken by two threads
    found: dict[int, Result] = {}

    def work(_first: int, _behind: int) -> None:
        for number, item in left:
            found[number] = function(item)

    in_threads(work, pieces(len(items), max(1, min(threads, len(items)))))
    return [found[number] for number in range(len(items))]


@lru_cache(maxsize=1)
def _threads() -> ThreadPoolExecutor:
    """Threads that stay: to start one for each call takes a third of a millisecond, as long as much of the work."""
    return ThreadPoolExecutor(os.cpu_count(), "divided work")


if hasattr(os, "register_at_fork"):  # not on Windows, which has no fork
    os.register_at_fork(after_in_child=_threads.cache_clear)  # a child has none of its parent's threads
