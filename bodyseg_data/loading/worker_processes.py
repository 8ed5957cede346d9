"""Worker processes that handle requests in turn, each over its own pipe: no semaphore, thread or named resource."""

from __future__ import annotations

import contextlib
import multiprocessing
import multiprocessing.forkserver
import os
import signal
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from typing import Any, Final, Literal

import torch

from bodyseg_data.core.errors import BadConfig, WorkerLost
from bodyseg_data.core.system.memory import peak_mb
from bodyseg_data.loading.workers import END_TIMEOUT_S, checked_result, handle

StartMethod = Literal["fork", "spawn", "forkserver"]

_END: Final = "end"
"""Last request: ends the worker."""

_POLL_S: Final = 1.0
"""Interval at which each side checks that the other is alive, seconds, in case the pipe does not show it."""


class ProcessWorkers:
    """`count` processes, started at once. Request n goes to worker n modulo `count`; results come in the same order.

    work: called in the workers, with a request; must be picklable unless processes are forked. A worker ends when its
    pipe closes, hence also when this process ends in any way. Ctrl-C does not reach workers.
    """

    def __init__(self, work: Callable[[Any], Any], count: int, start_method: StartMethod | None) -> None:
        if multiprocessing.current_process().daemon:
            raise BadConfig(
                "a worker process can have no processes of its own: use num_workers=0 there, or worker_method='thread'"
            )
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
        """See `Workers.submit`: the request goes to the next worker in turn."""
        worker = self._submitted % len(self._pipes)
        try:
            self._pipes[worker].send(request)
        except OSError:
            raise self._lost(worker) from None
        self._submitted += 1

    def result(self) -> Any:
        """See `Workers.result`."""
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
        return checked_result(found, self._name(worker))

    def discard(self) -> None:
        """See `Workers.discard`."""
        self.result()

    def peaks_mb(self) -> list[float | None]:
        """See `Workers.peaks_mb`."""
        return [peak_mb(process.pid) for process in self._processes]

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
        """See `Workers.close`: idle processes end at once, others after their request, or by a kill."""
        if os.getpid() != self._owner:
            return  # this is a fork of the process that started the workers
        for pipe in self._pipes:
            with contextlib.suppress(OSError):  # the worker has ended already
                pipe.send(_END)  # closing is not enough: workers forked later have the pipe open too
            pipe.close()
        for process in self._processes:
            process.join(END_TIMEOUT_S)
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
            pipe.send(handle(work, request))
