"""The motion sequences of "Articulated Mesh Animation from Multi-view Silhouettes" (MIT), read from a user's copy.

Layout: PATH/<SEQUENCE>/meshes/mesh_NNNN.obj, in metres, y up. Whichever of the paper's sequences and frames are there
are read: crane, jumping, march and squat of one man (I_*, subject "B"), bouncing, handstand, march and squat of
another (D_*, subject "C"). All frames of a man number their vertices alike.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.bodies import Body, BodyRef
from bodyseg_data.errors import BadConfig, BadLandmarks, BadMesh
from bodyseg_data.landmarks import LandmarkSet, load_landmarks
from bodyseg_data.mesh import Mesh
from bodyseg_data.splits import split_by_motion

_SUBJECTS: Final[dict[Literal["B", "C"], tuple[str, ...]]] = {
    "B": ("I_crane", "I_jumping", "I_march", "I_squat"),
    "C": ("D_bouncing", "D_handstand", "D_march", "D_squat"),
}
_LANDMARK_SETS: Final = {"B": "mit_I"}
_FRAME: Final = re.compile(r"mesh_(\d{4,})\.obj")


class MitBodies:
    """The frames found below `path`, sequence by sequence in the paper's order. Raises BadConfig if there are none."""

    name = "mit"

    def __init__(self, path: Path | str) -> None:
        self._files: dict[BodyRef, Path] = {}
        root = Path(path)
        for subject, sequences in _SUBJECTS.items():
            for sequence in sequences:
                motion = sequence.partition("_")[2]
                for number, file in _frames(root / sequence / "meshes"):
                    mesh, split = f"{sequence}_{number}", split_by_motion(subject, motion)
                    self._files[BodyRef(subject, subject, mesh, motion, split)] = file
        if not self._files:
            wanted = ", ".join(sequence for sequences in _SUBJECTS.values() for sequence in sequences)
            raise BadConfig(
                f"the source 'mit' needs SEQUENCE/meshes/mesh_NNNN.obj in its folder, with SEQUENCE one of {wanted}: "
                f"found none in {root}"
            )

    def bodies(self) -> Sequence[BodyRef]:
        """All frames found: sequences in the paper's order, frames by number."""
        return tuple(self._files)

    def fingerprint(self, bodies: Sequence[BodyRef]) -> str:
        """Covers every byte of the frames' files and of the landmark sets. Raises BadLandmarks as `build` does."""
        digest = hashlib.sha256()
        for body in bodies:
            digest.update(repr(self._landmarks(body).vertices).encode())
            try:
                digest.update(self._files[body].read_bytes())
            except OSError as error:
                raise BadMesh(f"cannot read {self._files[body]}: {error.strerror or error}") from error
        return digest.hexdigest()

    def build(self, body: BodyRef) -> Body:
        """One frame, turned to face the front as I_crane begins; where the man walks and turns to is kept.

        Raises BadMesh, naming the file, for a file that cannot be read as a body; BadLandmarks for subject C, whose
        landmarks do not ship; BadConfig for a body of another source.
        """
        landmarks = self._landmarks(body)
        vertices, faces = _read_obj(self._files[body])
        try:
            mesh = Mesh(body.mesh, _facing_front(vertices), faces)
        except BadMesh as error:
            raise BadMesh(f"{error} (read from {self._files[body]})") from None
        return Body(mesh, landmarks.for_mesh(mesh))

    def _landmarks(self, body: BodyRef) -> LandmarkSet:
        if body not in self._files:
            raise BadConfig(f"the source 'mit' has no body {body.mesh!r} of subset {body.subset!r}")
        if body.subset not in _LANDMARK_SETS:
            raise BadLandmarks(
                f"a body needs a landmark set, found none for subject {body.subset} (sequences D_*) "
                f"at mesh {body.mesh}: only I_* can be labelled, so move D_* out of the folder"
            )
        return load_landmarks(_LANDMARK_SETS[body.subset])


def _frames(folder: Path) -> list[tuple[str, Path]]:
    """(number as written, file) of every frame in a folder, by number; empty if there is no such folder."""
    if not folder.is_dir():
        return []
    matches = ((_FRAME.fullmatch(file.name), file) for file in folder.iterdir() if file.is_file())
    return sorted(((match[1], file) for match, file in matches if match), key=lambda frame: (int(frame[0]), frame[0]))


def _facing_front(vertices: NDArray[np.float64]) -> NDArray[np.float64]:
    """A quarter turn about y: in I_crane the man begins facing -x."""
    x, y, z = vertices.T
    return np.stack([z, y, -x], axis=1)


def _read_obj(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Vertices [V, 3] and triangles [F, 3] of an OBJ file, both in the file's order, which landmarks rely on.

    Reads what the sequences use: lines "v x y z" and "f a b c" (or "a/t/n"), vertices counted from 1.
    """
    vertices: list[list[float]] = []
    faces: list[list[int]] = []
    try:
        with path.open(encoding="ascii") as lines:
            for number, line in enumerate(lines, 1):
                kind, *words = line.split() or ("",)
                if kind == "v":
                    vertices.append([float(word) for word in words[:3]])
                elif kind == "f":
                    faces.append([int(word.partition("/")[0]) - 1 for word in words])
                if kind in ("v", "f") and (len(words) < 3 or (kind == "f" and len(words) != 3)):
                    raise BadMesh(f"{path}, line {number}: three numbers must follow {kind!r}, found {len(words)}")
        return np.array(vertices, np.float64).reshape(-1, 3), np.array(faces, np.int32).reshape(-1, 3)
    except OSError as error:
        raise BadMesh(f"cannot read {path}: {error.strerror or error}") from error
    except (ValueError, OverflowError) as error:  # not a number, not text at all, or an index beyond 32 bits
        raise BadMesh(f"{path} is not an OBJ file of plain triangles: {error}") from error
