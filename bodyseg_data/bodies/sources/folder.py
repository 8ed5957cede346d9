"""Any folder of meshes, with a landmark file for each or for all of one topology; the subset "folder".

docs/how-to/sources.md says where landmarks lie, and how subjects and splits are found.
"""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Final

from bodyseg_data.bodies.mesh_bodies import MeshBodies, MeshFile, files_below, given_landmarks, landmark_file, meshes_in
from bodyseg_data.bodies.source import DEFAULTS, BodyRef, MeshOptions, key_name
from bodyseg_data.core import BadConfig
from bodyseg_data.samples import Split

_LONGEST_SUBJECT: Final = 20  # with the mesh's name and the view in a sample key of at most 80
_LONGEST_MESH: Final = 40


class FolderBodies(MeshBodies):
    """Meshes found below a folder, sorted by their paths. Raises BadConfig if there are none.

    landmarks: a file for all meshes that have none of their own, or a folder to search for landmark files, with
    sub-folders like those of `path`.
    """

    name, reads = "folder", "meshes and landmark files"

    def __init__(self, path: Path, landmarks: Path | None = None, options: MeshOptions = DEFAULTS) -> None:
        given, folder = given_landmarks(path, landmarks)
        files: dict[BodyRef, MeshFile] = {}
        for parent in sorted({file.parent for file in files_below(path)}):
            inside = parent.relative_to(path)
            folders = [folder / level for level in (inside, *inside.parents)]
            for stem, file in meshes_in(parent).items():
                own = landmark_file(folders[:1], stem)
                labels = own or given or landmark_file(folders, "landmarks")
                wanted = f"mesh {file}: no {stem}.json, {stem}.lnd or landmarks.json in {folders[0]} or above"
                group = None if own else str(labels)
                files[body_ref(self.name, inside / stem)] = MeshFile(
                    file, labels, wanted, shared=own is None, group=group
                )
        if not files:
            raise BadConfig(f"the source 'folder' needs meshes (.ply, .obj, .off): found none in {path}")
        lacking = [f"landmarks of {body.mesh}" for body, file in files.items() if file.landmarks is None]
        super().__init__(files, lacking, options)


def body_ref(source: str, inside: Path, said: Mapping[str, str] = MappingProxyType({})) -> BodyRef:
    """Name the mesh at a path, given without its suffix, inside the folder of a source.

    said: "subject", "pose" and "split" where the user gives them.
    """
    first = inside.parts[0].lower() if len(inside.parts) > 1 else ""
    split: Split = "test" if said.get("split", first) == "test" else "train"
    person = inside.parts[1:] if first in ("train", "test") else inside.parts
    mesh = key_name(inside.as_posix(), _LONGEST_MESH - max(0, len(source) - len("folder")))
    subject = key_name(said.get("subject", person[0]), _LONGEST_SUBJECT)
    return BodyRef(source, subject, mesh, key_name(said.get("pose", inside.name), _LONGEST_MESH), split)
