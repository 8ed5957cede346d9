"""Where figures come from: the command, commit and machine that stand beside every result."""

from __future__ import annotations

import os
import platform
import subprocess
from pathlib import Path


def provenance(command: str) -> dict[str, str]:
    """Command, commit (of the checkout this package runs from, "unknown" outside one) and hardware of a measurement."""
    return {"command": command, "commit": _commit(), "hardware": _hardware()}


def _commit() -> str:
    here = Path(__file__).parent

    def git(*words: str) -> str:
        done = subprocess.run(["git", "-C", str(here), *words], capture_output=True, text=True, check=True, timeout=10)
        return done.stdout.strip()

    try:
        changed = "-changed" if git("status", "--porcelain", "--untracked-files=no") else ""
        return git("rev-parse", "--short=12", "HEAD") + changed
    except (OSError, subprocess.SubprocessError):
        return "unknown"


def _hardware() -> str:
    names = [line.partition(":")[2].strip() for line in _lines("/proc/cpuinfo") if line.startswith("model name")]
    kilobytes = [int(line.split()[1]) for line in _lines("/proc/meminfo") if line.startswith("MemTotal")]
    memory = f", {kilobytes[0] / 1024**2:.0f} GiB" if kilobytes else ""
    processor = names[0] if names else platform.processor()
    return f"{len(os.sched_getaffinity(0))} cores of {processor or 'unknown'} ({platform.machine()}){memory}"


def _lines(path: str) -> list[str]:
    try:
        return Path(path).read_text().splitlines()
    except OSError:
        return []
