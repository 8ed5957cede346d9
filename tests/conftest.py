"""Fixtures that several test files share."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import Executor, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import checked_arrays  # noqa: F401  # checks the arrays of all that is imported from here on
import pytest
from fakes import FiguresEntry
from folders import SHARED_DATA

from bodyseg_data.bodies.sources import SOURCES
from bodyseg_data.core.views import ViewGrid
from bodyseg_data.packing import pack as packing


@pytest.fixture(scope="session")
def mit_folder() -> Path:
    """The folder of real MIT frames; their licence keeps them out of the repository."""
    folder = Path(os.environ.get("BODYSEG_MIT", SHARED_DATA / "mit"))
    if not (folder / "I_crane").is_dir():
        pytest.skip(f"real MIT frames are absent: no I_crane in {folder} (set BODYSEG_MIT to the folder that has it)")
    return folder


@pytest.fixture(scope="session")
def pack_figures() -> Callable[..., Path]:
    """Pack the plain figures of `fakes` into a folder, in this process; executor: what renders, if not a thread."""

    def pack(out: Path, executor: Executor | None = None, **options: Any) -> Path:
        wanted = {"views": ViewGrid(span_deg=360, count=4), **options}
        with pytest.MonkeyPatch.context() as patch, ThreadPoolExecutor(1) as thread:
            patch.setitem(SOURCES, "open", FiguresEntry())
            packing.pack(packing.Packing("open", **wanted), out, executor or thread, 1)
        return out

    return pack


@pytest.fixture(scope="session")
def figures_set(tmp_path_factory: pytest.TempPathFactory, pack_figures: Callable[..., Path]) -> Path:
    """A set of 24 samples (16 train, 8 test) in shards of 5. Tests must not change it."""
    return pack_figures(tmp_path_factory.mktemp("figures") / "shards", shard_samples=5)
