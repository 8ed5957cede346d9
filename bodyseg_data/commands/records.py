"""Provenance of figures: the command, commit and hardware stored with every result."""

import os
import subprocess
from pathlib import Path

from bodyseg_data.core import BadConfig
from bodyseg_data.machine import hardware


def provenance(command: str) -> dict[str, str]:
    """Return command, commit of the checkout ("unknown" outside one) and hardware; call it before measuring."""
    return {"command": command, "commit": _commit(), "hardware": hardware()}


def check_target(path: Path, option: str, new_folder: bool = False) -> None:
    """Raise BadConfig unless the file that `option` gives can be written; to be called before the measurement.

    new_folder: its folder may be one that is made later, when nothing can be refused any more.
    """
    folder = path.absolute().parent
    while new_folder and not os.path.lexists(folder):
        folder = folder.parent
    if (path.exists() and not path.is_file()) or not folder.is_dir() or folder == Path("/dev"):  # as /dev/stdout
        raise BadConfig(f"{option} needs a file in a folder that is there, found {path}")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise BadConfig(f"{option} needs a folder that can be written, found {path}")


def _commit() -> str:
    here = Path(__file__).parent

    def git(*words: str) -> str:
        # Without optional locks: `git status` would write the index, and leave its lock behind if it is stopped.
        command = ["git", "--no-optional-locks", "-C", str(here), *words]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()

    try:
        changed = "-changed" if git("status", "--porcelain", "--", str(here.parent)) else ""  # new files, too
        return git("rev-parse", "--short=12", "HEAD") + changed
    except (OSError, subprocess.SubprocessError):
        return "unknown"
