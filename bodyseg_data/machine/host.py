"""The hardware that this process runs on, the memory that it had, and memory that is used again.

Fresh memory costs a page fault for every 4 kB written.
"""

import ctypes
import os
import platform
import re
import resource
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

_TRADE_MARK: Final = re.compile(r"\((?:R|TM)\)")
_INSTRUCTIONS: Final = {"amx_tile": "AMX", "avx512f": "AVX-512"}
"""Flags of processors -> instructions that decide how fast a network is there, the quickest first."""

_BFLOAT16: Final = frozenset({"amx_bf16", "avx512_bf16"})
"""The flags of processors with instructions for bfloat16; others compute it by way of float32, slower than that."""

_SHARE: Final = ("cpu.max", "cpu/cpu.cfs_quota_us", "cpu/cpu.cfs_period_us")  # microseconds a period: cgroup 2, or 1

_TRIM_THRESHOLD: Final = (-1, 1 << 28)
_MMAP_THRESHOLD: Final = (-3, 1 << 25)
"""Parameters of glibc's mallopt, each with its bytes: how much free memory is kept, and from which size on an array has
a mapping of its own, 32 MB at most."""


def processors() -> int:
    """Return the number of processors that this process may use, no more than a container's share of their time."""
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    share = [line for name in _SHARE for line in _lines(f"/sys/fs/cgroup/{name}")]
    quota, period = " ".join(share).split() or ("max", "1")
    return count if quota in ("max", "-1") else min(count, max(1, round(int(quota) / int(period))))


def hardware() -> str:
    """Describe processors and memory in one line: "2 cores of Intel Xeon Processor with AMX (x86_64), 24 GiB"."""
    about = _lines("/proc/cpuinfo")
    names = [line.partition(":")[2] for line in about if line.startswith("model name")]
    names = names or _lines("/proc/device-tree/model") or [platform.processor() or "unknown"]  # ARM's list has no names
    name = " ".join(_TRADE_MARK.sub("", names[0]).strip("\0").split())
    name += next((f" with {words}" for flag, words in _INSTRUCTIONS.items() if flag in _flags(about)), "")
    kilobytes = [int(line.split()[1]) for line in _lines("/proc/meminfo") if line.startswith("MemTotal")]
    memory = f", {kilobytes[0] / 1024**2:.0f} GiB" if kilobytes else ""
    return f"{processors()} cores of {name} ({platform.machine()}){memory}"


def computes_bfloat16() -> bool:
    """True on a processor that is known to have instructions for bfloat16, as Linux names them."""
    return not _BFLOAT16.isdisjoint(_flags(_lines("/proc/cpuinfo")))


def _flags(about: Sequence[str]) -> frozenset[str]:
    """Flags of the first processor. about: lines of /proc/cpuinfo."""
    return frozenset(next((line.split()[2:] for line in about if line.startswith("flags")), ()))


def _lines(path: str) -> list[str]:
    try:
        return Path(path).read_text().splitlines()
    except OSError:
        return []


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


def peak_mb() -> float:
    """Return the most memory that this process has had resident at once, in MB (1 000 000 bytes)."""
    for line in _lines("/proc/self/status"):
        if line.startswith("VmHWM:"):  # KiB
            return round(int(line.split()[1]) * 1024 / 1e6, 1)
    # Bytes on macOS, KiB elsewhere. On Linux a process inherits its parent's, so /proc comes first.
    unit = 1 if sys.platform == "darwin" else 1024
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6, 1)
