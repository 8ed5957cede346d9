"""The environment of programs that benches start."""

from __future__ import annotations

import os
from pathlib import Path

import benches
import bodyseg_data


def child_environment() -> dict[str, str]:
    """The environment of this process, in which the same packages are found from any folder."""
    homes = [str(Path(package.__path__[0]).parent) for package in (benches, bodyseg_data)]
    before = os.environ.get("PYTHONPATH")
    return {**os.environ, "PYTHONPATH": os.pathsep.join([*homes, *([before] if before else [])])}
