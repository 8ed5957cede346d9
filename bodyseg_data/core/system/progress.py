"""Progress of long work, as the functions that do it report it."""

from __future__ import annotations

from collections.abc import Callable

ProgressCallback = Callable[[int, int], None]
"""Function that is called with the amount of work done and the amount in all."""


def silent(done: int, total: int, note: str = "") -> None:
    """Report no progress. note: words on what is being done, as some work gives them."""
