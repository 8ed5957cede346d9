"""Writing beside computing: jobs that one thread does in order while the caller goes on."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from types import TracebackType
from typing import Final

Job = Callable[[], None]

MOST_WAITING: Final = 3
"""Jobs that may wait, so that slow disks bound memory; then `add` waits, too."""


class WriteBehind:
    """Does jobs one after another in a thread, in the order of `add`, as a context manager.

    At the end of the context every job is done, also where it ends by an error or Ctrl-C. After a job fails, later
    jobs are dropped; the error is raised by the next `add`, or at the end of the context.
    """

    def __init__(self, most_waiting: int = MOST_WAITING) -> None:
        self._jobs: queue.Queue[Job | None] = queue.Queue(most_waiting)
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._work, name="writing")

    def __repr__(self) -> str:
        return f"WriteBehind({self._jobs.qsize()} of at most {self._jobs.maxsize} jobs wait)"

    def __enter__(self) -> WriteBehind:
        self._thread.start()
        return self

    def add(self, job: Job) -> None:
        """Have a job done after all others. Raises the error of an earlier one."""
        if self._error is not None:
            raise self._error
        self._jobs.put(job)

    def _work(self) -> None:
        while (job := self._jobs.get()) is not None:
            if self._error is None:
                try:
                    job()
                except Exception as error:
                    self._error = error

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._jobs.put(None)
        self._thread.join()
        # A job's error came before one of the frames after it, but not before Ctrl-C.
        if self._error is not None and self._error is not error and (error is None or isinstance(error, Exception)):
            raise self._error
