"""The interface of a loader's workers, and the form of it that needs neither processes nor threads."""

from __future__ import annotations

import traceback
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, Literal, Protocol

from bodyseg_data.core.errors import BadConfig, WorkerLost

WorkerMethod = Literal["process", "thread"]

DEFAULT_WORKER_METHOD: Final[WorkerMethod] = "thread"
"""Chosen by measurement: docs/results/loading_speed.md."""

_WORKER_METHODS: Final[tuple[WorkerMethod, ...]] = ("process", "thread")

END_TIMEOUT_S: Final = 5.0
"""Time for a worker to finish its request after it was told to end, seconds."""


def check_worker_method(method: str) -> None:
    """Raise BadConfig unless `method` is one."""
    if method not in _WORKER_METHODS:
        raise BadConfig(f"worker_method must be {' or '.join(_WORKER_METHODS)}, found {method!r}")


class Workers(Protocol):
    """Handles requests by calling one function on each, and gives the results in the order of the requests."""

    def submit(self, request: Any) -> None:
        """Queue a request. Raises WorkerLost if the worker that should take it has ended."""

    def result(self) -> Any:
        """Wait for and return the result of the oldest request. Raises WorkerLost if its worker has ended or failed."""

    def discard(self) -> None:
        """Remove the oldest request, waiting for its result if it may have begun. Raises as `result`."""

    def peaks_mb(self) -> list[float | None]:
        """The most memory that each worker process has had, MB, as `peak_mb`; none for workers in this process."""

    def close(self) -> None:
        """End the workers and remove all requests."""


class InlineWorkers:
    """Workers without processes or threads: a request is handled when its result is fetched, by whoever fetches it."""

    def __init__(self, work: Callable[[Any], Any]) -> None:
        self._work = work
        self._requests: deque[Any] = deque()

    def submit(self, request: Any) -> None:
        """See `Workers.submit`."""
        self._requests.append(request)

    def result(self) -> Any:
        """See `Workers.result`; errors of the function pass through."""
        return self._work(self._requests.popleft())

    def discard(self) -> None:
        """See `Workers.discard`."""
        self._requests.popleft()

    def peaks_mb(self) -> list[float | None]:
        """See `Workers.peaks_mb`."""
        return []

    def close(self) -> None:
        """See `Workers.close`."""
        self._requests.clear()


@dataclass(frozen=True)
class Failure:
    """Unexpected error in a worker: its message in one line, and its traceback."""

    line: str
    trace: str


def handle(work: Callable[[Any], Any], request: Any) -> Any:
    """Call `work` with a request; an error of any kind, an exit included, is returned as a Failure."""
    try:
        return work(request)
    except BaseException as error:
        return Failure(" ".join(f"{type(error).__name__}: {error}".split()), traceback.format_exc())


def checked_result(found: Any, worker: str) -> Any:
    """Return what `handle` gave. Raises WorkerLost for a Failure, with its traceback as a note; worker: its name."""
    if not isinstance(found, Failure):
        return found
    error = WorkerLost(f"{worker} failed: {found.line}")
    error.add_note(found.trace)
    raise error
