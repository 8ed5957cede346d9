"""Access to the body model Anny: its axes, loading, and errors of its cache."""

from __future__ import annotations

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final

import numpy as np

from bodyseg_data.core.errors import BadConfig, MissingLibrary

BODY_FROM_ANNY: Final = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""From Anny's axes (x left, -y front, z up) to the body frame."""


def no_anny(error: Exception) -> MissingLibrary:
    """Return the error to raise where Anny cannot be imported."""
    return MissingLibrary(f"making bodies needs the package 'anny': pip install 'bodyseg[render]' ({error})")


def load_anny() -> Any:
    """Load Anny: two seconds, 40 the first time on a machine. Raises MissingLibrary, or BadConfig for its cache."""
    try:
        from anny import Anny
    except ImportError as error:
        raise no_anny(error) from error
    with one_thread(), _one_process(), _cache_faults():
        # The compact basis would halve the time a body takes, but comes from a decomposition whose bits depend on the
        # machine and on its threads. Plain "lbs" skinning needs nothing compiled.
        return Anny(phenotypes="all", phenotype_blendshapes="original", skinning_method="lbs")


@contextmanager
def one_thread() -> Iterator[None]:
    """Run torch on one thread: its sums depend on the number of threads."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextmanager
def _one_process() -> Iterator[None]:
    """Lock Anny's cache, which it writes in place: one process fills it while the others wait."""
    from anny.paths import get_anny_cache_path

    try:
        get_anny_cache_path().mkdir(parents=True, exist_ok=True)
        lock = (get_anny_cache_path() / "bodyseg.lock").open("w")
    except OSError:  # no lock for a cache that cannot be written: it is complete, or loading Anny will fail
        yield
        return
    with lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


@contextmanager
def _cache_faults() -> Iterator[None]:
    """Turn errors of Anny's cache into BadConfig that names its folder."""
    from anny.paths import get_anny_cache_path
    from safetensors import SafetensorError

    try:
        yield
    except OSError as error:
        raise BadConfig(
            f"anny needs a folder for its cache: cannot use {get_anny_cache_path()} ({error}); "
            "set ANNY_CACHE_DIR to a folder that can be written to"
        ) from error
    except SafetensorError as error:
        raise BadConfig(
            f"anny's cache in {get_anny_cache_path()} is damaged ({error}): delete that folder, the next run fills it"
        ) from error
