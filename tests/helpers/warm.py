"""Programs of Python that begin with PyTorch and the loader imported, in processes of their own.

Importing takes two seconds of processor, and dozens of tests are about what a program does later: its signals, what it
leaves behind, what it says at its end. A server that has imported once forks for each program; it is started with the
first one, and ends with the tests. What a program does at its start (imports, settings of libraries) is tested with a
Python of its own.
"""

from __future__ import annotations

import atexit
import ctypes
import functools
import gc
import os
import pickle
import signal
import socket
import subprocess
import sys
import threading
import types
import warnings
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from folders import HELPERS
from processes import start_interruptible
from servers import free_port

# Optimisers load Dynamo, two and a half seconds; renderers load SciPy and NetworkX; nodes of Dask are eight.
_LIBRARIES = ("torch", "torch._dynamo", "numba", "scipy.stats", "networkx", "distributed")
_OURS = ("bodyseg_data.loading.range_images", "bodyseg_data.loading.workers", "bodyseg_model.training.loop")


class Program:
    """A program that runs; used as `subprocess.Popen` with pipes of text, which `stdout` and `stderr` are."""

    def __init__(
        self,
        words: Sequence[str],
        *,
        env: Mapping[str, str] | None = None,
        cwd: Path | None = None,
        strict: bool = False,
        start_new_session: bool = False,
    ) -> None:
        """words: "-c" and its text, or the path of a script, and the arguments. strict: as -W error."""
        self.returncode: int | None = None
        out, err, status = (os.pipe() for _ in range(3))
        self.stdout, self.stderr, self._status = (os.fdopen(pipe[0]) for pipe in (out, err, status))
        wanted = (
            list(words),
            dict(os.environ if env is None else env),
            str(cwd or Path.cwd()),
            strict,
            start_new_session,
        )
        try:
            socket.send_fds(_server(), [pickle.dumps(wanted)], [out[1], err[1], status[1]])
        finally:
            for pipe in (out, err, status):
                os.close(pipe[1])
        self.pid = int(self._status.readline())

    def send_signal(self, number: int) -> None:
        os.kill(self.pid, number)

    def wait(self) -> int:
        if self.returncode is None:
            self.returncode = os.waitstatus_to_exitcode(int(self._status.readline()))
        return self.returncode

    def communicate(self, timeout: float) -> tuple[str, str]:
        """All of both streams, and the end of the program, which is killed after `timeout` seconds."""
        killer = threading.Timer(timeout, self.send_signal, (signal.SIGKILL,))
        killer.start()
        errors: list[str] = []
        reader = threading.Thread(target=lambda: errors.append(self.stderr.read()))
        reader.start()
        printed = self.stdout.read()
        reader.join()
        self.wait()
        killer.cancel()
        return printed, errors[0]

    def __enter__(self) -> Program:
        return self

    def __exit__(self, failed: object, *_: object) -> None:
        if failed and self.returncode is None:
            self.send_signal(signal.SIGKILL)
        self.wait()
        for stream in (self.stdout, self.stderr, self._status):
            stream.close()


def run(words: Sequence[str], *, timeout: float = 120, **options: Any) -> subprocess.CompletedProcess[str]:
    """Run a program to its end; as `subprocess.run` with both streams captured. options: those of `Program`."""
    with Program(words, **options) as program:
        printed, errors = program.communicate(timeout)
        return subprocess.CompletedProcess(words, program.wait(), printed, errors)


def run_on_two_ranks(worker: str, *words: str) -> str:
    """Run a worker of this folder on two ranks, with the variables of torchrun; return what both wrote to stderr."""
    ranks = {"WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free_port())}
    command = [str(HELPERS / worker), *words]
    with ExitStack() as stack:
        programs = [
            stack.enter_context(Program(command, env=os.environ | ranks | {"RANK": rank, "LOCAL_RANK": rank}))
            for rank in "01"
        ]
        said = [program.communicate(200)[1] for program in programs]
        assert [program.wait() for program in programs] == [0, 0], said
    return "".join(said)


@functools.cache
def _server() -> socket.socket:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    command = [sys.executable, __file__, str(theirs.fileno())]
    server = start_interruptible(command, pass_fds=[theirs.fileno()], stdin=subprocess.DEVNULL)
    theirs.close()
    atexit.register(lambda: (ours.close(), server.wait()))
    return ours


def _leave(libraries: dict[str, types.ModuleType]) -> None:
    """Keep libraries from being cleared at the end of a program, which would take a second of processor."""
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(libraries))
    for name in libraries:
        sys.modules.pop(name, None)


def _serve(requests: socket.socket) -> tuple[list[str], bool]:
    """Fork for every request. Returns only in those forks, with a program's words, and whether warnings are errors."""
    lasting: dict[str, types.ModuleType] = {}
    atexit.register(_leave, lasting)  # first, so that programs come to it last
    for name in _LIBRARIES:
        __import__(name)
    gc.freeze()  # or every program's collections copy their memory
    for name in _OURS:
        __import__(name)
    ours = sys.stdlib_module_names | {"__main__", "bodyseg_data", "bodyseg_model"}
    lasting |= {name: module for name, module in sys.modules.items() if name.partition(".")[0] not in ours}
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    while True:
        message, files, _, _ = socket.recv_fds(requests, 1 << 20, 3)
        if not message:
            os._exit(0)
        if os.fork():
            for file in files:
                os.close(file)
            continue
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        requests.close()
        out, err, status = files
        words, env, cwd, strict, session = pickle.loads(message)
        if child := os.fork():  # this process waits, and tells how the program ended
            os.close(out)
            os.close(err)
            for file in (1, 2):
                os.dup2(0, file)
            os.write(status, b"%d\n" % child)
            os.write(status, b"%d\n" % os.waitpid(child, 0)[1])
            os._exit(0)
        if session:
            os.setsid()
        os.dup2(out, 1)
        os.dup2(err, 2)
        for file in files:
            os.close(file)
        os.environ.clear()
        os.environ.update(env)
        os.chdir(cwd)
        return words, strict


if __name__ == "__main__":
    sys.path[:] = sys.path[1:]
    _words, _strict = _serve(socket.socket(fileno=int(sys.argv[1])))
    if _strict:
        sys.warnoptions.append("error")
        warnings.simplefilter("error")
    sys.modules["__main__"] = types.ModuleType("__main__")  # and nothing else keeps it to the end
    if _words[0] == "-c":
        _folder, _file, _text, sys.argv = "", "<string>", _words[1], ["-c", *_words[2:]]
    else:
        _folder, _file, _text, sys.argv = str(Path(_words[0]).parent), _words[0], Path(_words[0]).read_text(), _words
        sys.modules["__main__"].__file__ = _file
    sys.path[:0] = [_folder, *os.environ.get("PYTHONPATH", "").split(os.pathsep)]
    exec(compile(_text, _file, "exec"), vars(sys.modules["__main__"]))
