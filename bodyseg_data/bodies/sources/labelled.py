"""Meshes with labels of their own; the subset "labelled".

A member is a scene: every NAME.scene.json or FOLDER/scene.json if there are any, else every mesh file
(docs/how-to/labelled_meshes.md).
"""

import contextlib
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from os.path import normpath
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.bodies.alignment import Alignment, upright_rotation
from bodyseg_data.bodies.given_labels import ClassTable, NamedCorners, file_labels, labels_from_file
from bodyseg_data.bodies.mesh_bodies import files_below
from bodyseg_data.bodies.source import DEFAULTS, Body, BodyRef, ListedBodies, MeshOptions
from bodyseg_data.bodies.sources.folder import body_ref
from bodyseg_data.core import BadConfig, BadMesh, check_choice, reported
from bodyseg_data.files import Table, read_json
from bodyseg_data.labels import BACKGROUND, Classes, classes_of
from bodyseg_data.meshes import METRES, Mesh, MeshContent, SceneMesh, gltf_buffers, mesh_content, scene_stem, welded
from bodyseg_data.samples import SPLITS

SCENE_NAME: Final = "scene.json"
SCENE_FORMAT: Final = "bodyseg scene 1"

_BESIDE: Final = ("{}.labels.json", "{}.labels.npy", "{}.face_labels.npy", "{}.vertex_labels.npy", "{}.json", "{}.npy")
_SHARED: Final = ("labels.json", "labels.npy", "face_labels.npy", "vertex_labels.npy")


@dataclass(frozen=True)
class _Piece:
    """One mesh of a scene. labels: what gives them: a file, "groups" and the like, or None for what is found first.

    label: one class for all of it. metres: in the unit of its file. pose: float64 [4, 4], into the scene, metres.
    """

    mesh: Path
    labels: Path | str | None
    label: str | None
    metres: float
    pose: NDArray[np.float64]


@dataclass(frozen=True)
class _SceneFiles:
    """The files of a scene. path: names it in messages. centre: float64 [3], metres, axes of the files."""

    path: Path
    pieces: tuple[_Piece, ...]
    centre: NDArray[np.float64] | None = None


def _is_scene(file: Path) -> bool:
    return f".{file.name}".endswith(f".{SCENE_NAME}")


class LabelledScenes(ListedBodies[_SceneFiles]):
    """Scenes found below a folder, sorted by their paths. Raises BadConfig if there are none."""

    name, reads = "labelled", "meshes with labels of their own, or scene files"

    def __init__(self, path: Path, landmarks: Path | None = None, options: MeshOptions = DEFAULTS) -> None:
        if landmarks is not None:
            raise BadConfig("the source 'labelled' has labels of its own and needs no --landmarks: leave it out")
        self._folder, self._table = path, ClassTable(path)
        self._metres = 1.0 if options.units == "auto" else METRES[options.units]
        self._rotation = upright_rotation("y" if options.up == "auto" else options.up)
        files = files_below(path)
        scenes = [*filter(_is_scene, files)]
        found = [self._scene(file) for file in scenes] if scenes else self._meshes(files)
        if not found:
            raise BadConfig(f"the source 'labelled' needs meshes or {SCENE_NAME}: found none in {path}")
        if len(dict(found)) < len(found):
            raise BadConfig(f"{path}: two scenes have one name: NAME.scene.json and NAME/scene.json")
        super().__init__(dict(found))

    @cached_property
    def classes(self) -> Classes:
        """Classes of the set: those of classes.json, or all names in the order in which the scenes have them."""
        if self._table.classes is not None:
            return self._table.classes
        names: dict[str, None] = {}
        files: set[Path] = set()
        for piece in (piece for scene in self._entries.values() for piece in scene.pieces):
            if piece.labels not in files:  # a label file that meshes share names the same classes each time
                with contextlib.suppress(BadMesh):  # which the check of the meshes reports
                    names |= dict.fromkeys(self._named(piece, mesh_content(piece.mesh)).names)
                    files |= {piece.labels} if isinstance(piece.labels, Path) else set()
        with reported(str(self._folder), BadConfig):
            return classes_of(list(names), self._folder.name or "labelled")

    def fingerprint(self, bodies: Sequence[BodyRef]) -> str:
        """Return a digest of every byte of the files. Raises BadMesh for one that cannot be read."""
        digest = hashlib.sha256(repr((self._metres, self._rotation.tolist())).encode())
        files = {self._table.path} if self._table.classes is not None else set()
        for scene in map(self.entry, bodies):
            files.add(scene.path)
            for piece in scene.pieces:
                files |= {piece.mesh, *gltf_buffers(piece.mesh).values()}
                files |= {piece.labels} if isinstance(piece.labels, Path) else set()
        for file in sorted(files):
            digest.update(file.name.encode())
            with reported(f"cannot read {file}", BadMesh, OSError):
                digest.update(hashlib.sha256(file.read_bytes()).digest())
        return digest.hexdigest()

    def check(self, body: BodyRef) -> None:
        """Read the files of one scene, with the errors of `build`."""
        self._built(body, self._table.classes)

    def build(self, body: BodyRef) -> Body:
        """Build one scene, which has no landmarks. Raises BadMesh for a damaged file, or labels that do not fit."""
        return self._built(body, self.classes)

    def surface(self, body: BodyRef) -> Mesh:
        """One scene without classes, whether it has labels or not, with the errors of `build` but for those."""
        return self._built(body, None, labelled=False).mesh

    def _built(self, body: BodyRef, classes: Classes | None, labelled: bool = True) -> Body:
        """One mesh of all pieces of a scene. classes: of the set, None for a check. labelled: look for labels."""
        scene, notes, points, faces, labels, count = self.entry(body), [], [], [], [], 0
        for piece in scene.pieces:
            content = mesh_content(piece.mesh)
            named = self._named(piece, content) if labelled else NamedCorners((), np.full(content.faces.shape, -1))
            labels.append(self._coded(named, classes, str(piece.mesh)))
            notes += [f"{piece.mesh.name}: {note}" for note in named.notes]
            used, corners = np.unique(content.faces, return_inverse=True)  # others may lie anywhere
            vertices = content.vertices[used] * piece.metres @ piece.pose[:3, :3].T + piece.pose[:3, 3]
            kept, place = welded(vertices)
            points.append(vertices[kept])
            faces.append(place[corners].reshape(-1, 3) + count)
            count += len(kept)
        turn = Alignment(1.0, self._rotation, 0.0).apply
        middle = None if scene.centre is None else turn(scene.centre[None])[0]
        surface = turn(np.concatenate(points)), np.concatenate(faces).astype(np.int32)
        try:
            mesh = SceneMesh(body.mesh, *surface, np.concatenate(labels), middle)
        except BadMesh as error:
            raise BadMesh(f"{error} (read from {scene.path})") from error
        return Body(mesh, np.zeros(0, np.int64), tuple(notes))

    def _named(self, piece: _Piece, content: MeshContent) -> NamedCorners:
        """Names at the corners of a piece's triangles."""
        if piece.label is not None:
            return NamedCorners((piece.label,), np.zeros(content.faces.shape, np.int64))
        if isinstance(piece.labels, Path):
            return labels_from_file(piece.labels, content, self._table.numbers)
        return file_labels(content, piece.labels, self._table, str(piece.mesh))

    def _coded(self, named: NamedCorners, classes: Classes | None, where: str) -> NDArray[np.uint8]:
        """Labels at the corners, uint8 [F, 3]; all 255 as long as the classes are not known."""
        code = np.full(len(named.names) + 1, BACKGROUND, np.uint8)  # the last entry is that of corner -1, no label
        for at in np.unique(named.corners).tolist():
            found = None if at < 0 else self._table.class_of(named.names[at], where)
            if found is not None and classes is not None:
                code[at] = classes.names.index(found)
        return code[named.corners]

    def _meshes(self, files: Sequence[Path]) -> list[tuple[BodyRef, _SceneFiles]]:
        """Scenes of one mesh file each. Raises BadConfig for two of one name."""
        forms: dict[Path, list[Path]] = {}
        for file in files:
            if (stem := scene_stem(file.name)) is not None:
                forms.setdefault(file.with_name(stem), []).append(file)
        found = []
        for path, (mesh, *others) in sorted(forms.items()):
            if others:
                names = " and ".join(file.name for file in (mesh, *others))
                raise BadConfig(f"{path.parent}: a scene is one mesh file, found {names}: move one away")
            piece = _Piece(mesh, self._labels_of(mesh), None, self._metres, np.eye(4))
            found.append((body_ref(self.name, path.relative_to(self._folder)), _SceneFiles(mesh, (piece,))))
        return found

    def _labels_of(self, mesh: Path) -> Path | str | None:
        """The label file beside a mesh, else what classes.json says, else one in its folder or the next one above."""
        beside = (mesh.with_name(form.format(scene_stem(mesh.name))) for form in _BESIDE)
        own = next((at for at in beside if at.is_file() and at != self._table.path and not _is_scene(at)), None)
        folders = [each for each in (mesh.parent, *mesh.parent.parents) if each.is_relative_to(self._folder)]
        shared = (folder / name for folder in folders for name in _SHARED if (folder / name).is_file())
        return own or self._table.labels or next(shared, None)

    def _scene(self, path: Path) -> tuple[BodyRef, _SceneFiles]:
        """Read a scene file. Raises BadConfig, naming it."""
        tree = read_json(path)
        if tree.pop("format", None) != SCENE_FORMAT:
            raise BadConfig(f"{path}: 'format' must be {SCENE_FORMAT!r}")
        rows = tree.pop("meshes", None)
        if not isinstance(rows, list) or not rows or not all(isinstance(row, dict) for row in rows):
            raise BadConfig(f"{path}: 'meshes' must be a list of objects, each with a 'mesh'")
        table = Table(tree, str(path))
        centre = np.array(table.numbers("centre_m", 3)) if "centre_m" in table else None
        # test/scene.json has the name "test", in which `body_ref` sees no split: it takes one from a folder above.
        own = {"split": "test"} if path.relative_to(self._folder).parts[0].lower() == "test" else {}
        own |= {name: table.text(name) for name in ("subject", "pose", "split") if name in table}
        table.finish()
        check_choice(f"{path}: 'split'", own.get("split", "train"), SPLITS)
        pieces = tuple(self._piece(Table(row, f"{path}, mesh {at}"), path) for at, row in enumerate(rows))
        name = path.parent if path.name == SCENE_NAME else path.with_name(path.name.removesuffix(f".{SCENE_NAME}"))
        inside = name.relative_to(self._folder)
        return body_ref(self.name, inside if inside.parts else Path("scene"), own), _SceneFiles(path, pieces, centre)

    def _piece(self, row: Table, path: Path) -> _Piece:
        for either, other in (("class", "labels"), ("pose", "position_m")):
            if either in row and other in row:
                raise BadConfig(f"{row.where}: a mesh has one {either!r} or {other!r}, found both")
        mesh = Path(normpath(path.parent / row.text("mesh")))
        label = row.text("class") if "class" in row else None
        labels: Path | str | None = row.text("labels") if "labels" in row else None
        if isinstance(labels, str) and labels.lower().endswith((".json", ".npy")):
            labels = path.parent / labels
        elif labels is None and label is None:
            labels = self._labels_of(mesh)
        metres, pose = self._metres, np.eye(4)
        if "units" in row:
            metres = METRES[check_choice(f"{row.where}: 'units'", row.text("units"), METRES)]
        if "position_m" in row:
            pose[:3, 3] = row.numbers("position_m", 3)
        if "pose" in row:
            pose = np.array(row.numbers("pose", 16)).reshape(4, 4)
            if pose[3].tolist() != [0, 0, 0, 1]:
                raise BadConfig(f"{row.where}: the last row of 'pose' must be 0 0 0 1, found {pose[3].tolist()}")
            if np.linalg.det(pose[:3, :3]) <= 0:
                raise BadConfig(f"{row.where}: 'pose' must not mirror or flatten the mesh")
        row.finish()
        return _Piece(mesh, labels, label, metres, pose)
