"""Compilation of loops over pixels by numba.

Loops of streaming have NumPy forms that give the same bits, for installs without numba. BODYSEG_KERNELS chooses: `auto`
(the default: compiled if numba can be imported), `numpy`, or `compiled`. The choice changes how long a sample takes and
nothing else. All other loops are compiled in any case, and an extra brings numba for them.

Machine code is kept on disk, in NUMBA_CACHE_DIR or the user's cache folder, under a digest of all that shapes it.
"""

from __future__ import annotations

import contextlib
import hashlib
import inspect
import os
import platform
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from functools import lru_cache
from importlib import import_module
from pathlib import Path
from typing import Any, Final

from bodyseg_data.core import BadConfig, MissingLibrary

VARIABLE: Final = "BODYSEG_KERNELS"
_CHOICES: Final = ("auto", "numpy", "compiled")
_ROOM: Final = 1 << 20
"""Bytes that a disk must have free for one function's machine code, which takes a 20th of it."""

_one_at_a_time = threading.Lock()


@lru_cache(maxsize=1)
def use_compiled() -> bool:
    """Decide whether loops are compiled, once a process. Raises BadConfig, or MissingLibrary if numba must be there."""
    choice = os.environ.get(VARIABLE, "auto")
    if choice not in _CHOICES:
        raise BadConfig(f"{VARIABLE} must be one of {', '.join(_CHOICES)}, found {choice!r}")
    if choice == "numpy":
        return False
    try:
        require_numba(f"{VARIABLE}=compiled")
    except MissingLibrary:  # absent, or there and unfit for the NumPy that is installed
        if choice == "compiled":
            raise
        return False
    return True


def compiled(loops: Callable[..., Any], feature: str, extra: str = "fast") -> Any:
    """`loops`, a function of arrays and numbers, as machine code, made at the first call and kept on disk.

    Without fast-math or threads, so with the same bits as Python's. Raises MissingLibrary as `require_numba`.
    """
    numba = require_numba(feature, extra)
    options = {"nogil": True, "error_model": "numpy"}
    with _one_at_a_time:  # numba asks for the folder once, here
        before = numba.config.CACHE_DIR
        folder = _folder(before, _digest(loops, numba))
        if folder is None:
            return numba.njit(loops, **options)
        numba.config.CACHE_DIR = str(folder)
        try:
            return _saved_if_possible(numba.njit(loops, cache=True, **options))
        finally:
            numba.config.CACHE_DIR = before


def _saved_if_possible(function: Any) -> Any:
    """A compiled function that goes on where its code cannot be saved, as on a disk that has filled meanwhile: numba
    raises OSError then, after it has compiled.
    """
    save = function._cache.save_overload

    def save_or_not(signature: Any, code: Any) -> None:
        with contextlib.suppress(OSError):
            save(signature, code)

    function._cache.save_overload = save_or_not
    return function


def require_numba(feature: str, extra: str = "fast") -> Any:
    """Import numba. Raises MissingLibrary, which names the feature and the extra that brings numba."""
    try:
        return import_module("numba")
    except ImportError as error:
        raise MissingLibrary(
            f"{feature} needs the package 'numba': pip install 'bodyseg[{extra}]' ({error})"
        ) from error


def _folder(named: str, digest: str) -> Path | None:
    """The folder of a digest, in the one named or in the user's cache folder; None if it cannot be written to.

    Only this user may write there, for its files are run. Where it has no code yet, the disk must have room for it.
    """
    try:
        cache = os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()
        folder = (Path(named) if named else Path(cache) / "bodyseg" / "kernels") / digest
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder, buffering=0) as tried:
            if not any(folder.glob("*.nbc")) and tried.write(bytes(_ROOM)) < _ROOM:
                return None
    except (OSError, RuntimeError):  # RuntimeError: this user has no home
        return None
    return folder


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
    """The source of `loops`' file, the values of the globals it names, and the same for the loops among them."""
    seen.add(loops)
    yield Path(inspect.getfile(loops)).read_text()
    for name in sorted(loops.__code__.co_names):
        value = loops.__globals__.get(name)
        inner = getattr(value, "py_func", None)
        if inner is None and not callable(value) and not inspect.ismodule(value):
            yield f"{name} = {value!r}"
        elif inner is not None and inner not in seen:
            yield from _frozen(inner, seen)
