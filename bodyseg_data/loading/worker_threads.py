"""Worker threads of this process: they start at once, share all memory, and run side by side where the GIL is released.

Reading, checksums, zstd and the compiled loops release it; the Python code between them takes turns.
"""

from __future__ import annotations

import os
import threading
from collections import deque
from collections.abc import Callable
from queue import Empty, SimpleQueue
from typing import Any

from bodyseg_data.core.errors import WorkerLost
from bodyseg_data.loading.workers import END_TIMEOUT_S, checked_result, handle

_Answers = SimpleQueue[tuple[int, Any]]
_Requests = SimpleQueue[tuple[Any, _Answers] | None]
"""Requests, each with the queue that its (number of the worker, result) goes to; None ends the thread that takes it."""


class ThreadWorkers:
    """`count` threads, started at once, that take requests from one queue; results come in the order of the requests.

    work: called in the threads, possibly by several at once, with a request. Signals, and hence Ctrl-C, do not reach
    threads. A fork of this process has none of them.
    """

    def __init__(self, work: Callable[[Any], Any], count: int) -> None:
        self._owner = os.getpid()
        self._requests: _Requests = SimpleQueue()
        self._answers: deque[_Answers] = deque()
        self._threads: list[threading.Thread] = []
        try:
            for number in range(count):
                # A daemon: the end of the interpreter would wait for any other before it runs `close`.
                thread = threading.Thread(
                    target=_serve, args=(work, number, self._requests), name=f"bodyseg-worker-{number}", daemon=True
                )
                thread.start()
                self._threads.append(thread)
        except RuntimeError as error:
            started = len(self._threads)
            self.close()
            raise WorkerLost(f"worker {started} of {count} could not be started: {error}; use fewer workers") from error
        except BaseException:
            self.close()
            raise

    def submit(self, request: Any) -> None:
        """See `Workers.submit`: the first thread that is free takes it."""
        answer: _Answers = SimpleQueue()
        self._answers.append(answer)
        self._requests.put((request, answer))

    def result(self) -> Any:
        """See `Workers.result`."""
        number, found = self._answers.popleft().get()
        return checked_result(found, f"worker {number} of {len(self._threads)} (thread)")

    def discard(self) -> None:
        """See `Workers.discard`."""
        self.result()

    def peaks_mb(self) -> list[float | None]:
        """See `Workers.peaks_mb`."""
        return []

    def close(self) -> None:
        """See `Workers.close`: threads end after their current request, which is waited for unless it takes long."""
        if os.getpid() != self._owner:
            return  # this is a fork of the process that started the threads
        try:
            while True:
                self._requests.get_nowait()
        except Empty:
            pass
        for _ in self._threads:
            self._requests.put(None)
        for thread in self._threads:
            if thread is not threading.current_thread():  # the garbage collector may run there
                thread.join(END_TIMEOUT_S)
        self._threads = []
        self._answers.clear()


def _serve(work: Callable[[Any], Any], number: int, requests: _Requests) -> None:
    """Handle requests in a thread until it takes None."""
    while (task := requests.get()) is not None:
        request, answer = task
        found = handle(work, request)
        answer.put((number, found))
        del task, request, answer, found  # or they would live until the next request
