"""The one thread in which pymeshlab is imported and works, whoever asks.

Two faults of pymeshlab 2025.7 damage the heap. Loaded in a thread that ends before the process does, it leaves Qt data
of a dead thread behind, which the end of the process follows. Its decimation releases the interpreter's lock and is not
reentrant, so two threads at once write into each other's mesh. One daemon thread that takes all of the work in turn,
and never ends, has neither.

Its licence is GPL-3.0, so it is imported only where a user chose it: by `--pymeshlab`, or `--tolerance-mm` above 0.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib.util
import os
import sys
import threading
import traceback
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Final, TypeVar

from bodyseg_data.core.system.libraries import missing_library, require_libraries

_Result = TypeVar("_Result")

_SHARED_LIBRARIES: Final = (("torch", "lib/libgomp.so.1"), ("openvino", "libs/libtbb.so.12"))
"""Libraries that pymeshlab brings, too, by the same name: the linker takes whichever was loaded first for everybody."""


def with_pymeshlab(feature: str, work: Callable[[Any], _Result]) -> _Result:
    """Call `work` with the module pymeshlab, in the thread for it; return what it returns, raise what it raises.

    feature: the feature that the message names if something is missing. work: makes all meshes of pymeshlab that it
    needs, and returns arrays: a mesh must not leave the thread. It must not call this function. The first call of a
    process takes a third of a second more. A forked process has a thread of its own. Raises MissingLibrary without
    pymeshlab, libGL or libOpenGL.
    """
    return _worker.call(lambda: work(_import_pymeshlab(feature)))


class _Worker:
    """A daemon thread that starts with the first job and takes one after the other."""

    def __init__(self) -> None:
        self._start = threading.Lock()
        self._jobs: SimpleQueue[tuple[Future[Any], Callable[[], Any]]] | None = None

    def call(self, job: Callable[[], _Result]) -> _Result:
        with self._start:
            if self._jobs is None:
                self._jobs = SimpleQueue()
                # Not of a pool of threads: those end, with pymeshlab's data, before the process does.
                threading.Thread(target=_work_forever, args=(self._jobs,), name="pymeshlab", daemon=True).start()
        answer: Future[_Result] = Future()
        self._jobs.put((answer, job))
        return answer.result()


def _work_forever(jobs: SimpleQueue[tuple[Future[Any], Callable[[], Any]]]) -> None:
    while True:
        answer, job = jobs.get()
        try:
            result = job()
        except BaseException as error:  # handed to the caller, whatever it is: this thread stays
            _release_frames(error)
            answer.set_exception(error)
        else:
            answer.set_result(result)
            del result
        del answer, job


def _release_frames(error: BaseException) -> None:
    """Release what the frames of an exception and of its causes hold: meshes, which must end in this thread."""
    link: BaseException | None = error
    while link is not None:
        traceback.clear_frames(link.__traceback__)
        link = link.__cause__ or link.__context__


def _import_pymeshlab(feature: str) -> Any:
    try:
        # Without libOpenGL pymeshlab prints a page of warnings and comes up without half of its filters.
        require_libraries(feature, ("GL", "OpenGL"))
        if "pymeshlab" not in sys.modules:
            _load_shared_libraries()
        import pymeshlab
    except (ImportError, OSError, AttributeError) as error:
        raise missing_library(feature, error, extra="pymeshlab") from error
    return pymeshlab


def _load_shared_libraries() -> None:
    """Load those of other packages first, so that PyTorch, OpenVINO and ssl keep their own if they come later."""
    with contextlib.suppress(ImportError):
        import ssl  # noqa: F401  # with libcrypto
    for package, name in _SHARED_LIBRARIES:
        with contextlib.suppress(OSError, ValueError):  # absent, another build, or not a package that was installed
            found = importlib.util.find_spec(package)
            for folder in (found.submodule_search_locations or ()) if found else ():
                ctypes.CDLL(str(Path(folder) / name))


_worker = _Worker()


def _renew_worker() -> None:
    """In a forked child: the parent's thread did not come along."""
    global _worker
    _worker = _Worker()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_renew_worker)
