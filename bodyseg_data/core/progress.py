"""Progress of long work, as the functions that do it report it, and the time of its stages."""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

ProgressCallback = Callable[[int, int], None]
"""Function that is called with the amount of work done and the amount in all."""

NotedProgress = Callable[[int, int, str], None]
"""A `ProgressCallback` that is told in words, too, what was done."""


def silent(done: int, total: int, note: str = "") -> None:
    """Report no progress. note: words on what is being done, as some work gives them."""


class Stopwatch:
    """Sums the time of each stage: `with watch("network"): ...`. milliseconds: stage -> sum."""

    def __init__(self, stages: Sequence[str]) -> None:
        self.milliseconds = dict.fromkeys(stages, 0.0)

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.milliseconds[stage] += 1000 * (time.perf_counter() - start)
