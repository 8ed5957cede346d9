"""The executor of a packing's jobs."""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import dataclass


@dataclass(frozen=True)
class Engine:
    """An executor of jobs. workers: how many to keep busy. note: one line for the user, or None."""

    executor: Executor
    workers: int
    note: str | None = None
