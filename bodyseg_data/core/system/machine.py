"""Hardware that this process runs on."""

from __future__ import annotations

import os
import platform
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Final

_TRADE_MARK: Final = re.compile(r"\((?:R|TM)\)")
_MATRICES: Final = "amx_tile"
"""The flag of processors that multiply matrices in 16 and 8 bits by AMX, which decides how fast a runtime is there."""


_BFLOAT16: Final = frozenset({"amx_bf16", "avx512_bf16"})
"""The flags of processors with instructions for bfloat16; others compute it by way of float32, slower than that."""


def processors() -> int:
    """Return the number of processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def hardware() -> str:
    """Describe processors and memory in one line: "2 cores of Intel Xeon Processor with AMX (x86_64), 24 GiB"."""
    about = _lines("/proc/cpuinfo")
    names = [line.partition(":")[2] for line in about if line.startswith("model name")]
    name = " ".join(_TRADE_MARK.sub("", names[0] if names else platform.processor()).split())
    if _MATRICES in _flags(about):
        name += " with AMX"
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
