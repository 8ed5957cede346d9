"""The environment of benches, and of programs that they start."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import benches
import bodyseg_data
from bodyseg_data.machine import use_compiled
from bodyseg_data.machine.kernels import VARIABLE


def child_environment() -> dict[str, str]:
    """The environment of this process, in which the same packages are found from any folder."""
    homes = [str(Path(package.__path__[0]).parent) for package in (benches, bodyseg_data)]
    before = os.environ.get("PYTHONPATH")
    # Figures are of compiled loops, not of the form that serves until there are any.
    return {VARIABLE: "compiled", **os.environ, "PYTHONPATH": os.pathsep.join([*homes, *([before] if before else [])])}


@contextmanager
def computed_by(choice: str) -> Iterator[None]:
    """Compute loops as `VARIABLE` may say, auto, numpy or compiled, while the context lasts."""
    before = os.environ.get(VARIABLE)
    os.environ[VARIABLE] = choice
    use_compiled.cache_clear()
    try:
        yield
    finally:
        del os.environ[VARIABLE]
        if before is not None:
            os.environ[VARIABLE] = before
        use_compiled.cache_clear()
