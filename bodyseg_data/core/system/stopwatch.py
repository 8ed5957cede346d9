"""Time of the stages of a computation."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager


class Stopwatch:
    """Sums the time of each stage: `with watch("network"): ...`. milliseconds: stage -> sum."""

    def __init__(self, stages: Sequence[str]) -> None:
        self.milliseconds = dict.fromkeys(stages, 0.0)

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.milliseconds[stage] += 1000 * (time.perf_counter() - start)
