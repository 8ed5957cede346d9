"""Search for mesh files and landmark files on disk, in a fixed order."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.meshes.readers.files import mesh_stem, mesh_suffix, preferred

LANDMARK_SUFFIXES: Final = (".json", ".lnd", ".lnd.gz")
"""Suffixes of landmark files; of several files for one mesh, the first in this order is read."""


def given_landmarks(path: Path, landmarks: Path | None) -> tuple[Path | None, Path]:
    """Return the landmark file given for all meshes, or None, and the folder to search for others.

    path: the source's folder. landmarks: the user's option. Raises BadConfig if that is neither file nor folder.
    """
    if landmarks is None:
        return None, path
    if landmarks.is_dir():
        return None, landmarks
    if landmarks.is_file():
        return landmarks, path
    raise BadConfig(f"landmarks are a file or a folder, found neither at {landmarks}")


def files_below(root: Path) -> list[Path]:
    """List all files in a folder and its sub-folders, sorted, without names and folders that begin with a dot.

    Links are followed, to each folder once. Pipes, devices and the like are left out. Raises BadConfig for a folder
    that cannot be listed.
    """

    def refuse(error: OSError) -> None:
        raise BadConfig(f"cannot list {error.filename}: {error.strerror or error}") from error

    found: list[Path] = []
    seen: set[tuple[int, int]] = set()
    for folder, folders, names in os.walk(root, onerror=refuse, followlinks=True):
        status = Path(folder).stat()
        identity = (status.st_dev, status.st_ino)
        if identity in seen:  # a link to a folder above itself would never end
            folders.clear()
            continue
        seen.add(identity)
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        found += [file for name in names if not name.startswith(".") and (file := Path(folder, name)).is_file()]
    return sorted(found)


def meshes_in(folder: Path) -> dict[str, Path]:
    """Return stem -> file of all meshes directly in a folder, sorted; of several forms of one mesh, the preferred one.

    Empty if the folder does not exist. Raises BadConfig for one that cannot be listed.
    """
    try:
        names = [entry.name for entry in os.scandir(folder) if entry.is_file()] if folder.is_dir() else []
    except OSError as error:
        raise BadConfig(f"cannot list {folder}: {error.strerror or error}") from error
    forms: dict[str, list[str]] = {}
    for name in sorted(names):
        if mesh_suffix(name) and not name.startswith("."):
            forms.setdefault(mesh_stem(name), []).append(name)
    return {stem: folder / preferred(forms[stem]) for stem in sorted(forms)}


def landmark_file(folders: Sequence[Path], stem: str) -> Path | None:
    """Return the first of STEM.json, STEM.lnd and STEM.lnd.gz in the first folder that holds one, or None."""
    return next(
        (
            folder / f"{stem}{suffix}"
            for folder in folders
            for suffix in LANDMARK_SUFFIXES
            if (folder / f"{stem}{suffix}").is_file()
        ),
        None,
    )
