"""Mesh files of scenes: those that bodies come from, by the readers of `mesh_files`, and glTF and STL, by trimesh.

The parts of a glTF file are placed by their nodes, joined, and named by nodes and materials.
"""

import re
from io import BytesIO
from pathlib import Path
from typing import Any, Final
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig, BadMesh, reported
from bodyseg_data.files import parse_json
from bodyseg_data.machine import required
from bodyseg_data.meshes.mesh import check_arrays
from bodyseg_data.meshes.mesh_files import (
    LARGEST_BYTES,
    MeshContent,
    face_names,
    file_bytes,
    mesh_stem,
    read_mesh_content,
)

SCENE_SUFFIXES: Final = (".glb", ".gltf", ".stl")  # of mesh files that trimesh reads


def scene_stem(name: str) -> str | None:
    """The name of a file that `mesh_content` reads, without its suffix; None for other files."""
    return Path(name).stem if Path(name).suffix.lower() in SCENE_SUFFIXES else mesh_stem(name)


def gltf_buffers(path: Path) -> dict[str, Path]:
    """URI -> file of the buffers beside a .gltf file; none of other files. Raises BadMesh."""
    if path.suffix.lower() != ".gltf":
        return {}
    data = file_bytes(path, "mesh", LARGEST_BYTES, BadMesh)
    with reported(f"{path} is no glTF 2", BadMesh, BadConfig, TypeError, LookupError, AttributeError):
        uris: list[str] = [each["uri"] for each in parse_json(data, "its text").get("buffers", ())]
        return {uri: path.parent / unquote(uri) for uri in uris if not uri.startswith("data:")}


def mesh_content(path: Path) -> MeshContent:
    """Read a mesh file with all in which labels may stand.

    Raises BadMesh, naming the file, for one that cannot be read; MissingLibrary without trimesh where it is needed.
    """
    if not path.name.lower().endswith(SCENE_SUFFIXES):
        return read_mesh_content(path)
    trimesh = required("trimesh", f"reading {path.suffix} files")
    data = BytesIO(file_bytes(path, "mesh", LARGEST_BYTES, BadMesh))  # trimesh takes files of any size
    beside = {uri: file_bytes(file, "mesh", LARGEST_BYTES, BadMesh) for uri, file in gltf_buffers(path).items()}
    try:
        scene = trimesh.load(data, path.suffix[1:].lower(), beside, force="scene", process=False)
        posed = [(node, *scene.graph[node]) for node in scene.graph.nodes_geometry]
        parts = [(_file_name(node, scene), pose, scene.geometry[name]) for node, pose, name in posed]
        return _joined([each for each in parts if len(getattr(each[2], "faces", ()))], path)
    except BadMesh:
        raise
    except Exception as error:  # whatever a damaged file makes trimesh raise
        words = " ".join(f"{type(error).__name__}: {error}".split())
        raise BadMesh(f"{path} cannot be read by trimesh: {words[:200]}") from error


def _file_name(node: str, scene: Any) -> str:
    """A node's name in its file: for each of several primitives, trimesh makes one below it, named anew each time."""
    parent: str = scene.graph.transforms.parents.get(node, "")
    return parent if re.fullmatch(f"{re.escape(parent)}_[0-9a-f]{{6}}", node) else node


def _joined(parts: list[tuple[str, NDArray[np.float64], Any]], path: Path) -> MeshContent:
    """One mesh of the parts of a scene: node, pose [4, 4] and mesh of each."""
    if not parts:
        raise BadMesh(f"{path}: a mesh needs vertices and faces, found none")
    starts = np.cumsum([0, *(len(mesh.vertices) for _, _, mesh in parts)])
    vertices = np.concatenate([mesh.vertices @ pose[:3, :3].T + pose[:3, 3] for _, pose, mesh in parts])
    faces = np.concatenate([mesh.faces + start for (_, _, mesh), start in zip(parts, starts[:-1], strict=True)])
    check_arrays(str(path), vertices, faces)
    sizes = [len(mesh.faces) for _, _, mesh in parts]
    colours = [mesh.visual.vertex_colors[:, :3] for _, _, mesh in parts if mesh.visual.kind == "vertex"]
    channels: Any = np.concatenate(colours).T if len(colours) == len(parts) else ()
    materials = [getattr(getattr(mesh.visual, "material", None), "name", None) or "" for _, _, mesh in parts]
    return MeshContent(
        np.asarray(vertices, np.float64),
        faces.astype(np.int32),
        np.arange(len(faces)),
        dict(zip(("red", "green", "blue"), channels, strict=False)),
        names={
            kind: face_names(names, sizes)
            for kind, names in (("nodes", [node for node, _, _ in parts]), ("materials", materials))
            if path.suffix.lower() != ".stl" and any(names)
        },
    )
