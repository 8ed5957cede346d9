"""Where figures come from: the command, commit and machine that stand beside every result."""

from __future__ import annotations

import subprocess
from pathlib import Path

from bodyseg_data.machine import hardware


def provenance(command: str) -> dict[str, str]:
    """Command, commit (of the checkout this package runs from, "unknown" outside one) and hardware of a measurement.

    To be asked before the measurement begins.
    """
    return {"command": command, "commit": _commit(), "hardware": hardware()}


def _commit() -> str:
    here = Path(__file__).parent

    def git(*words: str) -> str:
        done = subprocess.run(["git", "-C", str(here), *words], capture_output=True, text=True, check=True, timeout=10)
        return done.stdout.strip()

    try:
        changed = "-changed" if git("status", "--porcelain", "--", str(here.parent)) else ""  # new files, too
        return git("rev-parse", "--short=12", "HEAD") + changed
    except (OSError, subprocess.SubprocessError):
        return "unknown"
