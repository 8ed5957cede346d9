"""Jobs of a packing, their results in order, and processes of this machine that do them."""

import itertools
import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Executor, Future, InvalidStateError, ProcessPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any, Final, TypeVar

from bodyseg_data.core import BadConfig, check_int, reported, signals_held
from bodyseg_data.machine import MOST_THREADS, processors

Result = TypeVar("Result")

_TOO_MANY: Final = "no process can be started: ulimit -u or the container allows no more", BadConfig, BlockingIOError


@dataclass(frozen=True)
class Engine:
    """An executor of jobs. workers: how many to keep busy."""

    executor: Executor
    workers: int


def ordered(jobs: Iterable[Callable[[], Future[Result]]], workers: int) -> Generator[Result, None, None]:
    """The results of jobs, in order. jobs: each submits one. workers: how many to keep busy; memory stays flat.

    The first goes alone: a source may fill a cache on first use, which several workers would do at once. Closing the
    generator cancels the jobs that have not begun.
    """
    submissions = iter(jobs)
    waiting: deque[Future[Result]] = deque()
    try:
        for submit in itertools.islice(submissions, 1):
            yield submit().result()
        for submit in submissions:
            waiting.append(submit())
            if len(waiting) > 2 * max(workers, 1):
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        for future in waiting:
            future.cancel()


@contextmanager
def processes(workers: int | None) -> Iterator[Engine]:
    """`workers` processes, or one a processor; after an error they are killed instead of waited for."""
    count = processors() if workers is None else check_int("workers", workers, 1, MOST_THREADS)
    # One thread of linear algebra a worker: with one worker a processor, more only get in each other's way.
    for library in ("OPENBLAS", "OMP", "MKL"):
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")
    # Fresh processes, not forks: a fork of a process that has used threads, or drawn with OpenGL, can deadlock.
    context = multiprocessing.get_context("spawn")
    others = set(multiprocessing.active_children())
    locks = "processes need locks, which the system keeps in /dev/shm"
    with reported(locks, BadConfig, OSError), reported(*_TOO_MANY):
        executor = _Workers(count, mp_context=context, initializer=_end_with_parent)
    try:
        yield Engine(executor, count)
    except BaseException:
        # No result under way will be used, so the user need not wait for one.
        for worker in set(multiprocessing.active_children()) - others:
            worker.kill()
        raise
    finally:
        executor.shutdown(wait=True, cancel_futures=True)


class _Job(Future[Any]):
    """A future that may be cancelled before its worker is killed, where Python 3.11 would print a traceback."""

    def set_exception(self, exception: BaseException | None) -> None:
        with suppress(InvalidStateError):
            super().set_exception(exception)


class _Workers(ProcessPoolExecutor):
    """Processes that Ctrl-C on a terminal does not reach: this process gets it, and ends them."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        # Workers start in `submit`, with the signals blocked that are blocked now. Others are held: one that came
        # between start and initialisation would leave the worker behind, with a traceback of its own.
        with signals_held(), reported(*_TOO_MANY):
            before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
            try:
                future = super().submit(fn, *args, **kwargs)
                future.__class__ = _Job
                return future
            finally:
                signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _end_with_parent() -> None:
    """Make a worker end when the process that started it is gone, however it went."""
    parent = multiprocessing.parent_process()

    def wait() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
