"""Results of jobs in the order in which they were asked for, with a bounded number under way."""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future
from typing import TypeVar

Result = TypeVar("Result")


def ordered(jobs: Iterable[Callable[[], Future[Result]]], workers: int) -> Generator[Result, None, None]:
    """The results of jobs, in order. jobs: each submits one. workers: how many to keep busy; memory stays flat.

    The first goes alone: a source may fill a cache on first use, which several workers would do at once. Closing the
    generator cancels the jobs that have not begun.
    """
    submissions = iter(jobs)
    waiting: deque[Future[Result]] = deque()
    try:
        for submit in itertools.islice(submissions, 1):
            yield submit().result()
        for submit in submissions:
            waiting.append(submit())
            if len(waiting) > 2 * max(workers, 1):
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        for future in waiting:
            future.cancel()
