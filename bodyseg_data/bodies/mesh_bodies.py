"""Base of all sources that read mesh files: finds the files, and makes a body of a mesh file and its landmarks.

Meshes that share a topology share one landmark file; by vertex, or by coordinate on the first of them. Meshes of one
group share one alignment, found from its first upright body, so that a motion keeps one frame of reference throughout.
A mesh in no group is aligned by itself.
"""

import hashlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.bodies.alignment import UPRIGHT_DEG, Alignment, UpAxis, find_alignment, metres_a_unit
from bodyseg_data.bodies.source import Body, BodyRef, ListedBodies, MeshOptions
from bodyseg_data.core import BadConfig, BadLandmarks, BadMesh, reported
from bodyseg_data.labels import LANDMARKS
from bodyseg_data.meshes import (
    METRES,
    LandmarkSet,
    Mesh,
    PointLandmarks,
    check_body,
    load_landmark_file,
    load_landmarks,
    mesh_stem,
    preferred,
    read_mesh,
    repair,
    separate,
)

LANDMARK_SUFFIXES: Final = (".json", ".lnd", ".lnd.gz")
"""Suffixes of landmark files; of several files for one mesh, the first in this order is read."""

Surface = tuple[NDArray[np.float64], NDArray[np.int32]]

_MOST_TRIED: Final = 12  # bodies of a group, evenly spaced, of which an upright one is sought
_REMEDY: Final = "; --pymeshlab repairs most scans"
_IN_METRES: Final = (700.0, 1700.0)  # size of a body over that of landmarks in metres that were read as millimetres


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

    Links are followed, to each folder once. Pipes and devices are left out. Raises BadConfig for what cannot be listed.
    """

    def refuse(error: OSError) -> None:
        raise BadConfig(f"cannot list {error.filename}: {error.strerror or error}") from error

    found: list[Path] = []
    seen: set[tuple[int, int]] = set()
    tops = [root]
    for top in tops:  # linked folders come last: what is in PATH/test must not be found as PATH/chosen/latest
        for folder, folders, names in os.walk(top, onerror=refuse):
            identity = (status := Path(folder).stat()).st_dev, status.st_ino
            new = identity not in seen  # a link to a folder above itself would never end
            seen.add(identity)
            folders[:] = sorted(name for name in folders if new and name[0] != ".")
            tops += [link for name in folders if (link := Path(folder, name)).is_symlink()]
            found += [file for name in names if new and name[0] != "." and (file := Path(folder, name)).is_file()]
    return sorted(found)


def meshes_in(folder: Path) -> dict[str, Path]:
    """Return stem -> file of all meshes directly in a folder, sorted; of several forms of one mesh, the preferred one.

    Empty if the folder does not exist. Raises BadConfig for one that cannot be listed.
    """
    with reported(f"cannot list {folder}", BadConfig, OSError):
        names = [entry.name for entry in os.scandir(folder) if entry.is_file()] if folder.is_dir() else []
    forms: dict[str, list[str]] = {}
    for name in sorted(names):
        if (stem := mesh_stem(name)) is not None and not name.startswith("."):
            forms.setdefault(stem, []).append(name)
    return {stem: folder / preferred(forms[stem]) for stem in sorted(forms)}


def landmark_file(folders: Sequence[Path], stem: str) -> Path | None:
    """Return the first of STEM.json, STEM.lnd, STEM.lnd.gz and STEM.JSON ... in the first folder with one, or None."""
    suffixes = (*LANDMARK_SUFFIXES, *map(str.upper, LANDMARK_SUFFIXES))
    files = (folder / f"{stem}{suffix}" for folder in folders for suffix in suffixes)
    return next((file for file in files if file.is_file()), None)


@dataclass(frozen=True)
class MeshFile:
    """Files of one body.

    landmarks: a landmark file, or the name of a set that ships; None if there is none, and then `wanted` names the file
    needed. shared: other meshes of the same topology use the same landmarks. group: of meshes that share an alignment;
    None for a mesh aligned by itself. up: its axis that points up where the user gives none.
    """

    path: Path
    landmarks: Path | str | None
    wanted: str = ""
    shared: bool = True
    group: str | None = None
    up: UpAxis = "auto"


class MeshBodies(ListedBodies[MeshFile]):
    """Bodies read from mesh files. A source derives from it and lists the files."""

    def __init__(self, files: Mapping[BodyRef, MeshFile], missing: Sequence[str], options: MeshOptions) -> None:
        super().__init__(files, missing)
        self._options = options
        self._sets: dict[tuple[Path | str, bool], LandmarkSet | PointLandmarks] = {}  # by file, and whether shared
        self._notes: dict[Path | str, tuple[str, ...]] = {}  # of landmarks by coordinate that meshes share
        self._alignments: dict[str, tuple[Alignment, Path]] = {}

    def fingerprint(self, bodies: Sequence[BodyRef]) -> str:
        """Return a digest of every byte of the meshes' files, the landmarks, and the alignments.

        Raises BadLandmarks for a body that has no usable landmark file.
        """
        digest = hashlib.sha256(repr((self._options.units, self._options.up)).encode())
        for group in dict.fromkeys(self._entries[body].group for body in bodies):
            if group is not None:
                alignment = self._group_alignment(group)[0]
                digest.update(f"{alignment.scale!r} {alignment.rotation.astype(int).tolist()}".encode())
        for body in bodies:
            landmarks = self._landmarks(body)
            points = landmarks.vertices if isinstance(landmarks, LandmarkSet) else landmarks.points.tolist()
            digest.update(repr(points).encode())
            with reported(f"cannot read {self._entries[body].path}", BadMesh, OSError):
                digest.update(self._entries[body].path.read_bytes())
        return digest.hexdigest()

    def build(self, body: BodyRef) -> Body:
        """Build one body in the body frame.

        Raises BadMesh, naming the file, for one that cannot be read as a body; BadLandmarks for one whose landmarks are
        missing or do not fit; BadConfig for a body of another source.
        """
        landmarks, file = self._landmarks(body), self.entry(body)
        vertices, faces, alignment = self._placed(file, landmarks)
        if isinstance(landmarks, PointLandmarks):
            turned = landmarks.transformed(1.0, alignment.rotation)
            turned, unit_notes = _in_millimetres(turned, _used((vertices, faces)))
            check_body(vertices, faces, turned.points, str(file.path))
            return _snapped((vertices, faces), body.mesh, file.path, turned, unit_notes, self._options.pymeshlab)
        landmarks.check_counts(len(vertices), len(faces), str(file.path))
        check_body(vertices, faces, vertices[list(landmarks.vertices)], str(file.path))
        mesh = _mesh(body.mesh, vertices, faces, file.path)
        found = landmarks.for_mesh(mesh)
        where = f"landmarks {landmarks.source} on mesh {mesh.name}"
        found, moved = separate(mesh, found, mesh.vertices[found], where)
        return Body(mesh, found, (*self._notes.get(file.landmarks or "", ()), *moved, *_ignored(landmarks)))

    def check(self, body: BodyRef) -> None:
        """Build one body, which takes far less than its partition and its views. Raises the errors of `build`."""
        self.build(body)

    def _placed(
        self, file: MeshFile, landmarks: LandmarkSet | PointLandmarks
    ) -> tuple[NDArray[np.float64], NDArray[np.int32], Alignment]:
        """A body's vertices [N, 3] in the body frame, its faces [F, 3], and their alignment. Raises BadMesh."""
        surface = read_mesh(file.path)
        if file.group is None:
            alignment = self._alignment_of(landmarks, surface, file)
        else:
            alignment, decided_by = self._group_alignment(file.group)
            unit: Any = next(unit for unit, metres in METRES.items() if metres == alignment.scale)
            where = f"{file.path}, in the unit of {decided_by}" if self._options.units == "auto" else str(file.path)
            metres_a_unit(_used(surface), unit, where)
        return alignment.apply(surface[0]), surface[1], alignment

    def _landmarks(self, body: BodyRef) -> LandmarkSet | PointLandmarks:
        """Return a body's landmarks; by vertex whenever other bodies share them."""
        file = self.entry(body)
        if file.landmarks is None:
            raise BadLandmarks(f"a body needs landmarks, found none for {file.wanted}")
        if (key := (file.landmarks, file.shared)) not in self._sets:
            with reported("" if file.shared else f"subject {body.subject}", BadLandmarks):
                path = file.landmarks
                read = load_landmark_file(path) if isinstance(path, Path) else load_landmarks(path)
            if file.shared and isinstance(read, PointLandmarks):
                read = self._propagated(read, file.landmarks)
            self._sets[key] = read
        return self._sets[key]

    def _propagated(self, points: PointLandmarks, source: Path | str) -> LandmarkSet:
        """Turn points into vertices, the same for all meshes: on the mesh that has them alone, else on the first."""
        sharing = (item for item in self._entries.items() if item[1].landmarks == source)
        body, file = min(sharing, key=lambda item: item[1].shared)
        surface = read_mesh(file.path)
        scale = metres_a_unit(_used(surface), self._options.units, str(file.path))
        mesh = _mesh(body.mesh, surface[0] * scale, surface[1], file.path)
        points, unit_notes = _in_millimetres(points, mesh.surface_vertices)
        snapped = points.for_mesh(mesh)
        landmarks = LandmarkSet(
            points.source,
            f"meshes numbered like {file.path.name}",
            len(mesh.vertices),
            len(mesh.faces),
            tuple(snapped.vertices.tolist()),
            points.ignored,
        )
        self._notes[source] = (*unit_notes, *snapped.notes, f"{_farthest(snapped.distance_m)} on {file.path.name}")
        return landmarks

    def _group_alignment(self, group: str) -> tuple[Alignment, Path]:
        """Return the alignment found from a group's first upright body, or else from the most upright one tried, and
        that body's mesh file. Bodies that cannot be read are passed over.
        """
        if group not in self._alignments:
            members = [body for body, file in self._entries.items() if file.group == group]
            count = min(len(members), _MOST_TRIED)
            found: list[tuple[Alignment, Path]] = []
            problems: list[BadMesh | BadLandmarks] = []
            for index in range(count):
                body = members[index * len(members) // count]
                file = self._entries[body]
                try:
                    found.append((self._alignment_of(self._landmarks(body), read_mesh(file.path), file), file.path))
                except (BadMesh, BadLandmarks) as error:
                    problems.append(error)
                    continue
                if found[-1][0].lean_deg <= UPRIGHT_DEG:
                    break
            if not found:
                raise problems[0]
            self._alignments[group] = min(found, key=lambda entry: entry[0].lean_deg)
        return self._alignments[group]

    def _alignment_of(self, landmarks: LandmarkSet | PointLandmarks, surface: Surface, file: MeshFile) -> Alignment:
        if isinstance(landmarks, PointLandmarks):
            points = landmarks.points
        else:
            landmarks.check_counts(len(surface[0]), len(surface[1]), str(file.path))
            points = surface[0][list(landmarks.vertices)]
        up = file.up if self._options.up == "auto" else self._options.up
        return find_alignment(_used(surface), points, self._options.units, up, str(file.path))


def _used(surface: Surface) -> NDArray[np.float64]:
    """Return the vertices that faces use: others in a scan may lie anywhere."""
    return surface[0][np.unique(surface[1])]


def _mesh(name: str, vertices: NDArray[np.float64], faces: NDArray[np.int32], path: Path, remedy: str = "") -> Mesh:
    try:
        return Mesh(name, vertices, faces)
    except BadMesh as error:
        raise BadMesh(f"{error} (read from {path}{remedy})") from error


def _snapped(
    surface: Surface, name: str, path: Path, landmarks: PointLandmarks, unit_notes: Sequence[str], pymeshlab: bool
) -> Body:
    """Make a body with landmarks by coordinate. pymeshlab: repair the mesh if need be, which may renumber vertices."""
    notes = []
    try:
        mesh = _mesh(name, *surface, path, _REMEDY)
    except BadMesh as error:
        if not pymeshlab:
            raise
        notes.append(f"repaired: {str(error.__cause__).removeprefix(f'mesh {name}: ')}")
        mesh = _mesh(name, *repair(name, *surface), path)
    snapped = landmarks.for_mesh(mesh)
    notes += [*unit_notes, *snapped.notes, _farthest(snapped.distance_m), *_ignored(landmarks)]
    return Body(mesh, snapped.vertices, tuple(notes))


def _ignored(landmarks: LandmarkSet | PointLandmarks) -> tuple[str, ...]:
    count = len(landmarks.ignored)
    return (f"{count} other names in the landmark file ignored",) if count else ()


def _in_millimetres(landmarks: PointLandmarks, surface: NDArray[np.float64]) -> tuple[PointLandmarks, tuple[str, ...]]:
    """Enlarge landmarks by 1000, with a note, if a thousandth as large as vertices [N, 3]: metres, not millimetres."""
    ratio = np.ptp(surface, axis=0).max() / max(np.ptp(landmarks.points, axis=0).max(), 1e-9)
    if not _IN_METRES[0] < ratio < _IN_METRES[1]:
        return landmarks, ()
    note = "landmarks read as metres: as millimetres they are a thousandth of the body"
    return landmarks.transformed(1000.0, np.eye(3)), (note,)


def _farthest(distance_m: NDArray[np.float64]) -> str:
    worst = int(distance_m.argmax())
    return f"landmarks snapped by up to {1000 * distance_m[worst]:.1f} mm ({LANDMARKS[worst]})"
