"""Compilation of loops over pixels by numba.

Loops of streaming have NumPy forms that give the same bits, for installs without numba, and for as long as another
process compiles a loop that this one needs (`if_ready`). BODYSEG_KERNELS chooses: `auto` (the default: compiled if
numba can be imported, as soon as machine code is there), `numpy`, or `compiled`, which waits for the compiler. The
choice changes only how long a sample takes. All other loops are always compiled; an extra brings numba for them.

Machine code is kept on disk, in NUMBA_CACHE_DIR or the user's cache folder, under a digest of all that shapes it.
"""

import atexit
import contextlib
import errno
import fcntl
import gc
import hashlib
import inspect
import os
import pickle
import platform
import shutil
import subprocess
import sys
import tempfile
import threading
import warnings
from collections.abc import Callable, Iterator
from functools import cached_property, lru_cache
from importlib import import_module
from pathlib import Path
from typing import Any, Final

from bodyseg_data.core import BadConfig, MissingLibrary, check_choice, signals_held
from bodyseg_data.files import cache_folder
from bodyseg_data.machine.host import processors
from bodyseg_data.machine.libraries import required

VARIABLE: Final = "BODYSEG_KERNELS"
_CHOICES: Final = ("auto", "numpy", "compiled")
_ROOM: Final = 1 << 20  # bytes that a disk must have free for one function's machine code, which takes a 20th of it
_one_at_a_time = threading.Lock()


@lru_cache(maxsize=1)
def use_compiled() -> bool:
    """Decide whether loops are compiled, once a process. Raises BadConfig, or MissingLibrary if numba must be there."""
    choice = check_choice(VARIABLE, os.environ.get(VARIABLE, "auto"), _CHOICES)
    if choice == "numpy":
        return False
    try:
        numba = required("numba", f"{VARIABLE}=compiled", "fast")
    except MissingLibrary:  # absent, or there and unfit for the NumPy that is installed
        if choice == "compiled":
            raise
        return False
    return not numba.config.DISABLE_JIT  # some loops call what only machine code has


class NotYet(Exception):
    """A loop has no machine code yet, or none at all: its NumPy form is to be used."""


class _IfReady(threading.local):
    """Context for loops that are followed by their NumPy form: `with if_ready: return loops(...).f(x)`.

    A loop without machine code raises NotYet before it has done anything, and only the context ends; another process
    then compiles it. Outside of the context, a call compiles it.
    """

    depth = 0

    def __enter__(self) -> None:
        self.depth += 1

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> bool:
        self.depth -= 1
        return kind is NotYet


if_ready: Final = _IfReady()


def loops(module: str) -> Any:
    """The module of compiled loops of that name. Raises NotYet where NumPy's forms are to be used."""
    if not use_compiled():
        raise NotYet
    return import_module(module)


def compiled(loops: Callable[..., Any], feature: str = "a compiled loop", extra: str = "fast") -> Any:
    """`loops`, a function of arrays and numbers, as machine code, made at the first call and kept on disk.

    Without fast-math or threads, so with the same bits as Python's. Raises MissingLibrary without Numba, where nothing
    has asked for it before: `feature` needs it, and `extra` installs it.
    """
    function = required("numba", feature, extra).njit(loops, nogil=True, error_model="numpy", no_cfunc_wrapper=True)
    function._cache = _Kept(loops)
    # The compiler has Python called by C, which would lose an interrupt.
    function.compile = signals_held(only_first=True, unless_left=True)(function.compile)
    return function


class _Kept:
    """Machine code of a function on disk. Numba takes it for its own cache of the function, which it uses."""

    def __init__(self, loops: Callable[..., Any]) -> None:
        self._loops = loops
        self._sent: dict[Any, subprocess.Popen[bytes]] = {}
        self._until_saved = contextlib.ExitStack()

    @cached_property
    def files(self) -> tuple[Any, Path] | None:
        """The cache of numba and its folder; None if none can be written to, or this numba has another cache."""
        numba = import_module("numba")
        try:
            cache = import_module("numba.core.caching").FunctionCache
        except (ImportError, AttributeError):
            return None
        with _one_at_a_time:  # numba asks for the folder once, here
            before = numba.config.CACHE_DIR
            folder = _folder(before, _digest(self._loops, numba))
            if folder is None:
                return None
            numba.config.CACHE_DIR = str(folder)
            try:
                return cache(self._loops), folder
            finally:
                numba.config.CACHE_DIR = before

    def load_overload(self, signature: Any, context: Any) -> Any:
        """Machine code for types of arguments; None if there is none, which lets numba compile it, once for all
        processes. In `if_ready`, raises NotYet instead, and has another process compile it.
        """
        if self.files is None:
            return None
        folder = self.files[1]
        if not if_ready.depth or _failed or os.environ.get(VARIABLE) == "compiled":
            found = self.kept(signature, context)
            if found is None:
                # Without the lock, numba would give one type's code to another where two processes save at once.
                self._until_saved.enter_context(_locked(folder / _COMPILING, wait=True))
                found = self.kept(signature, context)  # which another process may have made meanwhile
            if found is not None:
                self._until_saved.close()
            return found
        process = self._sent.get(signature)
        with _locked(folder / _COMPILING) as free:
            if not free or (process is not None and process.poll() is None):
                raise NotYet
        found = self.kept(signature, context)
        if found is not None or (process is not None and process.returncode):
            if found is None:
                _failed.append(signature)  # this process will compile, and so say what is wrong
            return found
        if sum(each.poll() is None for each in _processes) < processors():
            try:
                self._sent[signature] = _send(folder, self._loops, signature)
            except OSError:  # no memory, no such program
                _failed.append(signature)
                return None
        raise NotYet

    def kept(self, signature: Any, context: Any) -> Any:
        """Machine code that is on disk, or None. Files that a power cut has cut short are removed."""
        if self.files is not None:
            cache = self.files[0]
            load = cache.load_overload
            with contextlib.suppress(ImportError, AttributeError):  # names of numba's own, which may change
                # `load_overload` first loads all that its compiler knows of Python, NumPy and SciPy, for half a second.
                import_module("numba.core.runtime").rtsys.initialize(context)
                load = cache._load_overload
            try:
                return load(signature, context)
            except (EOFError, pickle.UnpicklingError):
                for file in self.files[1].rglob("*.nb?"):
                    file.unlink(missing_ok=True)
        return None

    def save_overload(self, signature: Any, code: Any) -> None:
        """Keep machine code; goes on where it cannot be saved, as on a disk that has filled meanwhile."""
        with self._until_saved, contextlib.suppress(OSError):
            if self.files is not None:
                self.files[0].save_overload(signature, code)


_COMPILING: Final = "compiling"
_processes: list[subprocess.Popen[bytes]] = []
_failed: list[Any] = []  # signatures that another process failed to compile; from then on this one compiles


def _send(folder: Path, function: Callable[..., Any], signature: Any) -> subprocess.Popen[bytes]:
    """Start a process that compiles a module's function for types of arguments."""
    paths = os.pathsep.join(path or str(Path.cwd()) for path in sys.path)
    process = subprocess.Popen(
        [sys.executable, "-P", "-c", f"from {__name__} import compile_sent; compile_sent()"],
        env={**os.environ, "PYTHONPATH": paths, VARIABLE: "compiled"},
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,  # Ctrl-C must not reach it
    )
    _processes.append(process)
    with process.stdin as pipe:  # type: ignore[union-attr]
        for part in ((str(folder), function.__module__, function.__qualname__), signature):
            pickle.dump(part, pipe)
    return process


def compile_sent() -> None:
    """Compile what `_send` has sent, unless another process does already; ends with an error if it cannot be kept."""
    folder, module, name = pickle.load(sys.stdin.buffer)
    with _locked(Path(folder) / _COMPILING) as free:
        if not free:
            return
        gc.disable()  # it would look through all that the compiler keeps, again and again
        _given.append(Path(folder).parent)
        signature = pickle.load(sys.stdin.buffer)
        found = getattr(import_module(module), name)
        function = found if hasattr(found, "py_func") else compiled(found, "compiling")
        function.compile(signature)
        if function._cache.kept(signature, function.targetctx) is None:
            raise SystemExit(1)


@contextlib.contextmanager
def _locked(file: Path, wait: bool = False) -> Iterator[bool]:
    """Hold a file's lock, which no fork inherits; yields False if another process holds it. A disk may have none."""
    with contextlib.ExitStack() as opened:
        free = True
        try:
            fcntl.lockf(opened.enter_context(file.open("ab")), fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except OSError as error:
            free = error.errno not in (errno.EACCES, errno.EAGAIN)
        yield free


_given: list[Path] = []  # the one folder to keep code in, if another process has chosen it


def _folder(named: str, digest: str) -> Path | None:
    """The folder of a digest, in the one named or in the user's cache folder, else in one that ends with this process;
    None if none can be written to.

    Only this user may write there, for its files are run. Where it has no code yet, the disk must have room for it.
    """
    home = None
    with contextlib.suppress(BadConfig):  # this user has no home
        home = Path(named) if named else cache_folder() / "kernels"
    for root in _given or (home, None):
        with contextlib.suppress(OSError):
            folder = (root or _of_process(home)) / digest
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder, buffering=0) as tried:
                if any(folder.rglob("*.nbc")) or tried.write(bytes(_ROOM)) == _ROOM:
                    return folder
    return None


@lru_cache(maxsize=1)
def _of_process(home: Path | None) -> Path:
    """A folder that is removed at the end of this process."""
    folder = tempfile.mkdtemp(prefix="bodyseg-kernels-")
    atexit.register(_remove, folder)
    text = f"compiled loops cannot be kept in {home or 'a home'}, so every process compiles them anew: "
    warnings.warn(f"{text}NUMBA_CACHE_DIR names another folder", RuntimeWarning, stacklevel=2)
    return Path(folder)


def _remove(folder: str) -> None:
    """Remove this process's folder, once those that compile into it have ended: they would make it anew."""
    for process in _processes:
        process.kill()
        process.wait()
    shutil.rmtree(folder, ignore_errors=True)


def _digest(loops: Callable[..., Any], numba: Any) -> str:
    """Digest of everything that shapes machine code: sources, frozen constants, compiler and processor.

    numba itself compares the source of the outermost function alone, and replaces index and code one after the other,
    so after a change old code could be run as if it were new. A folder for every state rules both out.
    """
    llvm = import_module("llvmlite.binding")
    machine = platform.machine(), llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()
    settings = sorted((name, value) for name, value in os.environ.items() if name.startswith("NUMBA_"))
    versions = numba.__version__, import_module("llvmlite").__version__, sys.version
    parts = [*_frozen(loops, set()), repr((machine, settings, versions))]
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:32]


def _frozen(loops: Callable[..., Any], seen: set[Any]) -> Iterator[str]:
    """The source of `loops`' file, the values of the globals it names, and the same for the functions among them."""
    seen.add(loops)
    yield Path(inspect.getfile(loops)).read_text()
    for name in sorted(loops.__code__.co_names):
        value = loops.__globals__.get(name)
        inner = getattr(value, "py_func", value if inspect.isfunction(value) else None)
        if inner is None and not callable(value) and not inspect.ismodule(value):
            yield f"{name} = {value!r}"
        elif inner is not None and inner not in seen:
            yield from _frozen(inner, seen)
