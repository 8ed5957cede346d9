"""Bodies to measure on: meshes in a folder, landmarks annotated on them, who each body is, and its pose."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.bodies.mesh_bodies import files_below, landmark_file, meshes_in
from bodyseg_data.core import BadConfig
from bodyseg_data.meshes import LandmarkSet, Mesh, PointLandmarks, load_landmark_file, read_mesh
from bodyseg_data.meshes.landmarks import LANDMARKS_FORMAT, parse_points

TABLE_SUFFIX: Final = "_landmarks.json"
"""End of the name of a file that is one JSON table: landmark -> coordinates in metres, in the mesh's frame."""


@dataclass(frozen=True)
class Annotated:
    """A body and its landmarks. points: float64 [33, 3], metres, in the mesh's frame, y up, nearly on the surface.

    person: who it is. pose: the same name for the same pose of another person.
    """

    name: str
    person: str
    pose: str
    path: Path
    mesh: Mesh
    points: NDArray[np.float64]


def annotated_bodies(folder: Path, poses: int) -> list[Annotated]:
    """Read all bodies of a folder that have landmarks, by name.

    The meshes are in metres, y up. A sub-folder holds one person's; in a folder without sub-folders, each `poses`
    meshes in the order of their names are one person's. Poses are numbered in the same order. Raises BadConfig if no
    mesh has landmarks, BadMesh and BadLandmarks for files that cannot be read.
    """
    bodies: list[Annotated] = []
    for parent in sorted({file.parent for file in files_below(folder)}):
        found = [(stem, mesh, file) for stem, mesh in meshes_in(parent).items() if (file := _file(parent, stem))]
        for number, (stem, path, file) in enumerate(found):
            inside = parent.relative_to(folder).as_posix()
            person = f"person {number // poses}" if inside == "." else inside
            pose = f"pose {number % poses if inside == '.' else number}"
            mesh = Mesh(stem, *read_mesh(path))
            bodies.append(Annotated(stem, person, pose, path, mesh, _points(file, mesh)))
    if not bodies:
        raise BadConfig(f"bench people needs meshes with landmarks: NAME{TABLE_SUFFIX}, found none in {folder}")
    return bodies


def _file(folder: Path, stem: str) -> Path | None:
    table = folder / f"{stem}{TABLE_SUFFIX}"
    return table if table.is_file() else landmark_file([folder], stem)


def _points(file: Path, mesh: Mesh) -> NDArray[np.float64]:
    read: LandmarkSet | PointLandmarks
    read = _table(file) if file.name.endswith(TABLE_SUFFIX) else load_landmark_file(file)
    return read.points if isinstance(read, PointLandmarks) else mesh.vertices[read.for_mesh(mesh)]


def _table(file: Path) -> PointLandmarks:
    text = file.read_text(encoding="utf-8-sig")
    try:
        table: Any = json.loads(text)
    except (ValueError, RecursionError):
        table = text  # which the parser below reports
    return parse_points(json.dumps({"format": LANDMARKS_FORMAT, "units": "m", "points": table}), str(file))
