"""Mesh files of scenes: those that bodies come from, by the readers of `meshes`, and glTF and STL, by trimesh.

The parts of a glTF file are placed by their nodes, joined, and named by nodes and materials.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadMesh
from bodyseg_data.files import contents
from bodyseg_data.machine import missing_library
from bodyseg_data.meshes import FaceNames, MeshContent, mesh_suffix, read_mesh_content

SCENE_SUFFIXES: Final = (".glb", ".gltf", ".stl")
"""Suffixes of mesh files that trimesh reads."""

_LARGEST_BYTES: Final = 1 << 28


def content_suffix(name: str) -> str | None:
    """The suffix of a file's name, with its own capitals, if it is that of a mesh; else None."""
    known = mesh_suffix(name) or next((each for each in SCENE_SUFFIXES if name.lower().endswith(each)), None)
    return name[-len(known) :] if known else None


def mesh_content(path: Path) -> MeshContent:
    """Read a mesh file with all in which labels may stand.

    Raises BadMesh, naming the file, for one that cannot be read; MissingLibrary without trimesh where it is needed.
    """
    if not path.name.lower().endswith(SCENE_SUFFIXES):
        return read_mesh_content(path)
    try:
        import trimesh
    except ImportError as error:
        raise missing_library(f"reading {path.suffix} files", error) from error
    try:
        if contents(path, False, _LARGEST_BYTES) is None:
            raise BadMesh(f"{path}: a mesh file may hold {_LARGEST_BYTES >> 20} MiB, found more")
    except OSError as error:
        raise BadMesh(f"cannot read {path}: {error.strerror or error}") from error
    try:
        scene = trimesh.load(path, force="scene", process=False)
        parts = [(node, *scene.graph[node]) for node in scene.graph.nodes_geometry]
        placed = [(node, pose, scene.geometry[name]) for node, pose, name in parts]
        placed = [each for each in placed if len(getattr(each[2], "faces", ()))]
        return _joined(placed, path)
    except BadMesh:
        raise
    except Exception as error:  # whatever a damaged file makes trimesh raise
        words = " ".join(f"{type(error).__name__}: {error}".split())
        raise BadMesh(f"{path} cannot be read by trimesh: {words[:200]}") from error


def _joined(parts: list[tuple[str, NDArray[np.float64], Any]], path: Path) -> MeshContent:
    """One mesh of the parts of a scene: node, pose [4, 4] and mesh of each."""
    if not parts:
        raise BadMesh(f"{path}: a mesh needs vertices and faces, found none")
    starts = np.cumsum([0, *(len(mesh.vertices) for _, _, mesh in parts)])
    vertices = np.concatenate([mesh.vertices @ pose[:3, :3].T + pose[:3, 3] for _, pose, mesh in parts])
    faces = np.concatenate([mesh.faces + start for (_, _, mesh), start in zip(parts, starts[:-1], strict=True)])
    if not np.isfinite(vertices).all() or faces.min() < 0 or faces.max() >= len(vertices):
        raise BadMesh(f"{path}: coordinates must be finite, and faces must use vertices of the mesh")
    sizes = [len(mesh.faces) for _, _, mesh in parts]
    columns = [_columns(mesh) for _, _, mesh in parts]
    common = [name for name in columns[0] if all(name in each for each in columns)]
    materials = [getattr(getattr(mesh.visual, "material", None), "name", None) or "" for _, _, mesh in parts]
    return MeshContent(
        np.asarray(vertices, np.float64),
        faces.astype(np.int32),
        np.arange(len(faces)),
        {name: np.concatenate([each[name] for each in columns]) for name in common},
        names={
            kind: _named(names, sizes)
            for kind, names in (("nodes", [node for node, _, _ in parts]), ("materials", materials))
            if path.suffix.lower() != ".stl" and any(names)
        },
    )


def _columns(mesh: Any) -> dict[str, NDArray[Any]]:
    """Numbers of a part's vertices, by name: colours, and attributes, whose names begin with an underscore in files."""
    found = {name.lower().lstrip("_"): np.asarray(each) for name, each in mesh.vertex_attributes.items()}
    found = {name: each.ravel() for name, each in found.items() if each.size == len(mesh.vertices)}
    if mesh.visual.kind == "vertex":
        found |= dict(zip(("red", "green", "blue"), mesh.visual.vertex_colors.T, strict=False))
    return found


def _named(names: list[str], sizes: list[int]) -> FaceNames:
    distinct = tuple(dict.fromkeys(name for name in names if name))
    numbers = [distinct.index(name) if name else -1 for name in names]
    return FaceNames(distinct, np.repeat(np.array(numbers, np.int64), sizes))
