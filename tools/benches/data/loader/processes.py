"""Processor time and memory of worker processes, from Linux's /proc."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path


def processor_seconds(processes: Iterable[int]) -> float | None:
    """User and system time of processes with all their threads, to 10 ms; None where /proc does not provide it."""
    try:
        texts = [Path(f"/proc/{process}/stat").read_text() for process in processes]
    except OSError:
        return None
    # Fields 14 and 15; the name in brackets before them may hold blanks.
    ticks = sum(sum(map(int, text.rpartition(")")[2].split()[11:13])) for text in texts)
    return ticks / os.sysconf("SC_CLK_TCK")


def private_mb(processes: Iterable[int]) -> float | None:
    """Memory that the largest of the processes shares with no other, MB; None without processes or /proc."""
    try:
        texts = [Path(f"/proc/{process}/smaps_rollup").read_text() for process in processes]
    except OSError:
        return None
    kb = [sum(int(line.split()[1]) for line in text.splitlines() if line.startswith("Private_")) for text in texts]
    return round(max(kb) / 1024, 1) if kb else None
