"""Reading .ply, .obj and .off: the file's order kept, everything else in it passed over, hostile files refused."""

from __future__ import annotations

import gzip
import os
import re
import struct
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from bodyseg_data.core import BadMesh
from bodyseg_data.meshes import mesh_files, mesh_stem, preferred, read_mesh

VERTICES = np.array([[0, 0, 0], [1.5, 0, 0], [0, 1.25, 0], [0, 0, 1], [1, 1, 1], [9, 9, 9]], np.float64)
FACES = np.array([[0, 2, 1], [4, 1, 3], [0, 3, 2], [1, 2, 3], [2, 4, 0], [2, 0, 3]])  # the last two from one square
POLYGONS = [(0, 2, 1), (4, 1, 3), (0, 3, 2), (1, 2, 3), (2, 4, 0, 3)]
TRIANGLES = [tuple(face) for face in FACES.tolist()]

Polygons = list[tuple[int, ...]]


def ply_text(polygons: Polygons = POLYGONS) -> bytes:
    """A text file with all that scanners and editors add."""
    header = f"""ply
format ascii 1.0
comment made for a test
obj_info num_cols 512
element vertex {len(VERTICES)}
property float x
property float nx
property double y
property float z
property uchar red
element range_grid 2
property list uchar int vertex_indices
element face {len(polygons)}
property uchar flags
property list uchar float texcoord
property list uchar int vertex_indices
property float quality
end_header
"""
    rows = [f"{x!r} 0.5 {y!r} {z!r} 255" for x, y, z in VERTICES.tolist()] + ["0", "2 3 4"]
    rows += [f"1 2 0.5 0.5 {len(corners)} {' '.join(map(str, corners))} 7.5" for corners in polygons]
    return (header + "\n".join(rows) + "\n").encode()


def ply_binary(order: str, polygons: Polygons = POLYGONS, extras: bool = True) -> bytes:
    name = "little" if order == "<" else "big"
    header = f"ply\nformat binary_{name}_endian 1.0\nelement vertex {len(VERTICES)}\n"
    header += "property double x\nproperty double y\nproperty double z\nproperty uchar red\n"
    if extras:
        header += "element range_grid 2\nproperty list uchar int vertex_indices\nelement camera 1\nproperty float f\n"
    header += (
        f"element face {len(polygons)}\nproperty list uchar uint vertex_index\nproperty short quality\nend_header\n"
    )
    rows = b"".join(struct.pack(f"{order}3dB", *vertex, 10) for vertex in VERTICES)
    if extras:
        rows += struct.pack(f"{order}B", 0) + struct.pack(f"{order}B2i", 2, 3, 4) + struct.pack(f"{order}f", 1)
    for corners in polygons:
        rows += struct.pack(f"{order}B{len(corners)}Ih", len(corners), *corners, -5)
    return header.encode() + rows


def obj_text(form: Callable[[int], str] = str, polygons: Polygons = POLYGONS) -> bytes:
    lines = [
        "# made for a test",
        "mtllib some thing.mtl",
        "o body \xfcber",
        *(f"v {x!r} {y!r} {z!r}" for x, y, z in VERTICES.tolist()),
    ]
    lines += ["vt 0.5 0.5", "vn 0 0 1", "g trunk", "usemtl skin", "s 1", ""]
    lines += ["f " + " ".join(form(corner + 1) for corner in corners) + "  \t" for corners in polygons]
    return "\r\n".join([*lines, "l 1 2", "", ""]).encode("latin-1")


def off_text(header: str = "OFF\n", counts: str = "6 5 0", extra: str = "", colour: str = "") -> bytes:
    lines = [f"# made for a test\n{header}{counts}", ""]
    lines += [f"{x!r} {y!r} {z!r}{extra}  # a vertex" for x, y, z in VERTICES.tolist()]
    lines += ["", *(f"{len(corners)}  {' '.join(map(str, corners))}{colour}" for corners in POLYGONS)]
    return "\n".join(lines).encode()


GOOD = {
    "text.ply": ply_text(),
    "windows.ply": ply_text().replace(b"\n", b"\r\n"),
    "triangles.ply": ply_text(TRIANGLES),
    "little.ply": ply_binary("<"),
    "big.ply": ply_binary(">"),
    "even.ply": ply_binary("<", TRIANGLES, extras=False),
    "EVEN_BIG.PLY": ply_binary(">", TRIANGLES),
    "plain.obj": obj_text(),
    "texture.obj": obj_text("{0}/7".format),
    "normals.obj": obj_text("{0}//3".format),
    "both.obj": obj_text("{0}/7/3".format),
    "backwards.obj": obj_text(lambda corner: str(corner - 7)),
    "continued.obj": obj_text().replace(b" 0.0 0.0", b" \\\r\n0.0 0.0"),
    "coloured.obj": re.sub(rb"(v [^\r]*)", rb"\1 0.5 0.5 0.5", obj_text()),
    "plain.off": off_text(),
    "in_one_line.off": off_text("OFF "),
    "no_edges.off": off_text(counts="6 5"),
    "joined.off": off_text("OFF"),
    "coloured_faces.off": off_text(colour=" 255 0 0"),
    "coloured_vertices.off": off_text("COFF\n", extra=" 255 0 0 255"),
    "normals.off": off_text("NOFF\n", extra=" 0 0 1"),
    "of_meshlab.off": off_text("NCOFF\n", extra=" 255 0 0 255 0 0 1"),
}


def test_three_corners_in_line_but_for_rounding_keep_their_fan(tmp_path: Path) -> None:
    """The second corner of this quad of 2 x 4 cm lies a micrometre inside of a line, as of a file with six decimals."""
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 0.009999 0.02 0\nv 0.02 0.04 0\nv 0 0.04 0\nf 1 2 3 4\n")
    assert read_mesh(tmp_path / "a.obj")[1].tolist() == [[0, 1, 2], [0, 2, 3]]


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("name", GOOD)
def test_vertices_and_faces_come_in_the_order_of_the_file(tmp_path: Path, name: str, packed: bool) -> None:
    path = tmp_path / (name + ".gz" if packed else name)
    path.write_bytes(gzip.compress(GOOD[name]) if packed else GOOD[name])
    vertices, faces = read_mesh(path)
    assert vertices.dtype == np.float64 and faces.dtype == np.int32
    np.testing.assert_array_equal(vertices, VERTICES)
    np.testing.assert_array_equal(faces, FACES)


@pytest.mark.parametrize("name", ["plain.obj", "text.ply", "plain.off", "little.ply"])
def test_nothing_is_merged_or_left_out(tmp_path: Path, name: str) -> None:
    """Vertices in one place and faces without area stay, and so does what no face uses, whatever it is."""
    old = struct.pack("<d", 1.25) if name == "little.ply" else b"1.25"
    new = struct.pack("<d", 0.0) if name == "little.ply" else b"0.00"
    stray = struct.pack("<d", 9.0) if name == "little.ply" else b"9.0 9.0 9.0"
    nan = struct.pack("<d", np.nan) if name == "little.ply" else b"nan nan nan"
    data = GOOD[name].replace(old, new).replace(stray, nan).replace(b"9.0 0.5 9.0 9.0", b"nan nan nan nan")
    path = tmp_path / name
    path.write_bytes(data)
    vertices, faces = read_mesh(path)
    np.testing.assert_array_equal(vertices[:3], [[0, 0, 0], [1.5, 0, 0], [0, 0, 0]])
    assert np.isnan(vertices[5]).all()
    np.testing.assert_array_equal(faces, FACES)


def changed(name: str, old: bytes, new: bytes) -> bytes:
    assert old in GOOD[name]
    return GOOD[name].replace(old, new)


BROKEN = {
    "a .stl": ("a.stl", b"", "must end in .ply, .obj"),
    "empty.ply": ("a.ply", b"", "the file is empty"),
    "empty.off": ("a.off", b"", "the file is empty"),
    "empty.obj": ("a.obj", b"", "needs vertices and faces, found 0 and 0"),
    "a picture": ("a.ply", b"\x89PNG\r\n\x1a\n" + bytes(64), "must begin with 'ply'"),
    "a picture.obj": ("a.obj", b"\x89PNG\r\n\x1a\n" + bytes(64), "found 0 and 0"),
    "a picture.off": ("a.off", b"\x89PNG\r\n\x1a\n" + bytes(64), "must begin with OFF"),
    "a page": ("a.obj", b"<!DOCTYPE html>\n<html>not found</html>\n", "found 0 and 0"),
    "no end_header": ("a.ply", GOOD["text.ply"].partition(b"end_header")[0], "must end with a line 'end_header'"),
    "endless header": ("a.ply", b"ply\n" + b"comment\n" * 100_000, "must end with a line 'end_header'"),
    "no format": ("a.ply", changed("text.ply", b"format ascii 1.0\n", b""), "must name the format"),
    "another format": ("a.ply", changed("text.ply", b"ascii 1.0", b"ascii 2.0"), "line 2 of the header is not PLY"),
    "a negative count": ("a.ply", changed("text.ply", b"vertex 6", b"vertex -6"), "line 5 of the header is not PLY"),
    "an unknown type": ("a.ply", changed("text.ply", b"double y", b"quad y"), "header is not PLY: 'property quad y'"),
    "no z": ("a.ply", changed("text.ply", b"float z", b"float w"), "'vertex' must have the property 'z'"),
    "no corners": (
        "a.ply",
        changed("little.ply", b"vertex_index\n", b"corners\n"),
        "must have the property 'vertex_in",
    ),
    "corners with decimals": ("a.ply", changed("little.ply", b"uchar uint", b"uchar float"), "list of whole numbers"),
    "a corner that is no list": ("a.ply", changed("little.ply", b"list uchar uint", b"uint"), "list of whole numbers"),
    "lists as vertices": ("a.ply", changed("little.ply", b"double z", b"list uchar int z"), "must have no lists"),
    "a bare element": ("a.ply", changed("little.ply", b"property float f\n", b""), "'camera' must have properties"),
    "a long length": ("a.ply", changed("little.ply", b"uchar uint", b"double uint"), "length must be whole"),
    "too few rows": ("a.ply", changed("text.ply", b"face 5", b"face 6"), "announces 6 rows of 'face', the file ends"),
    "huge text": ("a.ply", changed("text.ply", b"face 5", b"face 999999999999999"), "announces 999999999999999"),
    "huge vertices": ("a.ply", changed("big.ply", b"vertex 6", b"vertex 999999999999999"), "the file ends after 9"),
    "huge faces": ("a.ply", changed("even.ply", b"face 6", b"face 999999999999999"), "the file ends after 6"),
    "huge other": ("a.ply", changed("big.ply", b"camera 1", b"camera 99999999999999"), "rows of 'camera'"),
    "a huge list": (
        "a.ply",
        changed("little.ply", b"list uchar int v", b"list uint int v").replace(bytes([2, 3, 0, 0]), b"\xff" * 4, 1),
        "rows of 'range_grid', the file ends after",
    ),
    "a short row": ("a.ply", changed("text.ply", b"0.0 0.5 1.25 0.0 255", b"0.0 0.5 1.25"), "line 21: 5 numbers"),
    "a word": ("a.ply", changed("text.ply", b"0.5 1.25", b"0.5 much"), "line 21: could not convert"),
    "a cut face": ("a.ply", changed("text.ply", b"3 0 3 2 7.5", b"3 0 3"), "line 29: a row must hold all"),
    "a face of two": ("a.ply", changed("text.ply", b"3 0 3 2", b"2 0 3"), "three corners, found 2 at face 2"),
    "a face of two, binary": ("a.ply", ply_binary("<", [(0, 1)] * 2), "three corners, found 2 at face 0"),
    "a NaN": ("a.ply", changed("text.ply", b"0.5 1.25", b"0.5 nan"), r"finite, found \[0.0, nan, 0.0\] at vertex 2"),
    "an infinity": ("a.obj", changed("plain.obj", b"v 1.5", b"v inf"), "finite, found .* at vertex 1"),
    "a corner outside": (
        "a.ply",
        changed("text.ply", b"3 0 3 2", b"3 0 6 2"),
        "vertices 0 to 5, found .0, 6, 2. at face",
    ),
    "a corner below": ("a.ply", changed("text.ply", b"3 0 3 2", b"3 0 -1 2"), "vertices 0 to 5, found .0, -1, 2."),
    "an enormous corner": ("a.ply", changed("text.ply", b"3 0 3 2", b"3 0 9" + b"9" * 30 + b" 2"), "is no vertex"),
    "no faces.ply": ("a.ply", ply_binary(">", []), "needs vertices and faces, found 6 and 0"),
    "obj, no number": ("a.obj", changed("plain.obj", b"v 1.5", b"v much"), "line 5 is not OBJ: could not convert"),
    "obj, a cut vertex": ("a.obj", b"v 1 2\n", "line 1 is not OBJ: three numbers must follow 'v', found 2"),
    "obj, a lone f": ("a.obj", b"v 1 2 3\nf\n", "line 2 is not OBJ: three numbers must follow 'f', found 0"),
    "obj, a line": ("a.obj", b"v 1 2 3\nf 1 1\n", "three numbers must follow 'f', found 2"),
    "obj, corner x": ("a.obj", b"v 1 2 3\nf 1 1 x\n", "line 2 is not OBJ: invalid literal"),
    "obj, corner 0": ("a.obj", b"v 1 2 3\nf 1 0 1\n", "must be a vertex, found 0 after 1 vertices"),
    "obj, back too far": ("a.obj", b"v 1 2 3\nf 1 -2 1\nv 1 2 3\n", "must be a vertex, found -2 after 1 vertices"),
    "obj, outside": ("a.obj", b"v 1 2 3\nf 1 1 2\n", "must use vertices 0 to 0, found .0, 0, 1."),
    "obj, enormous": ("a.obj", b"v 1 2 3\nf 1 1 9" + b"9" * 30, "is no vertex"),
    "obj, not text": ("a.obj", b"v 0 0 \xff\n", "line 1 is not OBJ"),
    "off, binary": ("a.off", b"OFF BINARY\n" + bytes(30), "the counts of vertices and faces must follow OFF"),
    "off, four dimensions": ("a.off", b"4OFF\n1 1 1\n", "must begin with OFF, found '4OFF'"),
    "off, no header": ("a.off", b"1 1 1\n0 0 0\n", "must begin with OFF, found '1 1 1'"),
    "off, no counts": ("a.off", b"OFF\n", "counts of vertices and faces must follow OFF, found ''"),
    "off, negative": ("a.off", b"OFF\n-1 1 1\n", "must follow OFF, found '-1 1 1'"),
    "off, huge": ("a.off", changed("plain.off", b"6 5 0", b"6 99999999999 0"), "announces 6 vertices and 99999999999"),
    "off, short": ("a.off", changed("plain.off", b"6 5 0", b"6 6 0"), "and 6 faces, found 11 lines"),
    "off, a cut vertex": ("a.off", changed("plain.off", b"1.25 0.0", b""), "line 7 is not OFF: not enough values"),
    "off, a cut face": ("a.off", changed("plain.off", b"4  2 4", b"9  2 4"), "as many as it says, found '9  2 4 0 3'"),
    "off, outside": ("a.off", changed("plain.off", b"3  1 2 3", b"3  1 2 8"), "vertices 0 to 5, found .1, 2, 8."),
    "not gzip": ("a.ply.gz", GOOD["text.ply"], "not a whole gzip file"),
    "half a gzip": ("a.ply.gz", gzip.compress(GOOD["text.ply"])[:-20], "not a whole gzip file"),
    "a broken gzip": ("a.ply.gz", gzip.compress(GOOD["text.ply"])[:20] + b"xxxxxxxx", "not a whole gzip file"),
}


@pytest.mark.parametrize("fault", BROKEN)
def test_broken_files_are_refused_in_one_line(tmp_path: Path, fault: str) -> None:
    name, data, message = BROKEN[fault]
    path = tmp_path / name
    path.write_bytes(data)
    with pytest.raises(BadMesh, match=message) as error:
        read_mesh(path)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


def test_a_file_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadMesh, match=r"cannot read .*none\.ply: No such file"):
        read_mesh(tmp_path / "none.ply")
    (tmp_path / "folder.obj").mkdir()
    with pytest.raises(BadMesh, match=r"cannot read .*folder\.obj: Is a directory"):
        read_mesh(tmp_path / "folder.obj")


@pytest.mark.parametrize("name", ["text.ply", "little.ply", "even.ply", "plain.off"])
def test_a_file_cut_anywhere_is_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    whole = GOOD[name].rstrip()
    for length in range(
        0, len(whole) - len(" 7.5"), 3
    ):  # a text may end within its last number, or lack what is not read
        path.write_bytes(whole[:length])
        with pytest.raises(BadMesh):
            read_mesh(path)


@pytest.mark.parametrize("name", GOOD)
def test_damage_is_read_or_refused(tmp_path: Path, name: str) -> None:
    """Whatever bytes change, there is a mesh whose faces use its vertices, or BadMesh."""
    random = np.random.default_rng(7)
    path = tmp_path / name
    for _ in range(60):
        data = bytearray(GOOD[name])
        for place in random.integers(0, len(data), 3):
            data[place] = random.integers(0, 256)
        path.write_bytes(bytes(data))
        try:
            vertices, faces = read_mesh(path)
        except BadMesh as error:
            assert "\n" not in str(error)
        else:
            assert faces.min() >= 0 and faces.max() < len(vertices) and np.isfinite(vertices[faces]).all()


@pytest.mark.parametrize("name", ["big.ply", "even.ply", "text.ply", "plain.off"])
def test_counts_in_a_header_cost_no_memory(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    old = re.search(rb"element face \d|6 5 0", GOOD[name])
    assert old
    path.write_bytes(GOOD[name].replace(old[0], b"6 2000000000" if b"6 5" in old[0] else b"element face 2000000000"))
    tracemalloc.start()
    try:
        with pytest.raises(BadMesh, match="2000000000"):
            read_mesh(path)
        assert tracemalloc.get_traced_memory()[1] < 2_000_000
    finally:
        tracemalloc.stop()


def test_what_unpacks_to_too_much_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mesh_files, "LARGEST_BYTES", 1 << 20)
    path = tmp_path / "bomb.obj.gz"
    path.write_bytes(gzip.compress(bytes(20 << 20)))
    tracemalloc.start()
    try:
        with pytest.raises(BadMesh, match="may hold 1 MiB, found more"):
            read_mesh(path)
        assert tracemalloc.get_traced_memory()[1] < 8 << 20
    finally:
        tracemalloc.stop()
    (tmp_path / "large.obj").write_bytes(bytes((1 << 20) + 1))
    with pytest.raises(BadMesh, match="may hold 1 MiB"):
        read_mesh(tmp_path / "large.obj")


def test_names() -> None:
    assert mesh_stem("CSR0001A.PLY.GZ") == "CSR0001A" and mesh_stem("a.obj") == "a" and mesh_stem("a.gz") is None
    assert mesh_stem("mesh000.ply.gz") == "mesh000" and mesh_stem("a.b.OFF") == "a.b" and mesh_stem("notes.txt") is None
    assert preferred(["a.off", "a.obj.gz", "a.obj"]) == "a.obj"


def test_real_frames_are_read_as_they_are(mit_folder: Path, tmp_path: Path) -> None:
    path = mit_folder / "I_crane" / "meshes" / "mesh_0000.obj"
    vertices, faces = read_mesh(path)
    lines = [line.split() for line in path.read_text().splitlines()]
    exact: NDArray[np.float64] = np.array([line[1:4] for line in lines if line and line[0] == "v"]).astype(np.float64)
    np.testing.assert_array_equal(vertices, exact)
    assert faces.shape == (20000, 3) and set(np.unique(faces)) == set(range(10002))
    packed = tmp_path / "mesh_0000.obj.gz"
    packed.write_bytes(gzip.compress(path.read_bytes()))
    np.testing.assert_array_equal(read_mesh(packed)[0], vertices)


def test_a_pipe_is_refused_instead_of_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "scan.ply")
    with pytest.raises(BadMesh, match=r"scan\.ply.*not a regular file"):
        read_mesh(tmp_path / "scan.ply")
