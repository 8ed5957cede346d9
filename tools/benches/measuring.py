"""Figures, repeated timing, its conditions, and choices spread over a set, as all benches use them."""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final, TypeVar

_T = TypeVar("_T")


class Figures(dict[str, Any]):
    """Figures of a bench, and beside them, for its picture alone, what no file holds, such as labelled frames."""

    def __init__(self, content: dict[str, Any], shown: Any) -> None:
        super().__init__(content)
        self.shown = shown


_STRIDE: Final = 23  # has no divisor in common with 54 views, so few of them already mix azimuths and distances
_SIBLINGS: Final = Path("/sys/devices/system/cpu/cpu0/topology/thread_siblings_list")


def counter(progress: Callable[..., None], total: int) -> Callable[..., None]:
    """A function that counts one more piece of work as done, or as many as it is given, and reports how many are.

    Notes that it is given go to a progress that takes them.
    """
    done = 0

    def advance(count: int = 1, *note: str) -> None:
        nonlocal done
        done += count
        progress(done, total, *note)

    return advance


def median_time(work: Callable[[], _T], rounds: int = 1) -> tuple[float, _T]:
    """Processor seconds of a call, the median of `rounds` of them, at least one, and the result of the last."""
    seconds = []
    for _ in range(max(1, rounds)):
        start = time.process_time()
        result = work()
        seconds.append(time.process_time() - start)
    return statistics.median(seconds), result


def medians(rounds: Sequence[Any]) -> Any:
    """Trees of figures of several rounds as one tree, in which every number is the median of all rounds that have it.

    None where a round has None. Anything else but dictionaries and numbers is that of the first round.
    """
    first = rounds[0]
    if isinstance(first, dict):
        names = dict.fromkeys(name for one in rounds for name in one)
        return {name: medians([one[name] for one in rounds if name in one]) for name in names}
    if any(one is None for one in rounds):
        return None
    if isinstance(first, bool) or not isinstance(first, int | float):
        return first
    return statistics.median(rounds)


class Conditions:
    """Other work of a machine while a bench runs, from the moment at which this is made."""

    def __init__(self) -> None:
        self._before = _load()

    def to_json(self) -> dict[str, Any]:
        """threads_per_core: processors of the system that share one core, None where it does not say.

        load_before, load_after: the mean number of programs that were ready to run in the minute before the bench
        began, and in that before this call, which has the bench's own in it.
        """
        return {"threads_per_core": threads_per_core(), "load_before": self._before, "load_after": _load()}


def threads_per_core(siblings: Path = _SIBLINGS) -> int | None:
    """Processors that share a core with the first one, itself included; None where the system does not say.

    siblings: a list as Linux writes it, "0,64" or "0-1".
    """
    try:
        spans = [[int(end) for end in span.split("-")] for span in siblings.read_text().split(",")]
    except (OSError, ValueError):
        return None
    return sum(span[-1] - span[0] + 1 for span in spans)


def _load() -> float | None:
    return round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None


def evenly_spaced(items: Sequence[_T], count: int) -> list[_T]:
    """`count` of `items`, the middles of as many equal stretches; all if there are fewer."""
    count = min(count, len(items))
    return [items[(2 * number + 1) * len(items) // (2 * count)] for number in range(count)]


def mixed(items: Sequence[_T], number: int) -> _T:
    """The item `number` of an order in which neighbours differ widely, repeated without end."""
    return items[number * _STRIDE % len(items)]
