"""Peak memory of processes, in one unit on every system."""

from __future__ import annotations

import contextlib
import sys
from pathlib import Path

with contextlib.suppress(ImportError):  # not on Windows
    import resource


def peak_mb(process: int | None = None) -> float | None:
    """Return the most memory that a process has had resident at once, in MB (1 000 000 bytes).

    process: number of another process of this machine, None for this one. None is returned where the system does not
    tell: for a process that has ended, and other processes on systems without /proc.
    """
    kilobytes = _high_water_kib("self" if process is None else str(process))
    if kilobytes is not None:
        return round(kilobytes * 1024 / 1e6, 1)
    if process is not None or "resource" not in globals():
        return None
    # Bytes on macOS, KiB elsewhere. On Linux a process inherits its parent's, so /proc comes first.
    unit = 1 if sys.platform == "darwin" else 1024
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6, 1)


def _high_water_kib(process: str) -> int | None:
    """The entry VmHWM of Linux's /proc, KiB."""
    try:
        lines = Path("/proc", process, "status").read_text().splitlines()
    except OSError:
        return None
    for line in lines:
        if line.startswith("VmHWM:"):
            return int(line.split()[1])
    return None
