"""Memory of processes: the most they had, in one unit on every system, and whether they keep what is freed."""

from __future__ import annotations

import contextlib
import ctypes
import os
import platform
import sys
from pathlib import Path
from typing import Final

with contextlib.suppress(ImportError):  # not on Windows
    import resource


_TRIM_THRESHOLD: Final = (-1, 1 << 28)
_MMAP_THRESHOLD: Final = (-3, 1 << 25)
"""Numbers of glibc's mallopt, and bytes: free memory that is kept, and an array that has a mapping of its own. The
greatest of the second is 32 MB."""


def keep_freed_memory() -> None:
    """Let glibc's malloc keep up to 256 MB of what is freed, for arrays that come again with every frame.

    Else large arrays are given back to the system and fetched anew, at a page fault for every 4 kB. The user's own
    settings of malloc are left as they are; other libraries of C know no such thing, and nothing is done.
    """
    chosen = ("MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_", "GLIBC_TUNABLES")
    if platform.libc_ver()[0] == "glibc" and not any(name in os.environ for name in chosen):
        mallopt = ctypes.CDLL(None).mallopt
        for number, value in (_TRIM_THRESHOLD, _MMAP_THRESHOLD):
            mallopt(number, value)


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
