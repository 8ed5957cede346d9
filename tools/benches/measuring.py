"""Repeated timing, and choices spread over a set, as all benches use them."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Final, TypeVar

_T = TypeVar("_T")

_STRIDE: Final = 23  # has no divisor in common with 54 views, so few of them already mix azimuths and distances


def least_time(work: Callable[[], _T], rounds: int = 1) -> tuple[float, _T]:
    """Processor seconds of the quickest of `rounds` calls, at least one, and the result of the last."""
    best = float("inf")
    for _ in range(max(1, rounds)):
        start = time.process_time()
        result = work()
        best = min(best, time.process_time() - start)
    return best, result


def evenly_spaced(items: Sequence[_T], count: int) -> list[_T]:
    """`count` of `items`, the middles of as many equal stretches; all if there are fewer."""
    count = min(count, len(items))
    return [items[(2 * number + 1) * len(items) // (2 * count)] for number in range(count)]


def mixed(items: Sequence[_T], number: int) -> _T:
    """The item `number` of an order in which neighbours differ widely, repeated without end."""
    return items[number * _STRIDE % len(items)]
