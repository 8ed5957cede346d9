"""Look-ahead: what the samples of a pass need is fetched in the order in which they need it, before they do.

Shards that a cache keeps are fetched whole. Of others, and without a cache, the ranges of samples are held in memory;
those that lie side by side are read by one request.
"""

import atexit
import contextlib
import itertools
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import Future
from dataclasses import dataclass
from functools import partial
from typing import Final

from bodyseg_data.core import BodysegError
from bodyseg_data.shards.cache import CachedStore
from bodyseg_data.shards.records import CheckedFile
from bodyseg_data.shards.remote import RemoteFolder, Unreachable
from bodyseg_data.shards.store import TALLY, Stage, Store

Place = tuple[Store, CheckedFile, int]
"""Store, file and number of the piece that a sample is."""

CONNECTIONS: Final = 8
"""Threads of a process that fetch. Those of processes that share a cache wait where another fetches their shard."""

_HELD_BYTES: Final = 1 << 26  # bytes of ranges that are planned, or held in memory, at most

# Length from which on a joined range takes no further piece; widest gap in one; samples that are planned at once.
_RANGE_BYTES: Final = 1 << 20
_GAP_BYTES: Final = 1 << 15
_SCANNED: Final = 4096

_POLL_S: Final = 0.01
_END_TIMEOUT_S: Final = 5.0

_Job = Callable[[], object]


class _Closed(Exception):
    """The look-ahead is over."""


@dataclass
class _Range:
    """A range of a file that one request reads. first: when its first sample is needed, as a number in the order."""

    remote: RemoteFolder
    name: str
    start: int
    stop: int
    first: int
    pieces: list[tuple[int, int, Future[bytes]]]


class LookAhead:
    """Threads that fetch what is read next, from `start` to `close`. What cannot be fetched, its reader tries itself.

    places: what samples need, in their order, of any stores; read as far as memory allows. in_memory: whether this
    process reads the samples, so that ranges can be held for it.
    """

    def __init__(self, places: Iterable[Place], in_memory: bool = True) -> None:
        self._places, self._in_memory, self._owner = iter(places), in_memory, os.getpid()
        self._closed, self._turn = threading.Event(), threading.Lock()
        self._jobs: deque[_Job] = deque()
        self._planned = False
        self._sought: set[tuple[int, str]] = set()
        self._remotes: set[RemoteFolder] = set()
        self.rows = [[0.0] * len(Stage) for _ in range(CONNECTIONS)]
        """What each thread has tallied."""
        self._threads: list[threading.Thread] = []

    def start(self, stores: Iterable[Store]) -> None:
        """Begin, unless all files of the stores are on this machine."""
        if any(
            isinstance(each, RemoteFolder) or (isinstance(each, CachedStore) and not each.is_here()) for each in stores
        ):
            atexit.register(self.close)  # a pass that a program leaves open may end after the modules that this needs
            for row in self.rows:
                self._threads.append(threading.Thread(None, self._serve, "bodyseg-ahead", (row,), daemon=True))
                self._threads[-1].start()

    def close(self) -> None:
        """End all downloads. A cache keeps what is whole, and parts to be continued; memory is given back."""
        if self._threads and os.getpid() == self._owner:  # else this is a fork of the process that has the threads
            atexit.unregister(self.close)
            self._end()
            until = time.monotonic() + _END_TIMEOUT_S
            while self._threads:
                self._threads.pop().join(max(0.0, until - time.monotonic()))

    def _end(self) -> None:
        self._closed.set()
        with self._turn:  # nothing is being planned
            for remote in self._remotes:
                remote.pieces.clear()

    def _pause(self, seconds: float) -> None:
        if self._closed.wait(seconds) if seconds else self._closed.is_set():
            raise _Closed

    def _serve(self, row: list[float]) -> None:
        TALLY.start(row)
        try:
            while (job := self._next()) is not None:
                with contextlib.suppress(Unreachable):  # whoever needs the sample meets it again, if it lasts
                    job()
        except BaseException as error:
            self._end()  # else those who wait for a range would wait for ever
            if not isinstance(error, _Closed | BodysegError):
                raise

    def _next(self) -> _Job | None:
        """Wait for the next job; None at the end of all."""
        with self._turn:
            self._pause(0)
            while not self._jobs and not self._planned:
                if sum(remote.pieces.size for remote in self._remotes) > _HELD_BYTES // 2:
                    self._pause(_POLL_S)
                else:
                    self._plan()
            return self._jobs.popleft() if self._jobs else None

    def _plan(self) -> None:
        jobs: list[tuple[int, _Job]] = []
        singles: list[_Range] = []
        number, room = -1, _HELD_BYTES // 2
        for number, (store, file, index) in enumerate(itertools.islice(self._places, _SCANNED)):
            remote = store.remote if isinstance(store, CachedStore) else store
            if isinstance(store, CachedStore) and file.name in store.to_cache:
                if (id(store), file.name) not in self._sought:
                    self._sought.add((id(store), file.name))
                    jobs.append((number, partial(self._keep, store, file)))
            elif self._in_memory and isinstance(remote, RemoteFolder):
                self._remotes.add(remote)
                _, offset, length, _ = file.entry(index)
                if (piece := remote.pieces.expect(file.name, offset, length)) is not None:
                    pieces = [(offset, length, piece)]
                    singles.append(_Range(remote, file.name, offset, offset + length, number, pieces))
                room -= length
                if room <= 0:
                    break
        jobs += [(one.first, partial(self._read, one)) for one in _joined(singles)]
        self._jobs.extend(job for _, job in sorted(jobs, key=lambda each: each[0]))
        self._planned = number < 0

    def _keep(self, store: CachedStore, file: CheckedFile) -> None:
        while store.keep(file, self._pause) is None:
            self._pause(2 * _POLL_S)

    def _read(self, one: _Range) -> None:
        data = bytearray()
        with contextlib.suppress(Unreachable):
            one.remote.fetch(one.name, one.start, one.stop, data.extend, self._pause, ranges=True)
        for offset, length, piece in one.pieces:
            part = bytes(data[offset - one.start : offset - one.start + length])
            if len(part) < length:
                piece.cancel()
            elif piece.set_running_or_notify_cancel():
                piece.set_result(part)


def _joined(singles: list[_Range]) -> list[_Range]:
    """Join ranges of a file that are near each other."""
    found: list[_Range] = []
    for one in sorted(singles, key=lambda each: (id(each.remote), each.name, each.start)):
        last = found[-1] if found else one
        near = last is not one and (last.remote, last.name) == (one.remote, one.name)
        if near and one.start - last.stop <= _GAP_BYTES and last.stop - last.start < _RANGE_BYTES:
            last.stop, last.first = one.stop, min(last.first, one.first)
            last.pieces += one.pieces
        else:
            found.append(one)
    return found
