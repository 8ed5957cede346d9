"""Processes that answer requests in turn, over a pipe each: no semaphore, no thread, nothing with a name."""

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

_PATIENCE_S: Final = 5.0
"""How long a worker that was told to end may take over what it is doing."""

_END: Final = "end"
"""The last request."""

_GLANCE_S: Final = 1.0
"""How often one looks whether the other is still there, should the pipe not tell."""


class InlineWorkers:
    """No workers: requests are answered in this process, when the answer is wanted."""

    def __init__(self, work: Callable[[Any], Any]) -> None:
        self._work = work
        self._requests: deque[Any] = deque()

    def ask(self, request: Any) -> None:
        """Have a request answered."""
        self._requests.append(request)

    def answer(self) -> Any:
        """The answer to the oldest request."""
        return self._work(self._requests.popleft())

    def drop(self) -> None:
        """Forget the oldest request."""
        self._requests.popleft()

    def close(self) -> None:
        """Forget what was asked."""
        self._requests.clear()


@dataclass(frozen=True)
class _Failure:
    """An error that is no part of the work: what it says, and where it came from."""

    line: str
    trace: str


class Workers:
    """`count` processes, started at once. Request n goes to worker n modulo `count`, and answers come in that order.

    work: called in the workers, with a request; must be picklable unless processes are forked. A worker ends when its
    pipe closes, so also when this process is gone, however it went. Ctrl-C does not reach workers.
    """

    def __init__(self, work: Callable[[Any], Any], count: int, start_method: StartMethod | None) -> None:
        if multiprocessing.current_process().daemon:
            raise BadConfig("a worker process can have no workers of its own: use num_workers=0 there")
        context: Any = multiprocessing.get_context(start_method)
        forked = context.get_start_method() == "fork"
        if context.get_start_method() == "forkserver":
            multiprocessing.forkserver.ensure_running()  # not below, or all it ever starts would have SIGINT blocked
        self._owner = os.getpid()
        self._pipes: list[Connection] = []
        self._processes: list[Any] = []
        self._asked = self._answered = 0
        self._forked = forked
        # Processes start with the signals blocked that are blocked now, and these never unblock SIGINT.
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

    def ask(self, request: Any) -> None:
        """Have a request answered. Raises WorkerLost."""
        worker = self._asked % len(self._pipes)
        try:
            self._pipes[worker].send(request)
        except OSError:
            raise self._lost(worker) from None
        self._asked += 1

    def answer(self) -> Any:
        """The answer to the oldest request. Raises WorkerLost if its worker has ended, or failed."""
        worker = self._answered % len(self._pipes)
        pipe, process = self._pipes[worker], self._processes[worker]
        try:
            while not pipe.poll(_GLANCE_S):
                if not process.is_alive() and not pipe.poll():
                    raise EOFError
            found = pipe.recv()
        except (EOFError, OSError):
            raise self._lost(worker) from None
        self._answered += 1
        if isinstance(found, _Failure):
            error = WorkerLost(f"{self._name(worker)} failed: {found.line}")
            error.add_note(found.trace)
            raise error
        return found

    def drop(self) -> None:
        """Throw away the answer to the oldest request, once it is there. Raises as `answer`."""
        self.answer()

    def _name(self, worker: int) -> str:
        return f"worker {worker} of {len(self._pipes)} (process {self._processes[worker].pid})"

    def _lost(self, worker: int) -> WorkerLost:
        process = self._processes[worker]
        process.join(_GLANCE_S)
        status = process.exitcode
        how = "closed its pipe" if status is None else f"ended with status {status}"
        if status is not None and status < 0:
            how = f"was ended by signal {-status} ({signal.strsignal(-status)})"
        if status == -signal.SIGKILL:
            how += ", as a system does that is short of memory,"
        hint = ""
        if status == 1 and not self._forked and not self._answered:
            hint = (
                '; a script that starts workers needs `if __name__ == "__main__":` with this start method '
                "(what went wrong stands above)"
            )
        return WorkerLost(f"{self._name(worker)} {how} before its batch was made{hint}")

    def close(self) -> None:
        """End the processes: at once if they are idle, else when they are done with what they are at, or are killed."""
        if os.getpid() != self._owner:
            return  # a fork of the process whose workers these are
        for pipe in self._pipes:
            with contextlib.suppress(OSError):  # it has ended already
                pipe.send(_END)  # closing does not tell: workers forked later than this one have the pipe open too
            pipe.close()
        for process in self._processes:
            process.join(_PATIENCE_S)
            if process.is_alive():
                process.kill()
                process.join()
            process.close()
        self._pipes, self._processes = [], []


def _serve(work: Callable[[Any], Any], pipe: Connection, inherited: Sequence[Connection]) -> None:
    """A worker's life."""
    for other in inherited:
        other.close()  # or siblings would keep each other's pipes open
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    torch.set_num_threads(1)
    parent = os.getppid()
    with contextlib.suppress(EOFError, OSError):  # nobody is left to ask or to answer
        while True:
            while not pipe.poll(_GLANCE_S):
                if os.getppid() != parent:
                    return
            request = pipe.recv()
            if request == _END:
                return
            pipe.send(_answer(work, request))


def _answer(work: Callable[[Any], Any], request: Any) -> Any:
    try:
        return work(request)
    except Exception as error:
        return _Failure(" ".join(f"{type(error).__name__}: {error}".split()), traceback.format_exc())
