"""The motion sequences of "Articulated Mesh Animation from Multi-view Silhouettes" (MIT), read from a user's copy.

Layout: PATH/<SEQUENCE>/meshes/mesh_NNNN.obj (also gzipped), y up: crane, jumping, march and squat of one man (I_*, the
paper's subject "B"), bouncing, handstand, march and squat of another (D_*, subject "C"). All frames of a man number
their vertices alike. Landmarks of I_* ship with the package; those of D_* are the user's: PATH/landmarks_C.json.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Final, Literal

from bodyseg_data.bodies.file_search import given_landmarks, landmark_file, meshes_in
from bodyseg_data.bodies.mesh_bodies import MeshBodies, MeshFile
from bodyseg_data.bodies.mesh_options import DEFAULTS, MeshOptions
from bodyseg_data.bodies.source import BodyRef
from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.splits import split_by_motion

SEQUENCES: Final[dict[Literal["B", "C"], dict[str, int]]] = {
    "B": {"I_crane": 175, "I_jumping": 150, "I_march": 250, "I_squat": 250},
    "C": {"D_bouncing": 175, "D_handstand": 175, "D_march": 250, "D_squat": 250},
}
"""Frames of every sequence, by subject."""

MESHES: Final = tuple(
    f"{sequence}/meshes/mesh_{number:04d}.obj"
    for sequences in SEQUENCES.values()
    for sequence, frames in sequences.items()
    for number in range(frames)
)
"""Files of a complete copy."""

_SHIPPED: Final = {"B": "mit_I"}
_STEM: Final = re.compile(r"mesh_(\d{4,6})")


class MitBodies(MeshBodies):
    """Frames found below a folder, sequence by sequence in the paper's order. Raises BadConfig if there are none.

    Every sequence is rotated as a whole, so that the man faces the front as it begins; his later directions are kept.
    landmarks: a file for subject C, or a folder that holds landmarks_C.json and, to replace those that ship,
    landmarks_B.json.
    """

    name = "mit"

    def __init__(self, path: Path, landmarks: Path | None = None, options: MeshOptions = DEFAULTS) -> None:
        given, folder = given_landmarks(path, landmarks)
        files: dict[BodyRef, MeshFile] = {}
        missing: list[str] = []
        for subject, sequences in SEQUENCES.items():
            labelled = landmark_file([folder], f"landmarks_{subject}") or _SHIPPED.get(subject)
            if subject == "C" and given is not None:
                labelled = given
            wanted = f"subject {subject} ({', '.join(sequences)}): put landmarks_{subject}.json into {folder}, give "
            wanted += "it with --landmarks (bodyseg landmarks --propose makes one), or leave these sequences out"
            if labelled is None and given is None and any((path / sequence).is_dir() for sequence in sequences):
                missing.append(f"landmarks_{subject}.json (for {', '.join(sequences)})")
            for sequence, count in sequences.items():
                motion, found = sequence.partition("_")[2], _frames(path / sequence / "meshes", count)
                for number in range(count):
                    if number in found:
                        ref = BodyRef(
                            subject, subject, f"{sequence}_{number:04d}", motion, split_by_motion(subject, motion)
                        )
                        files[ref] = MeshFile(found[number], labelled, wanted, group=sequence)
                    else:
                        missing.append(f"{sequence}/meshes/mesh_{number:04d}.obj")
        if not files:
            raise BadConfig(
                "the source 'mit' needs SEQUENCE/meshes/mesh_NNNN.obj in its folder, with SEQUENCE one of "
                f"{', '.join(name for names in SEQUENCES.values() for name in names)}: found none in {path}"
            )
        if given is not None and not any(ref.subject == "C" for ref in files):
            raise BadConfig(
                f"a landmark file is for subject C (D_*), found none of its frames in {path}: to replace the landmarks "
                "of subject B give a folder that holds landmarks_B.json"
            )
        # The sequences stand on the plane y = 0; a handstand would mislead the search for what is up.
        super().__init__(files, missing, replace(options, up="y") if options.up == "auto" else options)


def _frames(folder: Path, count: int) -> dict[int, Path]:
    """Return number -> file of the frames in a folder, without numbers that the complete sequence lacks."""
    matches = [(_STEM.fullmatch(stem), file) for stem, file in meshes_in(folder).items()]
    return {int(match[1]): file for match, file in matches if match and int(match[1]) < count}
