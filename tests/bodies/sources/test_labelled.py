"""Meshes with labels of their own: where labels stand, what does not fit, and what every pixel of a sample says."""

from __future__ import annotations

import base64
import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from people_on_disk import obj
from small_rig import SMALL_FILE

from bodyseg_data import RangeImages
from bodyseg_data.bodies import Body, open_source
from bodyseg_data.bodies.given_labels import labels_of_colours, labels_of_numbers, labels_of_parts
from bodyseg_data.commands.cli import main
from bodyseg_data.core import BadConfig, BadMesh
from bodyseg_data.files import access
from bodyseg_data.labels import classes_of
from bodyseg_data.meshes import MeshContent, cuboid, mesh_content
from bodyseg_data.shards import read_manifest

BOX = cuboid((0.6, 1.0, 0.4), (0.0, 0.5, 0.0))
"""A box of 8 vertices and 12 triangles; vertices 0 to 3 lie at its back."""

FRONT = [int(at) for at in np.flatnonzero(BOX.vertices[:, 2] > 0)]
BACK = [int(at) for at in np.flatnonzero(BOX.vertices[:, 2] < 0)]
UPPER = BOX.vertices[:, 1] > 0.5


def write(path: Path, content: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif isinstance(content, np.ndarray):
        np.save(path, content)
    else:
        path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def scene(folder: Path, at: int = 0) -> tuple[Body, NDArray[np.uint8], tuple[str, ...]]:
    """A member, its labels at the corners of triangles, and the names of classes."""
    source: Any = open_source("labelled", folder)
    ref = source.bodies()[at]
    source.check(ref)
    built = source.build(ref)
    return built, built.surface_labels().corners(built.mesh), source.classes.names


def reason(folder: Path) -> str:
    """The one line that says why a folder's first member cannot be read."""
    with pytest.raises((BadMesh, BadConfig)) as caught:
        scene(folder)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def ply(vertex: dict[str, NDArray[Any]] | None = None, face: dict[str, NDArray[Any]] | None = None) -> str:
    """The box as text, with further properties of vertices or faces."""
    vertex, face = vertex or {}, face or {}
    lines = ["ply", "format ascii 1.0", "element vertex 8", *(f"property float {axis}" for axis in "xyz")]
    lines += [f"property uchar {name}" for name in vertex]
    lines += ["element face 12", "property list uchar int vertex_indices", *(f"property uchar {n}" for n in face)]
    lines.append("end_header")
    for at, point in enumerate(BOX.vertices.tolist()):
        lines.append(" ".join(map(str, [*point, *(values[at] for values in vertex.values())])))
    for at, corners in enumerate(BOX.faces.tolist()):
        lines.append(" ".join(map(str, [3, *corners, *(values[at] for values in face.values())])))
    return "\n".join([*lines, ""])


def named_faces(word: str) -> bytes:
    """The box as OBJ: its twelve faces in four groups, objects or materials of three."""
    lines = obj(*map(np.asarray, (BOX.vertices, BOX.faces))).decode().splitlines()
    faces = [line for line in lines if line.startswith("f")]
    parts = [[f"{word} part {at}", *faces[3 * at : 3 * at + 3]] for at in range(4)]
    return "\n".join([*lines[:8], *(line for part in parts for line in part), ""]).encode()


BOX_OBJ = obj(BOX.vertices, BOX.faces)
QUARTERS = np.repeat(np.arange(4, dtype=np.uint8), 3)


def test_parts_by_lists_of_vertices(tmp_path: Path) -> None:
    """As SMPL's are published: the vertices of a border are in both parts."""
    write(tmp_path / "a.obj", BOX_OBJ)
    write(tmp_path / "labels.json", {"front": FRONT, "back": BACK + FRONT[:1], "none of it": []})
    built, corners, names = scene(tmp_path)
    assert names == ("front", "back", "none of it")
    assert np.array_equal(corners, np.where(BOX.vertices[BOX.faces][:, :, 2] > 0, 0, 1))
    assert built.notes == ("a.obj: 1 vertices are in two parts: their triangles go by all three corners",)


@pytest.mark.parametrize("of", ["vertices", "faces"])
def test_numbers_by_the_array_of_numpy(tmp_path: Path, of: str) -> None:
    write(tmp_path / "a.obj", BOX_OBJ)
    write(tmp_path / "classes.json", {"classes": ["low", "high", "c", "d"]})
    write(tmp_path / "a.labels.npy", UPPER.astype(np.int32) if of == "vertices" else QUARTERS)
    expected = UPPER[BOX.faces] if of == "vertices" else np.repeat(QUARTERS[:, None], 3, axis=1)
    assert np.array_equal(scene(tmp_path)[1], expected)


@pytest.mark.parametrize("of", ["vertex", "face"])
@pytest.mark.parametrize("name", ["label", "scalar_Label"])
def test_numbers_in_a_property(tmp_path: Path, of: str, name: str) -> None:
    values = {name: UPPER.astype(np.uint8) if of == "vertex" else QUARTERS}
    write(tmp_path / "a.ply", ply(**{of: values}))
    write(tmp_path / "classes.json", {"classes": ["low", {"name": "high", "colour": "#ff0000"}, "c", "d"]})
    expected = UPPER[BOX.faces] if of == "vertex" else np.repeat(QUARTERS[:, None], 3, axis=1)
    assert np.array_equal(scene(tmp_path)[1], expected)


@pytest.mark.parametrize("of", ["vertex", "face"])
def test_colours_with_a_table(tmp_path: Path, of: str) -> None:
    red = 255 * (UPPER if of == "vertex" else QUARTERS > 1).astype(np.uint8)
    write(tmp_path / "a.ply", ply(**{of: {"red": red, "green": 0 * red, "blue": 255 - red}}))
    table = [{"name": "low", "colour": "#0000ff"}, {"name": "high", "colour": "#ff0000"}]
    write(tmp_path / "classes.json", {"classes": table})
    expected = UPPER[BOX.faces] if of == "vertex" else np.repeat(QUARTERS[:, None] > 1, 3, axis=1)
    assert np.array_equal(scene(tmp_path)[1], expected)
    for told in (table[:1], [*table, {"name": "as red", "colour": "#ff0000"}]):  # a colour of two tells neither
        write(tmp_path / "classes.json", {"classes": told})
        assert "the colour #ff0000, of number" in reason(tmp_path)


@pytest.mark.parametrize("word", ["g", "o", "usemtl"])
def test_names_in_obj(tmp_path: Path, word: str) -> None:
    write(tmp_path / "a.obj", named_faces(word))
    _, corners, names = scene(tmp_path)
    assert names == ("part 0", "part 1", "part 2", "part 3")
    assert np.array_equal(corners, np.repeat(QUARTERS[:, None], 3, axis=1))
    classes = [{"name": "first", "also": ["part 0", "part 1"]}, "part 3"]
    write(tmp_path / "classes.json", {"classes": classes, "unlabelled": ["*2"]})
    assert scene(tmp_path)[1][:, 0].tolist() == [0] * 6 + [255] * 3 + [1] * 3
    write(tmp_path / "classes.json", {"classes": classes})
    assert "'part 2' is no class of" in reason(tmp_path)


def test_nodes_and_materials_of_gltf(tmp_path: Path) -> None:
    import trimesh

    whole = trimesh.Scene()
    for name, height in (("base", 0.0), ("arm", 1.0)):
        part = trimesh.Trimesh(BOX.vertices, BOX.faces, process=False)
        steel = trimesh.visual.material.PBRMaterial(name=f"steel {name}")
        part.visual = trimesh.visual.TextureVisuals(material=steel)
        move = trimesh.transformations.translation_matrix([0, height, 0])
        whole.add_geometry(part, node_name=name, geom_name=f"{name} mesh", transform=move)
    write(tmp_path / "a.glb", whole.export(file_type="glb"))
    built, corners, names = scene(tmp_path)
    assert set(names) == {"base", "arm"}
    heights = built.mesh.vertices[built.mesh.faces][:, :, 1].max(axis=1)
    assert ((heights > 1.4) == (corners[:, 0] == names.index("arm")))[heights > 1.1].all()
    for classes in (["steel base", "steel arm"], ["steel base", {"name": "rest", "also": ["steel*"]}]):
        write(tmp_path / "classes.json", {"classes": classes})
        assert np.unique(scene(tmp_path)[1]).tolist() == [0, 1]


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "latin-1"])
def test_names_in_obj_are_text_in_any_encoding(tmp_path: Path, encoding: str) -> None:
    vertices, faces = BOX_OBJ.decode().splitlines()[:8], BOX_OBJ.decode().splitlines()[8:]
    write(tmp_path / "a.obj", "\n".join([*vertices, "g tête à", *faces[:6], "g Fuß", *faces[6:]]).encode(encoding))
    built, _, names = scene(tmp_path)
    assert names == ("tête à", "Fuß")
    assert np.array_equal(built.mesh.vertices[built.mesh.faces], BOX.vertices[BOX.faces])


def test_comments_end_lines_of_obj(tmp_path: Path) -> None:
    lines = [f"{line} # number 1 of many" for line in BOX_OBJ.decode().splitlines()]
    write(tmp_path / "a.obj", "\n".join(["g box", *lines]))
    built, _, names = scene(tmp_path)
    assert names == ("box",) and np.array_equal(built.mesh.vertices[built.mesh.faces], BOX.vertices[BOX.faces])


def test_groups_without_faces_do_not_count_where_labels_are_looked_for(tmp_path: Path) -> None:
    """Maya names vertices "g default"."""
    lines = named_faces("usemtl").decode().splitlines()
    write(tmp_path / "a.obj", "\n".join(["g default", *lines[:8], "g body", *lines[8:]]))
    assert scene(tmp_path)[2] == ("part 0", "part 1", "part 2", "part 3")
    write(tmp_path / "a.obj", "\n".join(["g default", *lines[:8], "g part 0", *lines[8:], "o end"]))
    write(tmp_path / "classes.json", {"classes": ["part 0"]})
    assert (scene(tmp_path)[1] == 0).all()


def test_brackets_in_names_stand_for_themselves(tmp_path: Path) -> None:
    """CAD programs number copies so; a star alone stands for any letters."""
    write(tmp_path / "a.obj", named_faces("g").replace(b"part 0", b"bolt[10]").replace(b"part 1", b"bolt[2]"))
    classes = [{"name": "bolt", "also": ["bolt[*]"]}, "part 3"]
    write(tmp_path / "classes.json", {"classes": classes, "unlabelled": ["part 2"]})
    assert scene(tmp_path)[1][:, 0].tolist() == [0] * 6 + [255] * 3 + [1] * 3


L = np.array([[0, 0], [2, 0], [2, 1], [1, 1], [1, 3], [0, 3]], np.float64)
"""Corners of an area of 4, which is not convex; anticlockwise."""

DOOR = (0, 0), (1, 0), (1, 2), (1, 2), (2, 2), (2, 0), (3, 0), (3, 2), (4, 2), (4, 0), (5, 0), (5, 3), (0, 3)
"""A wall with two doors of one height, an area of 11 that no corner sees all of; one corner stands there twice."""


@pytest.mark.parametrize("first", range(13))
@pytest.mark.parametrize("turned", [False, True])
def test_polygons_that_are_not_convex_are_filled_and_no_more(tmp_path: Path, first: int, turned: bool) -> None:
    """From whichever corner they begin, and from whichever side they are seen."""
    lines: list[str] = []
    for shape, axes in ((L, [0, 1]), (np.array(DOOR), [2, 0])):
        points = np.zeros((len(shape), 3))
        points[:, axes] = np.roll(shape, -first, axis=0)[:: -1 if turned else 1]
        lines += [*(f"v {x} {y} {z}" for x, y, z in points.tolist()), f"g {len(shape)}"]
        lines.append("f " + " ".join(str(at - len(shape)) for at in range(len(shape))))
    write(tmp_path / "a.obj", "\n".join(lines))
    built, corners, _ = scene(tmp_path)
    for label, area in ((0, 4.0), (1, 11.0)):
        across = built.mesh.normals[corners[:, 0] == label]
        assert np.allclose(np.linalg.norm(across, axis=1).sum() / 2, area)
        assert np.allclose(np.linalg.norm(across.sum(axis=0)) / 2, area)


def gltf(nodes: list[dict[str, Any]], **more: Any) -> dict[str, Any]:
    """The box as glTF, for nodes with the mesh 0. Accessors: vertices, and the corners of either half of it."""
    data = BOX.vertices.astype("<f4").tobytes() + BOX.faces.astype("<u4").tobytes()
    accessors = [{"bufferView": 1, "byteOffset": 72 * at, "componentType": 5125} for at in (0, 1)]
    views = [{"buffer": 0, "byteOffset": start, "byteLength": size} for start, size in ((0, 96), (96, 144))]
    below = {child for node in nodes for child in node.get("children", ())}
    return {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [at for at in range(len(nodes)) if at not in below]}],
        "nodes": nodes,
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 8, "type": "VEC3"}]
        + [each | {"count": 18, "type": "SCALAR"} for each in accessors],
        "bufferViews": views,
        "buffers": [{"byteLength": 240, "uri": "data:;base64," + base64.b64encode(data).decode()}],
        **more,
    }


def test_a_node_of_two_materials_is_one_name(tmp_path: Path) -> None:
    """trimesh makes a node for each primitive, whose name is another whenever the file is read."""
    halves = [{"attributes": {"POSITION": 0}, "indices": at, "material": at - 1} for at in (1, 2)]
    nodes = [{"name": "arm", "mesh": 0}, {"name": "base", "mesh": 0, "translation": [0, 2, 0]}]
    tree = gltf(nodes, meshes=[{"primitives": halves}], materials=[{"name": "steel"}, {"name": "rubber"}])
    write(tmp_path / "a.gltf", tree)
    for _ in range(2):
        built, corners, names = scene(tmp_path)
        assert set(names) == {"arm", "base"}
        upper = built.mesh.vertices[built.mesh.faces][:, :, 1].min(axis=1) > 1.5
        assert [np.count_nonzero((corners[:, 0] == names.index("base")) & upper), np.count_nonzero(~upper)] == [12, 12]


def test_files_of_labels_go_with_gltf_of_one_node(tmp_path: Path) -> None:
    """Who wrote them may have joined several in another order: trimesh has the last node first."""
    nodes = [{"mesh": 0}, {"mesh": 0, "translation": [0, 2, 0]}]
    write(tmp_path / "a.labels.json", ["lower"] * 6 + ["upper"] * 6)
    write(tmp_path / "a.gltf", gltf(nodes))
    assert "goes with a mesh of one node, as nothing says in which order several count, found 2:" in reason(tmp_path)
    halves = [{"attributes": {"POSITION": 0}, "indices": at} for at in (1, 2)]
    write(tmp_path / "a.gltf", gltf(nodes[:1], meshes=[{"primitives": halves}]))
    built, corners, _ = scene(tmp_path)
    assert np.allclose(built.mesh.vertices[built.mesh.faces], BOX.vertices[BOX.faces])
    assert corners[:, 0].tolist() == [0] * 6 + [1] * 6


def test_nodes_of_gltf_are_classes_in_their_order(tmp_path: Path) -> None:
    names = ["wall", "arm", *(f"thing {number}" for number in range(12))]
    nodes = [{"name": name, "mesh": 0, "translation": [0, 2 * at, 0]} for at, name in enumerate(names)]
    write(tmp_path / "a.gltf", gltf(nodes))
    built, corners, found = scene(tmp_path)
    assert list(found) == names
    at = built.mesh.vertices[built.mesh.faces][:, :, 1].min(axis=1) // 2
    np.testing.assert_array_equal(corners[:, 0], at)


def binary(tree: dict[str, Any], in_text: bool = False) -> bytes:
    """A glTF file in one piece, whose buffer is a chunk of its own or stays in the text."""
    data = b"" if in_text else base64.b64decode(tree["buffers"][0].pop("uri").partition(",")[2])
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += b"" if in_text else struct.pack("<I4s", len(data), b"BIN\0") + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


@pytest.mark.parametrize("kind", ["gltf", "glb", "glb without a chunk of numbers"])
def test_nodes_of_gltf_keep_their_names_and_places(tmp_path: Path, kind: str) -> None:
    """Several may have one; trimesh has a node "world" of its own, and leaves out a camera's with all below it."""
    nodes = [
        {"name": "arm", "mesh": 0},
        {"name": "arm", "mesh": 0, "translation": [0, 2, 0], "children": [2]},
        {"name": "arm_abc123", "mesh": 0, "translation": [0, 2, 0]},
        {"name": "world", "camera": 0, "mesh": 0, "translation": [0, 6, 0], "children": [4]},
        {"mesh": 0, "translation": [0, 2, 0]},
    ]
    cameras = [{"type": "perspective", "perspective": {"yfov": 1.0, "znear": 0.1}}]
    tree = gltf(nodes, cameras=cameras)
    write(tmp_path / f"a.{kind.split()[0]}", tree if kind == "gltf" else binary(tree, kind != "glb"))
    built, corners, names = scene(tmp_path)
    at = built.mesh.vertices[built.mesh.faces][:, :, 1].min(axis=1) // 2 * 2
    assert {names[label]: sorted({*at[corners[:, 0] == label].tolist()}) for label in range(len(names))} == {
        "arm": [0, 2],
        "arm_abc123": [4],
        "world": [6],
        "4": [8],
    }


@pytest.mark.parametrize("bound", [False, True])
def test_a_skinned_mesh_is_posed_by_its_joints(tmp_path: Path, bound: bool) -> None:
    """Whatever moves its node: programs put people in a room by their armatures, and their meshes at the origin."""
    nodes = [
        {"name": "body", "mesh": 0, "skin": 0, "translation": [9, 9, 9]},
        {"name": "armature", "translation": [0, 3, 0], "scale": [2, 2, 2], "children": [2]},
        {"name": "hips", "translation": [1, 0, 0], "children": [3]},
        {"name": "arm", "rotation": [0, 0, 1, 0], "translation": [0, 1, 0]},  # turned by half a circle about z
    ]
    back = np.stack([np.eye(4)] * 2)
    back[:, :3, 3] = (0, -1, 0), (-1, 0, 5)
    joints, weights = np.zeros((8, 4), np.uint8), np.zeros((8, 4), np.uint8)
    joints[:, 1] = 1
    weights[:, 0], weights[:, 1] = np.arange(8), 8 - np.arange(8)
    weights[4] = 0  # as of a vertex in no group
    tree = gltf(nodes, skins=[{"joints": [3, 2], **({"inverseBindMatrices": 3} if bound else {})}])
    # A matrix is stored column by column.
    data = bytes(4) + back.transpose(0, 2, 1).astype("<f4").tobytes() + joints.tobytes() + weights.tobytes()
    for size, kind in ((128, (5126, 2, "MAT4")), (32, (5121, 8, "VEC4")), (32, (5121, 8, "VEC4"))):
        start = 4 + sum(view["byteLength"] for view in tree["bufferViews"][2:])
        view = {"bufferView": len(tree["bufferViews"])}
        tree["accessors"].append(view | dict(zip(("componentType", "count", "type"), kind, strict=True)))
        tree["bufferViews"].append({"buffer": 1, "byteOffset": start, "byteLength": size})
    tree["meshes"][0]["primitives"][0]["attributes"] |= {"JOINTS_0": 4, "WEIGHTS_0": 5}
    uri = "data:;base64," + base64.b64encode(data).decode()
    tree["buffers"].append({"byteLength": len(data), "uri": uri})
    write(tmp_path / "a.gltf", tree)
    built, _, _ = scene(tmp_path)
    by_arm, by_hips = BOX.vertices + bound * back[0, :3, 3], BOX.vertices + bound * back[1, :3, 3]
    by_arm = by_arm * (-1, -1, 1) + (0, 1, 0)
    share = np.array([0, 1, 2, 3, 8, 5, 6, 7])[:, None] / 8
    moved = 2 * (share * by_arm + (1 - share) * by_hips + (1, 0, 0)) + (0, 3, 0)
    assert np.allclose(built.mesh.vertices[built.mesh.faces], moved[BOX.faces][:6], atol=1e-5)


def test_geometry_that_trimesh_leaves_out_or_misplaces_is_refused(tmp_path: Path) -> None:
    def found(**more: Any) -> str:
        write(tmp_path / "a.gltf", gltf([{"name": "arm", "mesh": 0}], **more))
        return reason(tmp_path)

    for name in ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "EXT_mesh_gpu_instancing"):
        assert f"a.gltf: geometry must be plain, found {name}: export" in found(extensionsRequired=[name, "KHR_lights"])
    copies = {"name": "arm", "mesh": 0, "extensions": {"EXT_mesh_gpu_instancing": {}}}  # a file need not require it
    write(tmp_path / "a.gltf", gltf([copies]))
    assert "found EXT_mesh_gpu_instancing: export" in reason(tmp_path)
    shaped = {"primitives": gltf([])["meshes"][0]["primitives"]}
    assert "found weights of shape keys: export" in found(meshes=[shaped | {"weights": [0, 0.5]}])
    write(tmp_path / "a.gltf", gltf([{"name": "arm", "mesh": 0}], meshes=[shaped | {"weights": [0, 0.0]}]))
    assert scene(tmp_path)[2] == ("arm",)
    vertices, *others = gltf([])["accessors"]
    assert "found sparse positions" in found(accessors=[vertices | {"sparse": {"count": 1}}, *others])
    assert "found normalized positions" in found(accessors=[vertices | {"normalized": True}, *others])
    fan = {"attributes": {"POSITION": 0}, "indices": 1, "mode": 6}
    assert "found triangle fans" in found(meshes=[{"primitives": [fan]}])


@pytest.mark.parametrize("material", [False, True])
def test_colours_of_gltf_with_a_table(tmp_path: Path, material: bool) -> None:
    """Blender writes them beside a material, as 16 bits."""
    red = np.where(UPPER, 65535, 0)
    data = np.stack([red, 0 * red, 65535 - red, 0 * red + 65535], axis=1).astype("<u2").tobytes()
    part = {"attributes": {"POSITION": 0, "COLOR_0": 3}, "indices": 1, **({"material": 0} if material else {})}
    tree = gltf([{"name": "arm", "mesh": 0}], meshes=[{"primitives": [part]}], materials=[{"name": "steel"}])
    tree["accessors"].append({"bufferView": 2, "componentType": 5123, "normalized": True, "count": 8, "type": "VEC4"})
    tree["bufferViews"].append({"buffer": 1, "byteOffset": 0, "byteLength": 64})
    tree["buffers"].append({"byteLength": 64, "uri": "data:;base64," + base64.b64encode(data).decode()})
    write(tmp_path / "a.gltf", tree)
    table = [{"name": "low", "colour": "#0000ff"}, {"name": "high", "colour": "#ff0000"}]
    write(tmp_path / "classes.json", {"labels": "colours", "classes": table})
    assert np.array_equal(scene(tmp_path)[1], UPPER[BOX.faces][:6])


def test_buffers_of_gltf_lie_where_it_says_and_are_in_the_digest(tmp_path: Path) -> None:
    """Blender writes spaces and umlauts of a buffer's name as %20 and the like."""
    import trimesh

    whole = trimesh.Scene()
    for name in ("base", "arm"):
        whole.add_geometry(trimesh.Trimesh(BOX.vertices, BOX.faces, process=False), node_name=name)
    files = trimesh.exchange.gltf.export_gltf(whole)
    tree = json.loads(files.pop("model.gltf"))
    for buffer in tree["buffers"]:
        name = buffer["uri"]
        write(tmp_path / "my buffers" / name, files.pop(name))
        buffer["uri"] = f"my%20buffers/{name}"
    write(tmp_path / "a.gltf", tree)
    assert set(scene(tmp_path)[2]) == {"base", "arm"}
    source = open_source("labelled", tmp_path)
    before = source.fingerprint(source.bodies())
    file = tmp_path / "my buffers" / name
    file.write_bytes(file.read_bytes()[:-1] + b"\1")
    assert source.fingerprint(source.bodies()) != before


@pytest.mark.parametrize("file", ["a.obj", "a.labels.json", "classes.json", "a.scene.json"])
def test_every_file_of_a_scene_is_in_the_digest(tmp_path: Path, file: str) -> None:
    """A packing of other files is another one."""
    write(tmp_path / "a.obj", BOX_OBJ)
    write(tmp_path / "a.labels.json", [0] * 12)
    write(tmp_path / "classes.json", {"classes": ["box"]})
    write(tmp_path / "a.scene.json", {"format": "bodyseg scene 1", "meshes": [{"mesh": "a.obj"}]})

    def digest() -> str:
        source = open_source("labelled", tmp_path)
        return source.fingerprint(source.bodies())

    before = digest()
    assert digest() == before
    (tmp_path / file).write_bytes((tmp_path / file).read_bytes() + b"\n")
    assert digest() != before


def test_vertices_that_no_face_uses_are_left_out(tmp_path: Path) -> None:
    vertices = np.concatenate([[[9.0, -5.0, 9.0]], BOX.vertices, [[np.nan, 0.0, 0.0]]])
    write(tmp_path / "a.obj", obj(vertices, BOX.faces + np.int32(1)))
    write(tmp_path / "classes.json", {"classes": ["box"]})
    write(tmp_path / "a.labels.json", [0] * 12)
    built, corners, _ = scene(tmp_path)
    assert np.array_equal(built.mesh.vertices[built.mesh.faces], BOX.vertices[BOX.faces])
    assert (len(built.mesh.vertices), corners.shape) == (8, (12, 3))


def test_vertices_of_triangles_and_seams_are_joined_and_keep_their_labels(tmp_path: Path) -> None:
    soup = BOX.vertices[BOX.faces].reshape(-1, 3)
    write(tmp_path / "a.obj", obj(soup, np.arange(36, dtype=np.int32).reshape(-1, 3)))
    write(tmp_path / "classes.json", {"classes": ["a", "b", "c", "d"]})
    write(tmp_path / "a.vertex_labels.npy", np.repeat(QUARTERS, 3))
    built, corners, _ = scene(tmp_path)
    assert len(built.mesh.vertices) == 8
    assert np.array_equal(corners, np.repeat(QUARTERS[:, None], 3, axis=1))
    assert np.array_equal(built.mesh.vertices[built.mesh.faces], BOX.vertices[BOX.faces])


def test_a_file_that_is_cut_is_told(tmp_path: Path) -> None:
    import trimesh

    box = trimesh.Trimesh(BOX.vertices, BOX.faces, process=False)
    text, binary, gltf = (box.export(file_type=kind) for kind in ("stl_ascii", "stl", "glb"))
    two = f"{text}\n{text}".encode()  # of which the first solid is whole
    for name, data, problem in (
        ("a.stl", two[:-200], "a.stl: the file is cut: neither as long as its header announces, nor text up to"),
        ("a.stl", two[: len(text) + 100], "a.stl: the file is cut"),  # soon after the second solid begins
        ("a.stl", binary[:-1], "a.stl: the file is cut: neither as long as its header announces, nor text up to"),
        ("a.glb", gltf[:-1], f"a.glb: the header announces {len(gltf)} bytes, the file ends after {len(gltf) - 1}"),
    ):
        write(tmp_path / name, data)
        with pytest.raises(BadMesh, match=problem):
            mesh_content(tmp_path / name)
    for data in (two, two + b"\n" + 99 * b"; a long comment\n", binary):
        write(tmp_path / "a.stl", data)
        assert len(mesh_content(tmp_path / "a.stl").faces) in (12, 24)


def test_faults_are_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path / "a.obj", BOX_OBJ)
    assert "the file holds none: put a .labels.json" in reason(tmp_path)
    write(tmp_path / "a.json", {"front": [*FRONT, 8]})
    assert "a.json: the part 'front' must hold vertices 0 to 7, found 8" in reason(tmp_path)
    write(tmp_path / "a.json", {"front": [3, -1]})
    assert "the part 'front' must hold vertices 0 to 7, found -1" in reason(tmp_path)
    with monkeypatch.context() as patch:  # lists of the vertices of a large mesh
        patch.setattr(access, "_LARGEST_JSON", 8)
        write(tmp_path / "a.json", {"front": [8]})
        assert "must hold vertices 0 to 7, found 8" in reason(tmp_path)
    (tmp_path / "a.json").write_text('{"front": [0], "front": [1]}')
    assert "a.json: the key 'front' stands twice" in reason(tmp_path)
    write(tmp_path / "a.json", {"front": [0.5]})
    assert "the part 'front' must be a list of vertices" in reason(tmp_path)
    for wrong in ([[0], [1, 2]], [10**30], "front", {"a": [0]}):
        write(tmp_path / "a.json", {"front": wrong})
        assert "the part 'front' must" in reason(tmp_path)
    write(tmp_path / "a.json", [0, 1])
    assert "labels are numbers: classes.json must name" in reason(tmp_path)
    write(tmp_path / "classes.json", {"classes": ["low", "high"]})
    assert "one label for each of the mesh's 8 vertices or 12 faces, found 2" in reason(tmp_path)
    write(tmp_path / "a.json", [0, 1, 2, 0, 0, 0, 0, 0])
    assert "labels must be numbers of classes, 0 to 1, found 2" in reason(tmp_path)
    write(tmp_path / "a.json", "[")
    assert "cannot read the labels" in reason(tmp_path)
    (tmp_path / "a.json").unlink()
    write(tmp_path / "a.npy", np.array([[0.5] * 8]))
    assert "labels must be whole numbers in one row" in reason(tmp_path)
    write(tmp_path / "a.npy", np.zeros(12, np.int64))
    (tmp_path / "a.npy").write_bytes((tmp_path / "a.npy").read_bytes().replace(b"(12,)", b"(9999999999999,)"))
    assert "cannot read the labels" in reason(tmp_path)
    (tmp_path / "a.npy").write_bytes(b"")
    assert "cannot read the labels" in reason(tmp_path)
    write(tmp_path / "classes.json", {"classes": ["a"], "labels": 3})
    assert "'labels' must be a list of names" in reason(tmp_path)
    write(tmp_path / "classes.json", {"classes": ["a", {"name": "b", "number": 0}]})
    assert "the 'number' of 'b' must be whole and its own: 0" in reason(tmp_path)
    write(tmp_path / "classes.json", {"classes": [{"colour": "#000000"}]})
    assert "a class is a name, or an object with one" in reason(tmp_path)


def test_damaged_and_unknown_files_are_one_line(tmp_path: Path) -> None:
    for name, content, why in (
        ("a.glb", b"glTF" + bytes(40), "cannot be read by trimesh"),
        ("a.gltf", b"{", "is no glTF 2"),
        ("a.gltf", b'{"buffers":' + b"[" * 100_000, "is no glTF 2"),
        ("a.ply", b"ply\n", "the header must end"),
    ):
        assert why in reason(write(tmp_path / name.replace(".", "_") / name, content).parent)
    write(tmp_path / "two" / "a.obj", BOX_OBJ)
    write(tmp_path / "two" / "a.ply", ply())
    assert "a scene is one mesh file, found a.obj and a.ply" in reason(tmp_path / "two")
    write(tmp_path / "scene" / "scene.json", {"format": "bodyseg scene 1", "meshes": [{"mesh": "none.obj"}]})
    assert "cannot read" in reason(tmp_path / "scene")
    with pytest.raises(BadConfig, match="the source 'labelled' needs meshes"):
        open_source("labelled", write(tmp_path / "empty" / "notes.txt", "").parent)
    with pytest.raises(BadConfig, match="has labels of its own and needs no --landmarks"):
        open_source("labelled", tmp_path, landmarks=tmp_path)


def test_colours_of_floats_are_shares(tmp_path: Path) -> None:
    """As MeshLab writes them behind the coordinates of OBJ's vertices."""
    lines = BOX_OBJ.decode().splitlines()
    reds = [f"{line} {float(upper)} 0.0 {float(not upper)}" for line, upper in zip(lines[:8], UPPER, strict=True)]
    write(tmp_path / "a.obj", "\n".join([*reds, *lines[8:], ""]))
    table = [{"name": "low", "colour": "#0000ff"}, {"name": "high", "colour": "#ff0000"}]
    write(tmp_path / "classes.json", {"classes": table})
    assert np.array_equal(scene(tmp_path)[1], UPPER[BOX.faces])


def test_stl_has_no_labels(tmp_path: Path) -> None:
    facet = "facet normal 0 0 0\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 0 1\nendloop\nendfacet\n"
    write(tmp_path / "floor.stl", f"solid floor\n{facet}endsolid floor\n")
    assert "files of this kind hold none" in reason(tmp_path)
    write(tmp_path / "scene.json", {"format": "bodyseg scene 1", "meshes": [{"mesh": "floor.stl", "class": "floor"}]})
    assert scene(tmp_path)[2] == ("floor",)


def test_as_many_faces_as_vertices_are_told_apart_by_the_files_name(tmp_path: Path) -> None:
    faces = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]], np.int32)
    write(tmp_path / "a.obj", obj(np.concatenate([np.zeros((1, 3)), np.eye(3)]), faces))
    write(tmp_path / "classes.json", {"classes": ["a", "b"]})
    write(tmp_path / "a.labels.npy", np.array([0, 0, 0, 1]))
    assert "4 vertices and as many faces" in reason(tmp_path)
    (tmp_path / "a.labels.npy").rename(tmp_path / "a.face_labels.npy")
    assert scene(tmp_path)[1].tolist() == [[0] * 3] * 3 + [[1] * 3]
    (tmp_path / "a.face_labels.npy").rename(tmp_path / "surface_labels.npy")
    write(
        tmp_path / "scene.json",
        {"format": "bodyseg scene 1", "meshes": [{"mesh": "a.obj", "labels": "surface_labels.npy"}]},
    )
    assert "4 vertices and as many faces" in reason(tmp_path)


def test_a_scene_places_its_meshes(tmp_path: Path) -> None:
    write(tmp_path / "box.obj", BOX_OBJ)
    write(tmp_path / "box.json", {"front": FRONT, "back": BACK})
    turned = [0, 0, 1, 0, 0, 1, 0, 0, -1, 0, 0, 2, 0, 0, 0, 1]
    meshes = [
        {"mesh": "box.obj", "pose": turned},
        {"mesh": "box.obj", "class": "floor", "position_m": [0, -1, 0], "units": "cm"},
    ]
    tree = {"format": "bodyseg scene 1", "meshes": meshes, "subject": "anna", "split": "test", "centre_m": [0, 1, 0]}
    write(tmp_path / "one" / "scene.json", "{}")
    assert "'format' must be 'bodyseg scene 1'" in reason(tmp_path)
    (tmp_path / "one" / "scene.json").unlink()
    write(tmp_path / "one.scene.json", tree)
    built, corners, names = scene(tmp_path)
    assert names == ("front", "back", "floor") and (corners[12:] == 2).all()
    first, second = built.mesh.vertices[:8], built.mesh.vertices[8:]
    assert np.allclose(first, np.stack([BOX.vertices[:, 2], BOX.vertices[:, 1], 2 - BOX.vertices[:, 0]], axis=1))
    assert np.allclose(second, BOX.vertices / 100 + (0, -1, 0))
    assert built.mesh.centre.tolist() == [0, 1, 0]
    (ref,) = open_source("labelled", tmp_path).bodies()
    assert (ref.subset, ref.subject, ref.mesh, ref.split) == ("labelled", "anna", "one", "test")
    write(tmp_path / "one" / "scene.json", tree)
    assert "two scenes have one name" in reason(tmp_path)
    (tmp_path / "one" / "scene.json").unlink()
    turned_files: Any = open_source("labelled", tmp_path, up="z", units="cm")
    placed = turned_files.build(ref).mesh
    assert placed.centre.tolist() == [0, 0, -1]
    x, y, z = BOX.vertices.T / 100
    assert np.allclose(placed.vertices[:8], np.stack([z, 2 - x, -y], axis=1))
    for wrong, why in (
        ({"pose": [-1, *turned[1:]]}, "must not mirror"),
        ({"pose": turned, "position_m": [0, 0, 0]}, "one 'pose' or 'position_m'"),
        ({"class": "a", "labels": "groups"}, "one 'class' or 'labels'"),
        ({"colour": "red"}, "unknown 'colour'"),
    ):
        if why == "must not mirror":
            wrong = {"pose": [-1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}
        write(tmp_path / "one.scene.json", {**tree, "meshes": [{"mesh": "box.obj", **wrong}]})
        assert why in reason(tmp_path)


def test_a_scene_file_right_in_the_folder_of_a_split_is_of_that_split(tmp_path: Path) -> None:
    tree = {"format": "bodyseg scene 1", "meshes": [{"mesh": "../box.obj", "class": "box"}]}
    for name, more in (("train", {}), ("Test", {}), ("test", {"split": "train"})):
        write(tmp_path / name / "scene.json", {**tree, **more})
    assert [body.split for body in open_source("labelled", tmp_path).bodies()] == ["test", "train", "train"]


@pytest.mark.parametrize("name", ["scene", "cell.scene"])
def test_a_scene_file_beside_a_mesh_of_its_name_holds_no_labels(tmp_path: Path, name: str) -> None:
    write(tmp_path / "classes.json", {"classes": ["lower", "upper"]})
    write(tmp_path / f"{name}.ply", ply({"label": UPPER.astype(int)}))
    write(tmp_path / f"{name}.json", {"format": "bodyseg scene 1", "meshes": [{"mesh": f"{name}.ply"}]})
    np.testing.assert_array_equal(scene(tmp_path)[1], UPPER[BOX.faces])


def test_names_of_two_sides_are_mirror_images() -> None:
    names = ["head", "leftHand", "rightHand", "Arm.L", "Arm.R", "lap", "left", "Lt. ASIS", "Rt. ASIS"]
    assert classes_of(names).mirrored[:9].tolist() == [0, 2, 1, 4, 3, 5, 6, 8, 7]


def test_one_of_two_classes_may_state_their_mirror_image(tmp_path: Path) -> None:
    write(tmp_path / "a.obj", named_faces("g"))
    rows = [{"name": f"part {at}"} for at in range(4)]
    write(tmp_path / "classes.json", {"classes": [{**rows[0], "mirror": "part 2"}, *rows[1:]]})
    source: Any = open_source("labelled", tmp_path)
    assert source.classes.mirrored[:4].tolist() == [2, 1, 0, 3]


def pack(folder: Path, out: Path, *more: str) -> int:
    words = ["--views", "2", "--azimuths", "2", "--azimuth-span", "360", "--distances", "215", "--workers", "1"]
    given = ["--source", "labelled", "--path", str(folder), "--out", str(out), "--rig", str(SMALL_FILE)]
    return main(["shard", *given, *words, *more])


@pytest.mark.usefixtures("packing_here")
@pytest.mark.parametrize("soup", [False, True])
def test_every_pixel_has_the_class_of_what_it_shows(tmp_path: Path, soup: bool) -> None:
    """A box on a floor whose only side turns downwards, which light reaches from above."""
    vertices, faces = BOX.vertices, BOX.faces
    floor = np.array([[-2, 0, -2], [2, 0, -2], [2, 0, 2], [-2, 0, 2]], np.float64)
    meshes: list[dict[str, Any]] = [{"mesh": "box.obj"}, {"mesh": "floor.obj", "class": "floor"}]
    write(tmp_path / "in" / "box.json", {"front": FRONT, "back": BACK})
    if soup:
        (tmp_path / "in" / "box.json").unlink()
        write(tmp_path / "in" / "box.npy", np.isin(faces.ravel(), BACK).astype(np.uint8))
        write(tmp_path / "in" / "classes.json", {"classes": ["front", "back", "floor"]})
        vertices, faces = vertices[faces].reshape(-1, 3), np.arange(36, dtype=np.int32).reshape(-1, 3)
    write(tmp_path / "in" / "box.obj", obj(vertices, faces))
    write(tmp_path / "in" / "floor.obj", obj(floor, np.array([[0, 1, 2], [0, 2, 3]], np.int32)))
    tree = {"format": "bodyseg scene 1", "meshes": meshes, "centre_m": [0, 0.5, 0]}
    write(
        tmp_path / "in" / "cell" / "scene.json", {**tree, "meshes": [{**m, "mesh": f"../{m['mesh']}"} for m in meshes]}
    )
    assert pack(tmp_path / "in", tmp_path / "set", "--pitch", "-20") == 0
    manifest = read_manifest(tmp_path / "set")
    assert manifest.classes.names == ("front", "back", "floor")
    images = RangeImages(str(tmp_path / "set"), variant="none", split="train")
    lit_images = RangeImages(str(tmp_path / "set"), variant="occ", split="train")
    for at, seen in enumerate((0, 1)):
        labels = images[at]["labels"].numpy()
        middle = labels.shape[0] // 2, labels.shape[1] // 2
        assert labels[middle] == seen and labels[-1, middle[1]] == 2
        assert (labels == 1 - seen).sum() < (labels == seen).sum()
        lit = lit_images[at]["range"][0].numpy() > 0
        assert lit[labels == 2].mean() > 0.5


@pytest.mark.usefixtures("packing_here")
def test_a_scene_around_the_camera_gets_a_note(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write(tmp_path / "in" / "box.obj", obj(15 * BOX.vertices, BOX.faces))
    write(tmp_path / "in" / "scene.json", {"format": "bodyseg scene 1", "meshes": [{"mesh": "box.obj", "class": "a"}]})
    note = "the camera stands within its bounding box: are --units and --distances right?"
    assert pack(tmp_path / "in", tmp_path / "near") == 0 and note in capsys.readouterr().err
    assert pack(tmp_path / "in", tmp_path / "far", "--units", "cm") == 0
    assert note not in capsys.readouterr().err


QUADS = MeshContent(
    np.array([[x, y, 0.0] for y in range(2) for x in range(4)]),
    np.array([[0, 1, 5], [0, 5, 4], [1, 2, 6], [1, 6, 5], [2, 3, 7], [2, 7, 6]], np.int32),
    np.array([0, 0, 1, 1, 2, 2]),
)
"""Three squares in a row, of two triangles each."""


def test_numbers_are_of_vertices_of_polygons_or_of_triangles() -> None:
    table = {5: "five", 6: "six", 9: "nine"}
    for numbers, corners in (
        ([5, 9, 6], [[0] * 3, [0] * 3, [2] * 3, [2] * 3, [1] * 3, [1] * 3]),
        ([[5], [9], [6]], [[0] * 3, [0] * 3, [2] * 3, [2] * 3, [1] * 3, [1] * 3]),
        ([5, 6, 9, 255, 5, 6], [[0] * 3, [1] * 3, [2] * 3, [-1] * 3, [0] * 3, [1] * 3]),
        ([5, 6, 9, 5, 6, 9, 5, -1], [[0, 1, 2], [0, 2, 1], [1, 2, 0], [1, 0, 2], [2, 0, -1], [2, -1, 0]]),
    ):
        found = labels_of_numbers(np.array(numbers), QUADS, table, "a.npy")
        assert found.names == ("five", "six", "nine") and found.corners.tolist() == corners


def test_lists_of_vertices_may_share_some() -> None:
    """A triangle is of the first list that holds it, else of those of its corners."""
    lists = {"left": [0, 1, 4, 5], "middle": [1, 2, 5], "tip": [7], "again": [0, 1, 4, 5], "none": []}
    found = labels_of_parts(lists, QUADS, "a.json")
    assert found.corners.tolist() == [[0] * 3, [0] * 3, [0, 1, -1], [0, -1, 0], [1, -1, 2], [1, 2, -1]]
    assert found.notes == ("6 vertices are in two parts: their triangles go by all three corners",)


@pytest.mark.parametrize("scale", [1.0, 1 / 255])
def test_colours_are_of_polygons_in_bytes_or_shares(scale: float) -> None:
    channels = np.array([[255, 0, 16], [0, 255, 1], [255, 0, 16]]) * scale
    coloured = replace(QUADS, of_polygons=dict(zip(("red", "green", "blue"), channels.T, strict=True)))
    found = labels_of_colours(coloured, {"#00ff01": "lamp", "#ff0010": "wall"}, "a.ply")
    assert found.corners[:, 0].tolist() == [1, 1, 0, 0, 1, 1] and found.names == ("lamp", "wall")
    with pytest.raises(BadMesh, match="^a.ply: the colour #00ff01, of number 1 of faces, is no class's"):
        labels_of_colours(coloured, {"#ff0010": "wall"}, "a.ply")
