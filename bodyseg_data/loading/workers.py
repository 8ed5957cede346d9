"""Worker processes that handle requests in turn, each over its own pipe: no semaphore, thread or named resource."""

from __future__ import annotations

import contextlib
import multiprocessing
import multiprocessing.forkserver
import os
import signal
import traceback
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any, Final, Literal

import torch

from bodyseg_data.core.errors import BadConfig, WorkerLost

StartMethod = Literal["fork", "spawn", "forkserver"]

_JOIN_TIMEOUT_S: Final = 5.0
"""Time for a worker to finish its request after it was told to end, seconds; then it is killed."""

_END: Final = "end"
"""Last request: ends the worker."""

_POLL_S: Final = 1.0
"""Interval at which each side checks that the other is alive, seconds, in case the pipe does not show it."""


class InlineWorkers:
    """Same interface without processes: a request is handled in this process when its result is fetched."""

    def __init__(self, work: Callable[[Any], Any]) -> None:
        self._work = work
        self._requests: deque[Any] = deque()

    def submit(self, request: Any) -> None:
        """Queue a request."""
        self._requests.append(request)

    def result(self) -> Any:
        """Handle the oldest request and return its result."""
        return self._work(self._requests.popleft())

    def discard(self) -> None:
        """Remove the oldest request."""
        self._requests.popleft()

    def close(self) -> None:
        """Remove all requests."""
        self._requests.clear()


@dataclass(frozen=True)
class _Failure:
    """Unexpected error in a worker: its message in one line, and its traceback."""

    line: str
    trace: str


class Workers:
    """`count` processes, started at once. Request n goes to worker n modulo `count`; results come in the same order.

    work: called in the workers, with a request; must be picklable unless processes are forked. A worker ends when its
    pipe closes, hence also when this process ends in any way. Ctrl-C does not reach workers.
    """

    def __init__(self, work: Callable[[Any], Any], count: int, start_method: StartMethod | None) -> None:
        if multiprocessing.current_process().daemon:
            raise BadConfig("a worker process can have no workers of its own: use num_workers=0 there")
        context: Any = multiprocessing.get_context(start_method)
        forked = context.get_start_method() == "fork"
        if context.get_start_method() == "forkserver":
            multiprocessing.forkserver.ensure_running()  # here, or every process it starts would have SIGINT blocked
        self._owner = os.getpid()
        self._pipes: list[Connection] = []
        self._processes: list[Any] = []
        self._submitted = self._received = 0
        self._forked = forked
        # A process starts with the signals blocked that its parent blocks; workers never unblock SIGINT.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            for _ in range(count):
                ours, theirs = context.Pipe()
                self._pipes.append(ours)
                with theirs:
                    inherited = tuple(self._pipes) if forked else ()
                    process = context.Process(target=_serve, args=(work, theirs, inherited), daemon=True)
                    process.start()
                self._processes.append(process)
        except OSError as error:
            started, why = len(self._processes), error.strerror or str(error)
            self.close()
            raise WorkerLost(f"worker {started} of {count} could not be started: {why}; use fewer workers") from error
        except BaseException:
            self.close()
            raise
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)

    def submit(self, request: Any) -> None:
        """Send a request to the next worker. Raises WorkerLost if that worker has ended."""
        worker = self._submitted % len(self._pipes)
        try:
            self._pipes[worker].send(request)
        except OSError:
            raise self._lost(worker) from None
        self._submitted += 1

    def result(self) -> Any:
        """Wait for and return the result of the oldest request. Raises WorkerLost if its worker has ended or failed."""
        worker = self._received % len(self._pipes)
        pipe, process = self._pipes[worker], self._processes[worker]
        try:
            while not pipe.poll(_POLL_S):
                if not process.is_alive() and not pipe.poll():
                    raise EOFError
            found = pipe.recv()
        except (EOFError, OSError):
            raise self._lost(worker) from None
        self._received += 1
        if isinstance(found, _Failure):
            error = WorkerLost(f"{self._name(worker)} failed: {found.line}")
            error.add_note(found.trace)
            raise error
        return found

    def discard(self) -> None:
        """Wait for the result of the oldest request and drop it. Raises as `result`."""
        self.result()

    def _name(self, worker: int) -> str:
        return f"worker {worker} of {len(self._pipes)} (process {self._processes[worker].pid})"

    def _lost(self, worker: int) -> WorkerLost:
        process = self._processes[worker]
        process.join(_POLL_S)
        status = process.exitcode
        how = "closed its pipe" if status is None else f"ended with status {status}"
        if status is not None and status < 0:
            how = f"was ended by signal {-status} ({signal.strsignal(-status)})"
        if status == -signal.SIGKILL:
            how += ", as by a system that is short of memory,"
        hint = ""
        if status == 1 and not self._forked and not self._received:
            hint = (
                '; a script that starts workers needs `if __name__ == "__main__":` with this start method '
                "(its traceback is printed above)"
            )
        return WorkerLost(f"{self._name(worker)} {how} before its batch was made{hint}")

    def close(self) -> None:
        """End the processes: idle ones at once, others after their current request or, if it takes long, by a kill."""
        if os.getpid() != self._owner:
            return  # this is a fork of the process that started the workers
        for pipe in self._pipes:
            with contextlib.suppress(OSError):  # the worker has ended already
                pipe.send(_END)  # closing is not enough: workers forked later have the pipe open too
            pipe.close()
        for process in self._processes:
            process.join(_JOIN_TIMEOUT_S)
            if process.is_alive():
                process.kill()
                process.join()
            process.close()
        self._pipes, self._processes = [], []


def _serve(work: Callable[[Any], Any], pipe: Connection, inherited: Sequence[Connection]) -> None:
    """Handle requests in a worker process until it is told to end, or its parent is gone."""
    for other in inherited:
        other.close()  # otherwise sibling workers would keep each other's pipes open
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    torch.set_num_threads(1)
    parent = os.getppid()
    with contextlib.suppress(EOFError, OSError):  # the parent is gone
        while True:
            while not pipe.poll(_POLL_S):
                if os.getppid() != parent:
                    return
            request = pipe.recv()
            if request == _END:
                return
            pipe.send(_run(work, request))


def _run(work: Callable[[Any], Any], request: Any) -> Any:
    try:
        return work(request)
    except Exception as error:
        return _Failure(" ".join(f"{type(error).__name__}: {error}".split()), traceback.format_exc())
