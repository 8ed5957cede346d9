"""Workers of a loader: processes, threads of this process, or neither.

Threads start at once, share all memory, and run side by side where the GIL is released: by reading, checksums, zstd and
the compiled loops; the Python code between them takes turns. Processes handle requests in turn, each over its own pipe:
no semaphore or named resource.
"""

import contextlib
import multiprocessing
import multiprocessing.forkserver
import os
import pickle
import signal
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from multiprocessing.reduction import ForkingPickler
from queue import Empty, SimpleQueue
from typing import Any, Final, Literal, Protocol

from bodyseg_data.core import BadConfig, BodysegError


class WorkerLost(BodysegError):
    """A worker process of a loader has ended, or failed, before its work was done."""


WorkerMethod = Literal["process", "thread"]
StartMethod = Literal["fork", "spawn", "forkserver"]

DEFAULT_WORKER_METHOD: Final[WorkerMethod] = "thread"
"""Chosen by measurement: docs/results/loading_speed.md."""

END_TIMEOUT_S: Final = 5.0
"""Time for a worker to finish its request after it was told to end, seconds."""

_Answers = SimpleQueue[tuple[int, Any]]
_Requests = SimpleQueue[tuple[Any, _Answers] | None]
"""Requests, each with the queue that its (number of the worker, result) goes to; None ends the thread that takes it."""

_END: Final = "end"  # last request: ends the worker
_POLL_S: Final = 1.0
"""Interval at which each side checks that the other is alive, seconds, in case the pipe does not show it."""


class Workers(Protocol):
    """Handles requests by calling one function on each, and gives the results in the order of the requests."""

    def submit(self, request: Any) -> None:
        """Queue a request. Raises WorkerLost if the worker that should take it has ended."""

    def result(self) -> Any:
        """Wait for and return the result of the oldest request. Raises WorkerLost if its worker has ended or failed."""

    def discard(self) -> None:
        """Remove the oldest request, waiting for its result if it may have begun. Raises as `result`."""
        self.result()

    def close(self) -> None:
        """End the workers and remove all requests."""


class InlineWorkers(Workers):
    """Workers without processes or threads: a request is handled when its result is fetched, by whoever fetches it."""

    def __init__(self, work: Callable[[Any], Any]) -> None:
        self._work = work
        self._requests: deque[Any] = deque()

    def submit(self, request: Any) -> None:
        self._requests.append(request)

    def result(self) -> Any:
        """See `Workers.result`; errors of the function pass through."""
        return self._work(self._requests.popleft())

    def discard(self) -> None:
        self._requests.popleft()

    def close(self) -> None:
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
        return Failure(BodysegError.words_of(error), traceback.format_exc())


def checked_result(found: Any, worker: str) -> Any:
    """Return what `handle` gave. Raises WorkerLost for a Failure, with its traceback as a note; worker: its name."""
    if not isinstance(found, Failure):
        return found
    error = WorkerLost(f"{worker} failed: {found.line}")
    error.add_note(found.trace)
    raise error


class ThreadWorkers(Workers):
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
                arguments = work, number, self._requests
                thread = threading.Thread(None, _serve_thread, f"bodyseg-worker-{number}", arguments, daemon=True)
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
        number, found = self._answers.popleft().get()
        return checked_result(found, f"worker {number} of {len(self._threads)} (thread)")

    def close(self) -> None:
        """See `Workers.close`: threads end after their current request, which is waited for unless it takes long."""
        if os.getpid() != self._owner:
            return  # this is a fork of the process that started the threads
        with contextlib.suppress(Empty):
            while True:
                self._requests.get_nowait()
        for _ in self._threads:
            self._requests.put(None)
        until = time.monotonic() + END_TIMEOUT_S
        for thread in self._threads:
            if thread is not threading.current_thread():  # where the garbage collector may call this
                thread.join(max(0.0, until - time.monotonic()))
        self._threads = []
        self._answers.clear()


def _serve_thread(work: Callable[[Any], Any], number: int, requests: _Requests) -> None:
    """Handle requests in a thread until it takes None."""
    while (task := requests.get()) is not None:
        request, answer = task
        found = handle(work, request)
        answer.put((number, found))
        del task, request, answer, found  # or they would live until the next request


class ProcessWorkers(Workers):
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
        self._forked = context.get_start_method() == "fork"
        if context.get_start_method() == "forkserver":
            multiprocessing.forkserver.ensure_running()  # here, or every process it starts would have SIGINT blocked
        self._owner = os.getpid()
        self._pipes: list[Connection] = []
        self._processes: list[Any] = []
        self._submitted = self._received = 0
        # A process starts with the signals blocked that its parent blocks; workers never unblock SIGINT.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            for _ in range(count):
                ours, theirs = context.Pipe()
                self._pipes.append(ours)
                with theirs:
                    inherited = tuple(self._pipes) if self._forked else ()
                    arguments = _Carried(work), theirs, inherited
                    process = context.Process(target=_serve_process, args=arguments, daemon=True)
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
        with contextlib.suppress(OSError):
            self._pipes[worker].send(request)
            self._submitted += 1
            return
        raise self._lost(worker)  # not from that error, whose frames hold a pickle: it would be freed with a warning

    def result(self) -> Any:
        worker = self._received % len(self._pipes)
        pipe, process = self._pipes[worker], self._processes[worker]
        with contextlib.suppress(EOFError, OSError):
            while not pipe.poll(_POLL_S):
                if not process.is_alive() and not pipe.poll():
                    raise EOFError
            found = pipe.recv()
            self._received += 1
            return checked_result(found, self._name(worker))
        raise self._lost(worker)

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
        until = time.monotonic() + END_TIMEOUT_S
        for process in self._processes:
            process.join(max(0.0, until - time.monotonic()))
            if process.is_alive():
                process.kill()
                process.join()
            process.close()
        self._pipes, self._processes = [], []


class _Carried:
    """Work on its way to a process, which unpickles it itself, to say why it cannot. A fork needs no pickles.

    Raises BadConfig when it is pickled, for what cannot be.
    """

    def __init__(self, work: Callable[[Any], Any] | None, packed: bytes = b"") -> None:
        self._work, self._packed = work, packed

    def __reduce__(self) -> Any:
        try:
            return _Carried, (None, bytes(ForkingPickler.dumps(self._work)))
        except Exception as error:  # pickle raises any of three kinds
            why = f"pickled for a worker: {error}"
        return _fail(why)

    def opened(self) -> Callable[[Any], Any]:
        """Return the work, or one that fails at every request."""
        try:
            return self._work or pickle.loads(self._packed)
        except Exception as error:
            return partial(_fail, f"unpickled in a worker: {BodysegError.words_of(error)}")


def _fail(why: str, request: Any = None) -> Any:
    raise BadConfig(
        f"the images cannot be {why}; what they use, such as a transform, must be in a module, not in a function, a "
        "notebook's cell or under the main guard; worker_method='thread' needs no pickles"
    )


def _serve_process(carried: _Carried, pipe: Connection, inherited: Sequence[Connection]) -> None:
    """Handle requests in a worker process until it is told to end, or its parent is gone."""
    for other in inherited:
        other.close()  # otherwise sibling workers would keep each other's pipes open
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    import torch  # here, as commands offer `WorkerMethod` before they need it

    torch.set_num_threads(1)
    work, requests = carried.opened(), SimpleQueue[Any]()
    threading.Thread(target=_receive, args=(pipe, requests), daemon=True).start()
    with contextlib.suppress(OSError):  # the parent is gone
        while (request := requests.get()) != _END:
            pipe.send(handle(work, request))


def _receive(pipe: Connection, requests: SimpleQueue[Any]) -> None:
    """Empty the pipe while requests are handled: with both ways full, parent and worker would wait for each other."""
    parent = os.getppid()
    with contextlib.suppress(Exception):  # the parent is gone
        while pipe.poll(_POLL_S) or os.getppid() == parent:
            if pipe.poll():
                requests.put(pipe.recv())
    requests.put(_END)
    time.sleep(END_TIMEOUT_S)
    os._exit(1)  # a request takes long, and nobody is left to end it
