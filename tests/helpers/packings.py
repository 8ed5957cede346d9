"""Packings that are cut short, and what they leave."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from concurrent.futures import Executor, Future
from pathlib import Path
from typing import Any

from bodyseg_data.packing import Packing


def contents(folder: Path) -> dict[str, str]:
    """Name -> hash of every file of a set."""
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.iterdir() if path.is_file()}


class Interrupted(Exception):
    """Stands for whatever ends a process in the middle of its work."""


class Renders(Executor):
    """Renders at once what was not rendered before, and ends the packing after so many runs.

    Rendering twice gives the same bytes, which the first test here shows; what follows is about what is kept of it.
    """

    def __init__(self, known: dict[Any, Any], limit: float = math.inf) -> None:
        self._known, self._left = known, limit

    def submit(self, fn: Callable[..., Any], /, packing: Packing, *run: Any, **kwargs: Any) -> Future[Any]:  # type: ignore[override]
        future: Future[Any] = Future()
        self._left -= 1
        if self._left < 0:
            future.set_exception(Interrupted())
            return future
        key = (packing.tolerance_mm, packing.template, run[:2])
        try:
            if key not in self._known:
                self._known[key] = fn(packing, *run, **kwargs)
            future.set_result(self._known[key])
        except Exception as error:
            future.set_exception(error)
        return future
