"""The bodies of the paper, read from a user's copies (docs/how-to/sources.md): SCAPE, MIT's sequences and CAESAR.

scape, subject "A": one man in 71 postures (Anguelov et al. 2005). PATH/mesh000.ply to mesh071.ply, or .obj or .off,
each also gzipped; number 051 does not exist. One landmark file serves all.

mit: the sequences of "Articulated Mesh Animation from Multi-view Silhouettes". PATH/<SEQUENCE>/meshes/mesh_NNNN.obj
(also gzipped), y up: crane, jumping, march and squat of one man (I_*, subject "B"), bouncing, handstand, march and
squat of another (D_*, subject "C"). Landmarks of I_* ship with the package.

caesar, the subset "people": standing people, scanned with markers on their landmarks (csr0001a.ply and .lnd). Of
several scans of a subject (a standing, b and c sitting), the standing one is read.
"""

import re
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Final, Literal

from bodyseg_data.bodies.mesh_bodies import (
    LANDMARK_SUFFIXES,
    MeshBodies,
    MeshFile,
    files_below,
    given_landmarks,
    landmark_file,
    meshes_in,
)
from bodyseg_data.bodies.source import DEFAULTS, BodyRef, MeshOptions, key_name
from bodyseg_data.core import BadConfig
from bodyseg_data.meshes import mesh_stem, preferred
from bodyseg_data.samples import split_by_motion, split_by_order

SCAPE_NUMBERS: Final = tuple(number for number in range(72) if number != 51)
"""Numbers of the 71 meshes, in order."""

SCAPE_MESHES: Final = tuple(f"mesh{number:03d}.ply" for number in SCAPE_NUMBERS)
"""Files of a complete copy."""

_SCAPE_STEM: Final = re.compile(r"mesh(\d{1,6})", re.IGNORECASE)

MIT_SEQUENCES: Final[dict[Literal["B", "C"], dict[str, int]]] = {
    "B": {"I_crane": 175, "I_jumping": 150, "I_march": 250, "I_squat": 250},
    "C": {"D_bouncing": 175, "D_handstand": 175, "D_march": 250, "D_squat": 250},
}
"""Frames of every sequence, by subject."""

MIT_MESHES: Final = tuple(
    f"{sequence}/meshes/mesh_{number:04d}.obj"
    for sequences in MIT_SEQUENCES.values()
    for sequence, frames in sequences.items()
    for number in range(frames)
)
"""Files of a complete copy."""

_MIT_LANDMARKS: Final = {"B": "mit_I"}
_MIT_STEM: Final = re.compile(r"mesh_(\d{4,6})")

CAESAR_SUBJECTS: Final = 583

CAESAR_MESHES: Final = tuple(f"subject {number:03d}" for number in range(1, CAESAR_SUBJECTS + 1))
"""Subjects of a complete copy; the paper does not name them."""

_SITTING: Final = re.compile(r"(.*\d)[bc]")
_LONGEST_SUBJECT: Final = 28  # of a subject's name, which is twice in a sample key


class ScapeBodies(MeshBodies):
    """Postures found in a folder, by number. Raises BadConfig if there are none."""

    name, reads = "scape", "mesh000.ply to mesh071.ply"

    def __init__(self, path: Path, landmarks: Path | None = None, options: MeshOptions = DEFAULTS) -> None:
        given, folder = given_landmarks(path, landmarks)
        labelled = given or landmark_file([folder], "landmarks")
        found: dict[int, Path] = {}
        for stem, file in meshes_in(path).items():
            match = _SCAPE_STEM.fullmatch(stem)
            if match and int(match[1]) in SCAPE_NUMBERS:
                found.setdefault(int(match[1]), file)
        if not found:
            raise BadConfig(f"the source 'scape' needs mesh000.ply to mesh071.ply in its folder: found none in {path}")
        wanted = f"the meshes in {path}: put landmarks.json there, or give a file with --landmarks"
        files = {
            BodyRef("A", "A", f"mesh{number:03d}", "posture", split_by_order("A", index)): MeshFile(
                found[number], labelled, wanted, group="A"
            )
            for index, number in enumerate(SCAPE_NUMBERS)
            if number in found
        }
        missing = [name for number, name in zip(SCAPE_NUMBERS, SCAPE_MESHES, strict=True) if number not in found]
        if labelled is None:
            missing.append("landmarks.json")
        super().__init__(files, missing, options)


class MitBodies(MeshBodies):
    """Frames found below a folder, sequence by sequence in the paper's order. Raises BadConfig if there are none.

    Every sequence is rotated as a whole, so that the man faces the front as it begins; his later directions are kept.
    landmarks: a file for subject C, or a folder that holds landmarks_C.json and, to replace those that ship,
    landmarks_B.json.
    """

    name, reads = "mit", "I_crane and the other sequences"

    def __init__(self, path: Path, landmarks: Path | None = None, options: MeshOptions = DEFAULTS) -> None:
        given, folder = given_landmarks(path, landmarks)
        files: dict[BodyRef, MeshFile] = {}
        missing: list[str] = []
        for subject, sequences in MIT_SEQUENCES.items():
            labelled = landmark_file([folder], f"landmarks_{subject}") or _MIT_LANDMARKS.get(subject)
            if subject == "C" and given is not None:
                labelled = given
            wanted = f"subject {subject} ({', '.join(sequences)}): put landmarks_{subject}.json into {folder}, give "
            wanted += "it with --landmarks, or leave these sequences out"
            if labelled is None and given is None and any((path / sequence).is_dir() for sequence in sequences):
                missing.append(f"landmarks_{subject}.json (for {', '.join(sequences)})")
            for sequence, count in sequences.items():
                motion, found = sequence.partition("_")[2], _frames(path / sequence / "meshes", count)
                for number in range(count):
                    if number in found:
                        ref = BodyRef(
                            subject, subject, f"{sequence}_{number:04d}", motion, split_by_motion(subject, motion)
                        )
                        # It stands on the plane y = 0; a handstand would mislead the search for what is up.
                        files[ref] = MeshFile(found[number], labelled, wanted, group=sequence, up="y")
                    else:
                        missing.append(f"{sequence}/meshes/mesh_{number:04d}.obj")
        if not files:
            raise BadConfig(f"the source 'mit' needs files like I_crane/meshes/mesh_0000.obj: found none in {path}")
        if given is not None and not any(ref.subject == "C" for ref in files):
            raise BadConfig(f"a landmark file is for subject C (D_*), found none of its frames in {path}")
        super().__init__(files, missing, options)


def _frames(folder: Path, count: int) -> dict[int, Path]:
    """Return number -> file of the frames in a folder, without numbers that the complete sequence lacks."""
    matches = [(_MIT_STEM.fullmatch(stem), file) for stem, file in meshes_in(folder).items()]
    return {int(match[1]): file for match, file in matches if match and int(match[1]) < count}


class CaesarBodies(MeshBodies):
    """Subjects found below a folder, by name: the first 467 for training, the others for testing.

    landmarks: a folder to search for the .lnd files, or one file for meshes that all have one topology.
    Raises BadConfig if there are none, more than 583, or two meshes of one name in different folders.
    """

    name, reads = "caesar", "one mesh and one .lnd file a subject"

    def __init__(self, path: Path, landmarks: Path | None = None, options: MeshOptions = DEFAULTS) -> None:
        given, folder = given_landmarks(path, landmarks)
        meshes = _standing(path)
        points = _by_name(folder, partial(mesh_stem, suffixes=LANDMARK_SUFFIXES))
        files: dict[BodyRef, MeshFile] = {}
        missing: list[str] = []
        for index, (subject, mesh) in enumerate(meshes.items()):
            own = _own(points.get(subject, []), mesh)
            stem = mesh_stem(mesh.name) or mesh.name
            if own is None and given is None:
                missing.append(f"{stem}.lnd")
            wanted = f"subject {stem}: no {stem}.lnd anywhere in {folder}"
            name = key_name(stem, _LONGEST_SUBJECT)
            ref = BodyRef("people", name, name, "standing", split_by_order("people", index))
            files[ref] = MeshFile(mesh, own or given, wanted, shared=own is None)
        super().__init__(files, (*missing, *CAESAR_MESHES[len(meshes) :]), options)


def _standing(path: Path) -> dict[str, Path]:
    """Return lower-case name -> mesh file of every subject, sorted."""
    found = _by_name(path, mesh_stem)
    chosen = {}
    for name in sorted(found):
        if (sitting := _SITTING.fullmatch(name)) and f"{sitting[1]}a" in found:
            continue
        folders = sorted({file.parent for file in found[name]})
        if len(folders) > 1:
            raise BadConfig(f"a subject needs one mesh, found {name} in {folders[0]} and in {folders[1]}")
        chosen[name] = folders[0] / preferred([file.name for file in found[name]])
    if not chosen:
        raise BadConfig(f"the source 'caesar' needs one mesh (.ply, .obj, .off) a subject: found none in {path}")
    if len(chosen) > CAESAR_SUBJECTS:
        raise BadConfig(f"'caesar' has {CAESAR_SUBJECTS} subjects, found {len(chosen)} in {path}: use --source folder")
    return chosen


def _own(candidates: list[Path], mesh: Path) -> Path | None:
    """Return a subject's landmark file: the one beside its mesh, or else the only one."""
    beside = [file for file in candidates if file.parent == mesh.parent]
    if not beside and len({file.parent for file in candidates}) > 1:
        raise BadConfig(f"a subject needs one landmark file, found {candidates[0]} and {candidates[1]} for {mesh}")
    files = {file.name: file for file in beside or candidates}
    return files[preferred([*files], LANDMARK_SUFFIXES)] if files else None


def _by_name(root: Path, stem_of: Callable[[str], str | None]) -> dict[str, list[Path]]:
    """Return lower-case stem -> files of that stem anywhere below a folder, sorted."""
    found: dict[str, list[Path]] = {}
    for file in files_below(root):
        if stem := stem_of(file.name):
            found.setdefault(stem.lower(), []).append(file)
    return found


_PARTS: Final[dict[str, tuple[Callable[..., MeshBodies], tuple[str, ...]]]] = {
    "scape": (ScapeBodies, SCAPE_MESHES),
    "mit": (MitBodies, MIT_MESHES),
    "caesar": (CaesarBodies, CAESAR_MESHES),
}


class PaperBodies(MeshBodies):
    """Subsets A, B, C and people, in this order: 2329 bodies if all are there.

    landmarks: a folder with sub-folders scape, mit and caesar, in which to look for landmark files instead of in
    `path`. Raises BadConfig if none of the sub-folders is there, or one holds nothing of its source.
    """

    name, reads = "paper", "scape, mit and caesar"

    def __init__(self, path: Path, landmarks: Path | None = None, options: MeshOptions = DEFAULTS) -> None:
        if landmarks is not None and not landmarks.is_dir():
            raise BadConfig(f"the landmarks of the source 'paper' are a folder like its own, found {landmarks}")
        if landmarks is not None and not any(_sub_folder(landmarks, name) for name in _PARTS):
            raise BadConfig(f"--landmarks must hold one of {', '.join(_PARTS)}: found none in {landmarks}")
        files: dict[BodyRef, MeshFile] = {}
        missing: list[str] = []
        for name, (opened, complete) in _PARTS.items():
            folder = _sub_folder(path, name)
            lacking: Sequence[str] = complete
            if folder is not None:
                source = opened(folder, _sub_folder(landmarks, name) if landmarks else None, options)
                files |= {body: source.entry(body) for body in source.bodies()}
                lacking = source.missing()
            missing += [f"{name}/{each}" for each in lacking]
        if not files:
            raise BadConfig(f"the source 'paper' needs the sub-folders {', '.join(_PARTS)}: found none in {path}")
        if len({body.mesh for body in files}) < len(files):
            raise BadConfig(f"meshes must have different names, found a subject of {path}/caesar called like another")
        super().__init__(files, missing, options)


def _sub_folder(path: Path, name: str) -> Path | None:
    """Return the sub-folder of this name in upper or lower case, or None."""
    found = sorted(folder for folder in path.iterdir() if folder.name.lower() == name and folder.is_dir())
    if len(found) > 1:
        raise BadConfig(f"{path} must hold one folder {name}, found {found[0].name} and {found[1].name}")
    return found[0] if found else None
