"""CAESAR: standing people, scanned with markers on their landmarks, read from a user's copy; the subset "people".

Layout: anywhere below PATH one mesh a subject (csr0001a.ply, .obj or .off, also gzipped) and its landmarks under the
same name (csr0001a.lnd), in the same folder or another; capitals do not matter. The paper uses 583 subjects.
Where a subject has several scans (a standing, b and c sitting), the standing one is read.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Final

from bodyseg_data.bodies.file_search import LANDMARK_SUFFIXES, files_below, given_landmarks
from bodyseg_data.bodies.mesh_bodies import MeshBodies, MeshFile
from bodyseg_data.bodies.mesh_options import DEFAULTS, MeshOptions
from bodyseg_data.bodies.names import key_name
from bodyseg_data.bodies.source import BodyRef
from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.splits import split_by_order
from bodyseg_data.meshes.readers.files import mesh_stem, mesh_suffix, preferred

SUBJECTS: Final = 583

MESHES: Final = tuple(f"subject {number:03d}" for number in range(1, SUBJECTS + 1))
"""Subjects of a complete copy; the paper does not name them."""

_SITTING: Final = re.compile(r"(.*\d)[bc]")
_LONGEST: Final = 28  # of a subject's name, which is twice in a sample key


class CaesarBodies(MeshBodies):
    """Subjects found below a folder, by name: the first 467 for training, the others for testing.

    landmarks: a folder to search for the .lnd files, or one file for meshes that all have one topology.
    Raises BadConfig if there are none, more than 583, or two meshes of one name in different folders.
    """

    name = "caesar"

    def __init__(self, path: Path, landmarks: Path | None = None, options: MeshOptions = DEFAULTS) -> None:
        given, folder = given_landmarks(path, landmarks)
        meshes = _standing(path)
        points = _by_name(folder, _landmark_stem)
        files: dict[BodyRef, MeshFile] = {}
        missing: list[str] = []
        for index, (subject, mesh) in enumerate(meshes.items()):
            own = _own(points.get(subject, []), mesh)
            stem = mesh_stem(mesh.name)
            if own is None and given is None:
                missing.append(f"{stem}.lnd")
            wanted = f"subject {stem}: no {stem}.lnd anywhere in {folder}"
            name = key_name(stem, _LONGEST)
            ref = BodyRef("people", name, name, "standing", split_by_order("people", index))
            files[ref] = MeshFile(mesh, own or given, wanted, shared=own is None, standing=True)
        super().__init__(files, (*missing, *MESHES[len(meshes) :]), options)


def _standing(path: Path) -> dict[str, Path]:
    """Return lower-case name -> mesh file of every subject, sorted."""
    found = _by_name(path, lambda name: mesh_stem(name) if mesh_suffix(name) else None)
    chosen = {}
    for name in sorted(found):
        sitting = _SITTING.fullmatch(name)
        if sitting and f"{sitting[1]}a" in found:
            continue
        folders = sorted({file.parent for file in found[name]})
        if len(folders) > 1:
            raise BadConfig(f"a subject needs one mesh, found {name} in {folders[0]} and in {folders[1]}")
        chosen[name] = folders[0] / preferred([file.name for file in found[name]])
    if not chosen:
        raise BadConfig(f"the source 'caesar' needs one mesh (.ply, .obj, .off) a subject: found none in {path}")
    if len(chosen) > SUBJECTS:
        raise BadConfig(
            f"the source 'caesar' has the paper's {SUBJECTS} subjects, found {len(chosen)} in {path}: take out those "
            "that are not wanted, or read them all with --source folder"
        )
    return chosen


def _own(candidates: list[Path], mesh: Path) -> Path | None:
    """Return a subject's landmark file: the one beside its mesh, or else the only one."""
    beside = [file for file in candidates if file.parent == mesh.parent]
    if not beside and len({file.parent for file in candidates}) > 1:
        raise BadConfig(f"a subject needs one landmark file, found {candidates[0]} and {candidates[1]} for {mesh}")
    return min(
        beside or candidates, key=lambda file: LANDMARK_SUFFIXES.index(_landmark_suffix(file.name)), default=None
    )


def _landmark_suffix(name: str) -> str:
    """Return the landmark file's suffix that a name ends in, or ""."""
    return next((suffix for suffix in LANDMARK_SUFFIXES if name.lower().endswith(suffix)), "")


def _landmark_stem(name: str) -> str | None:
    suffix = _landmark_suffix(name)
    return name[: -len(suffix)] if suffix else None


def _by_name(root: Path, stem_of: Callable[[str], str | None]) -> dict[str, list[Path]]:
    """Return lower-case stem -> files of that stem anywhere below a folder, sorted."""
    found: dict[str, list[Path]] = {}
    for file in files_below(root):
        stem = stem_of(file.name)
        if stem:
            found.setdefault(stem.lower(), []).append(file)
    return found
