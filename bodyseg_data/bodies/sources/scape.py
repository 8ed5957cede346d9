"""SCAPE: one man in 71 postures (Anguelov et al. 2005), read from a user's copy; the paper's subject "A".

Layout: PATH/mesh000.ply to mesh071.ply, or .obj or .off, each also gzipped; number 051 does not exist. All meshes
number their vertices alike, so one landmark file serves all: PATH/landmarks.json (or .lnd), or the one given.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final

from bodyseg_data.bodies.file_search import given_landmarks, landmark_file, meshes_in
from bodyseg_data.bodies.mesh_bodies import MeshBodies, MeshFile
from bodyseg_data.bodies.mesh_options import DEFAULTS, MeshOptions
from bodyseg_data.bodies.source import BodyRef
from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.splits import split_by_order

NUMBERS: Final = tuple(number for number in range(72) if number != 51)
"""Numbers of the 71 meshes, in order."""

MESHES: Final = tuple(f"mesh{number:03d}.ply" for number in NUMBERS)
"""Files of a complete copy."""

_STEM: Final = re.compile(r"mesh(\d{1,6})", re.IGNORECASE)


class ScapeBodies(MeshBodies):
    """Postures found in a folder, by number. Raises BadConfig if there are none."""

    name = "scape"

    def __init__(self, path: Path, landmarks: Path | None = None, options: MeshOptions = DEFAULTS) -> None:
        given, folder = given_landmarks(path, landmarks)
        labelled = given or landmark_file([folder], "landmarks")
        found: dict[int, Path] = {}
        for stem, file in meshes_in(path).items():
            match = _STEM.fullmatch(stem)
            if match and int(match[1]) in NUMBERS:
                found.setdefault(int(match[1]), file)
        if not found:
            raise BadConfig(f"the source 'scape' needs mesh000.ply to mesh071.ply in its folder: found none in {path}")
        wanted = f"the meshes in {path}: put landmarks.json there, or give a file with --landmarks"
        files = {
            BodyRef("A", "A", f"mesh{number:03d}", "posture", split_by_order("A", index)): MeshFile(
                found[number], labelled, wanted, group="A"
            )
            for index, number in enumerate(NUMBERS)
            if number in found
        }
        missing = [name for number, name in zip(NUMBERS, MESHES, strict=True) if number not in found]
        super().__init__(files, missing, options)
