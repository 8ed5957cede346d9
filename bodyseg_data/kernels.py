"""Loops over pixels, compiled where numba is installed; every one has a NumPy form that gives the same bits.

BODYSEG_KERNELS chooses: `auto` (the default: compiled if numba is there), `numpy`, or `compiled`. The choice changes
how long a sample takes and nothing else.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import lru_cache
from importlib import import_module
from importlib.util import find_spec
from typing import Any, Final

from bodyseg_data.errors import BadConfig, MissingLibrary

VARIABLE: Final = "BODYSEG_KERNELS"
_CHOICES: Final = ("auto", "numpy", "compiled")


@lru_cache(maxsize=1)
def use_compiled() -> bool:
    """Whether loops are compiled; asked once a process. Raises BadConfig, or MissingLibrary if numba must be there."""
    choice = os.environ.get(VARIABLE, "auto")
    if choice not in _CHOICES:
        raise BadConfig(f"{VARIABLE} must be one of {', '.join(_CHOICES)}, found {choice!r}")
    if choice == "compiled":
        _numba(f"{VARIABLE}=compiled")
    return choice == "compiled" or (choice == "auto" and find_spec("numba") is not None)


def compiled(loops: Callable[..., Any], feature: str) -> Any:
    """`loops`, a function of arrays and numbers, as machine code, made at the first call and kept on disk.

    Without fast-math or threads, so with the same bits as Python's. Raises MissingLibrary, naming `feature`.
    """
    numba = _numba(feature)
    options = {"nogil": True, "error_model": "numpy"}
    try:
        return numba.njit(loops, cache=True, **options)
    except RuntimeError:  # no folder that could keep it can be written
        return numba.njit(loops, **options)


def _numba(feature: str) -> Any:
    try:
        return import_module("numba")
    except ImportError as error:
        raise MissingLibrary(f"{feature} needs the package 'numba': pip install 'bodyseg[fast]' ({error})") from error
