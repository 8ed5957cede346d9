"""Progress of long work, as the functions that do it report it."""

from __future__ import annotations

from collections.abc import Callable

ProgressCallback = Callable[[int, int], None]
"""Function that is called with the amount of work done and the amount in all."""

NotedProgress = Callable[[int, int, str], None]
"""A `ProgressCallback` that is told in words, too, what was done."""


def silent(done: int, total: int, note: str = "") -> None:
    """Report no progress. note: words on what is being done, as some work gives them."""


def counter(progress: ProgressCallback, total: int) -> Callable[..., None]:
    """A function that counts one more piece of work as done, or as many as it is given, and reports how many are."""
    done = 0

    def advance(count: int = 1) -> None:
        nonlocal done
        done += count
        progress(done, total)

    return advance
