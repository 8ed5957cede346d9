"""Loops over many elements, divided among threads: compiled ones run side by side, as they leave Python's lock."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable


def pieces(count: int, parts: int) -> list[tuple[int, int]]:
    """Divide 0 .. count into `parts` runs of nearly equal length, each (first, behind the last)."""
    return list(itertools.pairwise(count * part // parts for part in range(parts + 1)))


def in_threads(work: Callable[[int, int], object], runs: list[tuple[int, int]]) -> None:
    """Call `work` with the ends of each run, all at once: the first in this thread. `work` must not raise."""
    others = [threading.Thread(target=work, args=run) for run in runs[1:]]
    for thread in others:
        thread.start()
    work(*runs[0])
    for thread in others:
        thread.join()
