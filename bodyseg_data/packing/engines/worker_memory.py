"""Peak memory of the workers of an executor, which each job's result brings along."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable
from concurrent.futures import Executor, Future, InvalidStateError
from contextlib import suppress
from typing import Any

from bodyseg_data.core.system.memory import peak_mb


class MeasuringExecutor(Executor):
    """Runs jobs on another executor, and keeps the most memory of each worker. It does not own that executor.

    workers_mb: worker (host and process) -> its peak after its last finished job, MB; None where the system does not
    tell. In the order of their first results.
    """

    def __init__(self, executor: Executor) -> None:
        self._executor = executor
        self.workers_mb: dict[str, float | None] = {}

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Queue a job; its future has its own result."""
        result: Future[Any] = Future()

        def finish(measured: Future[Any]) -> None:
            with suppress(InvalidStateError):  # cancelled meanwhile
                if measured.cancelled():
                    result.cancel()
                elif (error := measured.exception()) is not None:
                    result.set_exception(error)
                else:
                    found, worker, peak = measured.result()
                    self.workers_mb[worker] = peak
                    result.set_result(found)

        self._executor.submit(_measured, fn, args, kwargs).add_done_callback(finish)
        return result


def _measured(fn: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]) -> tuple[Any, str, float | None]:
    """In a worker: a job's result, the worker's name, and the most memory that it has had so far."""
    found = fn(*args, **kwargs)
    return found, f"{socket.gethostname()}:{os.getpid()}", peak_mb()
