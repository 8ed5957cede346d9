"""Packings that are killed, run out of disk or lose their folder, and what they leave behind.

At operations: a packing in a forked process, with rendering replayed, to which something happens at its n-th operation
on files, for every n. At instants: the command with its workers, killed as a whole some time after it was started.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from bodyseg_data.bodies import BodyRef
from bodyseg_data.core import BodysegError
from bodyseg_data.packing import STATE_NAME, Packing, pack
from bodyseg_data.packing.packer import render_run
from bodyseg_data.packing.writing import Rendered
from bodyseg_data.samples import View
from bodyseg_data.shards import MANIFEST_NAME

Trouble = Literal["killed", "disk full", "read-only", "folder gone"]
TROUBLES: Final[tuple[Trouble, ...]] = ("killed", "disk full", "read-only", "folder gone")

_CHANGES: Final = {"os.rename", "os.remove", "os.rmdir", "os.mkdir"}
_OPERATIONS: Final = {"open", "os.listdir", "os.scandir", "fcntl.flock", *_CHANGES}
_WRITING: Final = os.O_WRONLY | os.O_RDWR | os.O_CREAT


class Replay(Executor):
    """Executor that renders every run once, and returns the same result from then on."""

    def __init__(self) -> None:
        self._known: dict[tuple[BodyRef, tuple[View, ...]], Rendered] = {}

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        packing, body, views, _ = args
        answer: Future[Any] = Future()
        if (body, views) not in self._known:
            self._known[body, views] = render_run(packing, body, views)
        answer.set_result(self._known[body, views])
        return answer


def contents(folder: Path) -> dict[str, str]:
    """Name -> SHA-256 of every file in a folder that is not being written aside, as a dot before its name marks."""
    if not folder.is_dir():
        return {}
    files = [path for path in folder.iterdir() if path.is_file() and not path.name.startswith(".")]
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def _hidden(folder: Path) -> list[str]:
    return [path.name for path in folder.iterdir() if path.name.startswith(".")]


def left_over(folder: Path, whole: dict[str, str]) -> list[str]:
    """Faults of a folder in which a packing of `whole` was cut short: files that are not whole."""
    found = contents(folder)
    wrong = [f"{name} is half-written or a stray" for name, digest in found.items() if whole.get(name) != digest]
    if MANIFEST_NAME in found and found != whole:
        wrong.append("there is a manifest, and a shard is missing")
    return wrong


class Interrupted:
    """A packing to interrupt again and again. folder: an empty one to work in."""

    def __init__(self, packing: Packing, folder: Path) -> None:
        self._packing, self._folder, self._replay = packing, folder, Replay()
        self.pack(folder / "whole")
        self.whole = contents(folder / "whole")
        self.operations = self._count()

    def pack(self, out: Path) -> None:
        """Pack, without interruption."""
        pack(self._packing, out, self._replay, 1)

    def _count(self) -> int:
        reader, writer = os.pipe()
        _forked(lambda: self._counted(self._folder / "counted", writer))
        os.close(writer)
        with os.fdopen(reader) as file:
            shutil.rmtree(self._folder / "counted")
            return int(file.read())

    def _counted(self, out: Path, writer: int) -> None:
        count = 0

        def hook(event: str, arguments: tuple[Any, ...]) -> None:
            nonlocal count
            count += event in _OPERATIONS

        sys.addaudithook(hook)
        self.pack(out)
        os.write(writer, str(count).encode())

    def at(self, trouble: Trouble, operation: int) -> list[str]:
        """Have trouble at an operation, then pack again without; returns what is wrong."""
        out = self._folder / "out"
        message_file = self._folder / "message"
        message_file.write_text("")
        run = _forked if trouble == "killed" else _ended
        status = run(lambda: self._troubled(trouble, operation, out), message_file)
        wrong = left_over(out, self.whole)
        # The last two let go of a finished set.
        released = trouble == "folder gone" and operation >= self.operations - 1
        ended = status == 0 and (released or contents(out) == self.whole)
        refused = status == 2 and message_file.read_text().count("\n") == 1
        if not (ended or (status == -signal.SIGKILL if trouble == "killed" else refused)):
            wrong.append(f"it ended with status {status} with the message {message_file.read_text()[-300:]!r}")
        try:
            self.pack(out)
            if contents(out) != self.whole or _hidden(out):
                wrong.append("packed again, it has other bytes")
        except BodysegError as error:
            wrong.append(f"packed again, it says {error}")
        shutil.rmtree(out)
        return [f"{trouble} at operation {operation}: {problem}" for problem in wrong]

    def all_at(self, trouble: Trouble, operations: Sequence[int]) -> list[str]:
        """Have trouble at each operation in turn; returns what is wrong.

        In one fork, which ends with the hooks of trouble that ends nothing: a fork of a large process takes its time.
        """
        said, found = self._folder / "said", self._folder / "found"  # no pipe, which holds few faults

        def report() -> None:
            with found.open("a") as file:
                for n in operations:
                    file.writelines(f"{fault!r}\n" for fault in self.at(trouble, n))

        said.write_text("")
        found.write_text("")
        status = _forked(report, said)
        wrong = found.read_text().splitlines()
        return [*wrong, *([] if status == 0 else [f"it ended with status {status}: {said.read_text()[-300:]!r}"])]

    def _troubled(self, trouble: Trouble, operation: int, out: Path) -> None:
        count, ended = 0, False

        def hook(event: str, arguments: tuple[Any, ...]) -> None:
            nonlocal count
            if ended or event not in _OPERATIONS:
                return
            count += 1
            if count < operation:
                return
            if trouble == "killed":
                os.kill(os.getpid(), signal.SIGKILL)
            elif trouble == "folder gone" and count == operation:
                shutil.rmtree(out, ignore_errors=True)
            elif trouble == "disk full" and (event == "os.mkdir" or (event == "open" and _writes(arguments))):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(arguments[0]))
            elif trouble == "read-only" and (event in _CHANGES or (event == "open" and _writes(arguments))):
                raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(arguments[0]))

        sys.addaudithook(hook)  # which stays as long as the process
        try:
            self.pack(out)
        finally:
            ended = True


def _writes(arguments: tuple[Any, ...]) -> bool:
    """True if an "open" event of the audit is for writing."""
    return bool(arguments[2] & _WRITING)


def _ended(work: Callable[[], None], message_file: Path | None = None) -> int:
    """Run: returns 0, 2 for a BodysegError, 70 for others, with the line in a file."""
    status, message = 70, "?"
    lines = None if message_file is None else os.open(message_file, os.O_WRONLY)
    try:
        work()
        status, message = 0, ""
    except BodysegError as error:
        status, message = 2, f"{error}\n"
    except BaseException as error:
        message = f"{type(error).__name__}: {error}\n"
    if lines is not None:
        os.write(lines, message.encode())
        os.close(lines)
    return status


def _forked(work: Callable[[], None], message_file: Path | None = None) -> int:
    """Run in a fork: returns 0, 2 for a BodysegError, 70 for others (with the line in a file), or minus a signal."""
    child = os.fork()
    if child == 0:
        status = 70
        try:
            status = _ended(work, message_file)
        finally:
            os._exit(status)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


COMMAND: Final = (
    *(sys.executable, "-m", "bodyseg_model", "shard", "--source", "open", "--meshes", "5", "--views", "4"),
    *("--shard-samples", "4", "--workers", "2", "--out"),
)


def kill_at_instants(folder: Path, count: int, seed: int, step: Callable[[], None]) -> dict[str, Any]:
    """Kill the whole process group of the command `count` times, at instants spread over the time that it writes.

    A killed packing is carried on with and killed again, until one comes to its end; then another is begun.
    """
    out = folder / "whole"
    lasted = _run([*COMMAND, str(out)], out, None)[1]
    whole = contents(out)
    generator = np.random.default_rng(seed)
    kills = 0
    wrong: list[str] = []
    out = folder / "out"
    while kills < count:
        ended, _ = _run([*COMMAND, str(out)], out, float(generator.uniform(0, lasted)))
        wrong += left_over(out, whole)
        if ended:
            wrong += _finished(out, whole)
            continue
        kills += 1
        step()
    _run([*COMMAND, str(out)], out, None)
    wrong += _finished(out, whole)
    return {"kills": count, "faults": wrong}


def _finished(out: Path, whole: dict[str, str]) -> list[str]:
    wrong = [] if contents(out) == whole and not _hidden(out) else ["carried on, it has other bytes"]
    shutil.rmtree(out)
    return wrong


def _run(command: Sequence[str], out: Path, after_s: float | None) -> tuple[bool, float]:
    """Run a packing, killed `after_s` after it began to write: whether it ended by itself, and after how long."""
    earlier = _parts(out)
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)
    while process.poll() is None and _parts(out) <= earlier:
        time.sleep(0.002)
    began = time.monotonic()
    while process.poll() is None and (after_s is None or time.monotonic() < began + after_s):
        time.sleep(0.001)
    ended = process.poll() is not None
    if not ended:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    return ended, time.monotonic() - began


def _parts(out: Path) -> set[tuple[str, int]]:
    """The shards being written, each with the time when it was begun."""
    found = set()
    for path in (out / STATE_NAME).glob("*.tar.part"):
        with contextlib.suppress(FileNotFoundError):
            found.add((path.name, path.stat().st_mtime_ns))
    return found
