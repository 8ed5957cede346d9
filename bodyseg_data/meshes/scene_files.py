"""Mesh files of scenes: those that bodies come from, by the readers of `mesh_files`, and glTF and STL, by trimesh.

The parts of a glTF file are placed by their nodes, joined, and named by nodes and materials.
"""

import json
import re
from base64 import b64decode
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path
from typing import Any, Final, NamedTuple
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

_DRACO: Final = "KHR_draco_mesh_compression"
_JOINTS, _WEIGHTS = "_JOINTS_", "_WEIGHTS_"  # of vertices, as trimesh keeps names that begin so
_UNREAD: Final = {_DRACO, "EXT_meshopt_compression", "EXT_mesh_gpu_instancing"}  # by trimesh


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
    data = file_bytes(path, "mesh", LARGEST_BYTES, BadMesh)  # trimesh takes files of any size
    beside = {uri: file_bytes(file, "mesh", LARGEST_BYTES, BadMesh) for uri, file in gltf_buffers(path).items()}
    with BadMesh.named(f"{path} cannot be read by trimesh", passes=BadMesh):  # whatever a damaged file makes it raise
        kind = "stl" if path.suffix.lower() == ".stl" else "gltf"
        data, names, skins = (_whole_stl(data, path), {}, {}) if kind == "stl" else _for_trimesh(data, beside, path)
        scene = trimesh.load(BytesIO(data), kind, beside, force="scene", process=False)
        parts = []
        # trimesh divides a mesh of several primitives into nodes "NUMBER_" and letters, and gives the last node first.
        numbered = [(node.split("_")[0], node) for node in scene.graph.nodes_geometry]
        for number, node in sorted(numbered, key=lambda each: int(each[0]) if each[0] in names else 0):
            pose, geometry = scene.graph[node]
            mesh = scene.geometry[geometry]
            if len(getattr(mesh, "faces", ())):
                skin = skins.get(number)
                placed = mesh.vertices @ pose[:3, :3].T + pose[:3, 3] if skin is None else skin.posed(mesh, scene.graph)
                parts.append((names.get(number, ""), placed, mesh))
        return _joined(parts, path, len({number for number, _ in numbered} & names.keys()))


def _whole_stl(data: bytes, path: Path) -> bytes:
    """An STL file. Raises BadMesh for one that is cut, of which trimesh reads those solids that are whole."""
    if len(data) == 84 + 50 * int.from_bytes(data[80:84], "little"):
        return data
    _, ended, rest = data.lower().rpartition(b"endsolid")  # with which the text of every solid ends
    if not ended or re.search(rb"[\r\n]\s*(solid|facet)", rest):
        raise BadMesh(f"{path}: the file is cut: neither as long as its header announces, nor text up to 'endsolid'")
    return data


class _Skin(NamedTuple):
    """Joints, as numbers of nodes, and the inverse bind matrix of each, [J, 4, 4]."""

    joints: list[str]
    inverse: NDArray[np.float32]

    def posed(self, mesh: Any, graph: Any) -> NDArray[np.float64]:
        """A mesh's vertices where the joints place them, wherever its node is, [V, 3] (glTF 2.0, 3.7.3)."""
        bones, given = np.stack([graph[joint][0] for joint in self.joints]) @ self.inverse, mesh.vertex_attributes
        sets = range(sum(name.startswith(_JOINTS) for name in given))
        joints, weights = (np.hstack([given[f"{name}{at}"] for at in sets]) for name in (_JOINTS, _WEIGHTS))
        weights[~weights.any(axis=1), 0] = 1  # as other readers take a vertex that follows no joint
        weights = weights / weights.sum(axis=1, keepdims=True)  # which may be whole numbers
        placed = np.zeros(mesh.vertices.shape)
        for joint, weight in zip(joints.T, weights.T, strict=True):
            bone = bones[joint]
            turned = np.einsum("vij,vj->vi", bone[:, :3, :3], mesh.vertices)
            placed += weight[:, None] * (turned + bone[:, :3, 3])
        return placed


def _for_trimesh(data: bytes, beside: dict[str, bytes], path: Path) -> tuple[bytes, dict[str, str], dict[str, _Skin]]:
    """The text of a glTF file with the names and cameras of its nodes removed, and number -> name of each: trimesh
    renames nodes of one name, and leaves out a node with a camera and all below it. Third, number -> skin, whose
    weights get names that trimesh keeps. beside: buffers by URI; gets that of a binary file. Raises BadMesh for
    geometry that trimesh would leave out or misplace.
    """
    begin, end = (20, 20 + int.from_bytes(data[12:16], "little")) if data[:4] == b"glTF" else (0, len(data))
    if begin and len(data) < (announced := int.from_bytes(data[8:12], "little")):
        raise BadMesh(f"{path}: the header announces {announced} bytes, the file ends after {len(data)}")
    tree = parse_json(data[begin:end], "its text")
    if begin and tree.get("buffers") and tree["buffers"][0].setdefault("uri", "bin") == "bin":
        beside["bin"] = data[end + 8 :]
    primitives = [each for mesh in tree.get("meshes", ()) for each in mesh["primitives"]]
    places = [tree["accessors"][each["attributes"]["POSITION"]] for each in primitives if each.get("mode", 4) > 3]
    nodes = tree.get("nodes", ())
    needed = {*tree.get("extensionsRequired", ()), *(key for node in nodes for key in node.get("extensions", ()))}
    unread = (_UNREAD & needed) - ({_DRACO} if find_spec("DracoPy") else set())
    unread |= {f"{key} positions" for each in places for key in ("sparse", "normalized") if each.get(key)}
    unread |= {"weights of shape keys" for each in (*tree.get("meshes", ()), *nodes) if any(each.get("weights", ()))}
    unread |= {"triangle fans" for each in primitives if each.get("mode") == 6}
    if unread:
        raise BadMesh(f"{path}: geometry must be plain, found {', '.join(sorted(unread))}: export it without")
    names = {str(at): node.pop("name", "") or str(at) for at, node in enumerate(nodes)}
    for each in primitives:
        for attributes in (each["attributes"], each.get("extensions", {}).get(_DRACO, {}).get("attributes", {})):
            for name in [name for name in attributes if f"_{name}".startswith((_JOINTS, _WEIGHTS))]:
                attributes[f"_{name}"] = attributes.pop(name)
    skins = {}
    for at, node in enumerate(nodes):
        node.pop("camera", None)
        if "skin" in node:
            skins[str(at)] = _skin(tree, tree["skins"][node["skin"]], beside)
    return json.dumps(tree).encode(), names, skins


def _skin(tree: dict[str, Any], skin: dict[str, Any], beside: dict[str, bytes]) -> _Skin:
    joints = [str(joint) for joint in skin["joints"]]
    if "inverseBindMatrices" not in skin:
        return _Skin(joints, np.eye(4, dtype=np.float32)[None])
    accessor = tree["accessors"][skin["inverseBindMatrices"]]
    view = tree["bufferViews"][accessor["bufferView"]]
    uri = tree["buffers"][view["buffer"]]["uri"]
    data = beside[uri] if uri in beside else b64decode(uri.partition(",")[2])
    start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    by_column = np.frombuffer(data, "<f4", 16 * len(joints), start).reshape(-1, 4, 4)
    return _Skin(joints, by_column.transpose(0, 2, 1))


def _joined(parts: list[tuple[str, NDArray[np.float64], Any]], path: Path, nodes: int) -> MeshContent:
    """One mesh of a scene's parts: node, vertices as placed [V, 3] and mesh of each. nodes: as of `MeshContent`."""
    if not parts:
        raise BadMesh(f"{path}: a mesh needs vertices and faces, found none")
    starts = np.cumsum([0, *(len(placed) for _, placed, _ in parts)])
    vertices = np.concatenate([placed for _, placed, _ in parts])
    faces = np.concatenate([mesh.faces + start for (_, _, mesh), start in zip(parts, starts[:-1], strict=True)])
    check_arrays(str(path), vertices, faces)
    sizes = [len(mesh.faces) for _, _, mesh in parts]
    colours = [_colours(mesh.visual) for _, _, mesh in parts]
    channels: Any = np.concatenate(colours).T if all(map(len, colours)) else ()
    numbers = dict(zip(("red", "green", "blue"), channels, strict=False))
    materials = [getattr(getattr(mesh.visual, "material", None), "name", None) or "" for _, _, mesh in parts]
    named = {"nodes": [node for node, _, _ in parts], "materials": materials}
    names = {kind: face_names(each, sizes) for kind, each in named.items() if any(each)}
    return MeshContent(vertices, faces.astype(np.int32), np.arange(len(faces)), numbers, names=names, nodes=nodes)


def _colours(visual: Any) -> Any:
    """Colours of a part's vertices, uint8 [V, 3], () without. Beside a material, trimesh keeps the file's numbers."""
    given = visual.vertex_colors if visual.kind == "vertex" else getattr(visual, "vertex_attributes", {}).get("color")
    return () if given is None else required("trimesh", "colours").visual.color.to_rgba(given)[:, :3]
