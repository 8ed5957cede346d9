"""Triangle meshes from .ply, .obj and .off files, each also with .gz behind it, in the order of the file.

Landmarks name vertices by index, so no vertex may be merged, split at a texture seam or left out. General mesh
libraries do one of these, or trust the counts in a header.
"""

from __future__ import annotations

import gzip
import re
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadMesh
from bodyseg_data.core.files import contents
from bodyseg_data.meshes.readers.ply import fan, read_ply
from bodyseg_data.meshes.topology import check_arrays

MESH_SUFFIXES: Final = (".ply", ".obj", ".off", ".ply.gz", ".obj.gz", ".off.gz")
"""Suffixes of mesh files, in upper or lower case; of several files of one mesh, the first in this order is read."""

LARGEST_BYTES: Final = 1 << 28
"""Largest size of a mesh file, also after unpacking: a scan of a million triangles has a tenth of it."""

_OFF_HEADER: Final = re.compile(r"(?:ST)?C?N?OFF\b|OFF(?=\d)")


def read_mesh(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Read vertices float64 [V, 3] and triangles int32 [F, 3], both in the file's order, units and axes.

    Polygons become fans about their first corner. Colours, normals and textures are ignored.
    Raises BadMesh, naming the file and, for text, the line, for a file that cannot be read, is truncated, is larger
    than `LARGEST_BYTES`, has no vertices or faces, or has faces with missing or non-finite vertices.
    """
    suffix = mesh_suffix(path.name)
    if suffix is None:
        raise BadMesh(f"a mesh file's name must end in {', '.join(MESH_SUFFIXES)}, found {path}")
    data = _contents(path, packed=suffix.endswith(".gz"))
    form = suffix.removesuffix(".gz")[1:]
    try:
        vertices, faces = {"ply": read_ply, "obj": _read_obj, "off": _read_off}[form](data)
    except BadMesh as error:
        raise BadMesh(f"{path}: {error}") from None
    check_arrays(str(path), vertices, faces, check_unused=False)
    return vertices, faces.astype(np.int32)


def mesh_suffix(name: str) -> str | None:
    """The one of `MESH_SUFFIXES` that a file name ends in, or None."""
    return next((suffix for suffix in MESH_SUFFIXES if name.lower().endswith(suffix)), None)


def mesh_stem(name: str) -> str:
    """A mesh file's name without its suffix: "mesh000" for "mesh000.ply.gz"."""
    return name[: len(name) - len(mesh_suffix(name) or "")]


def preferred(names: Sequence[str]) -> str:
    """Choose the file to read among several of one mesh, by the order of `MESH_SUFFIXES`."""
    return min(names, key=lambda name: (MESH_SUFFIXES.index(mesh_suffix(name) or ""), name))


def _contents(path: Path, packed: bool) -> bytes:
    try:
        data = contents(path, packed, LARGEST_BYTES)
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise BadMesh(f"{path} is not a whole gzip file: {error}") from error
    except OSError as error:
        raise BadMesh(f"cannot read {path}: {error.strerror or error}") from error
    if data is None:
        raise BadMesh(f"{path}: a mesh file may hold {LARGEST_BYTES >> 20} MiB, found more")
    return data


def _read_obj(data: bytes) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Parse Wavefront OBJ: lines "v x y z ..." and "f a b c ..." (or "a/t/n"), with indices from 1, or back from -1."""
    vertices: list[list[float]] = []
    faces: list[tuple[int, int, int]] = []
    text = data.decode("latin-1")
    if "\\" in text:  # continued lines become one, numbered as the last of them
        text = re.sub(r"\\[ \t]*\r?\n", " ", text)
    for number, line in enumerate(text.split("\n"), 1):
        kind, *words = line.split() or ("",)
        if kind not in ("v", "f"):
            continue
        try:
            if len(words) < 3:
                raise ValueError(f"three numbers must follow {kind!r}, found {len(words)}")
            if kind == "v":
                vertices.append([float(words[0]), float(words[1]), float(words[2])])
            else:
                faces += fan([_from_one(int(word.partition("/")[0]), len(vertices)) for word in words])
        except ValueError as error:
            raise BadMesh(f"line {number} is not OBJ: {error}") from error
    return _arrays(vertices, faces)


def _from_one(index: int, count: int) -> int:
    """Convert an OBJ index to one from 0; negative ones count back from the last of `count` vertices so far."""
    if index > 0:
        return index - 1
    if not 0 < -index <= count:
        raise ValueError(f"a corner must be a vertex, found {index} after {count} vertices")
    return count + index


def _read_off(data: bytes) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Parse the Object File Format in text: header, counts, a vertex a line, a polygon a line; # begins a comment."""
    lines = [
        (number, line)
        for number, full in enumerate(data.decode("latin-1").split("\n"), 1)
        if (line := full.partition("#")[0].strip())
    ]
    header = _OFF_HEADER.match(lines[0][1]) if lines else None
    if header is None:
        raise BadMesh(f"an OFF file must begin with OFF, found {lines[0][1][:20]!r}" if lines else "the file is empty")
    rest = lines[0][1][header.end() :].strip()
    lines = [(lines[0][0], rest), *lines[1:]] if rest else lines[1:]
    number, counts = lines[0] if lines else (1, "")
    if not re.fullmatch(r"\d{1,15}\s+\d{1,15}(\s+\d+)?", counts):
        raise BadMesh(f"line {number}: the counts of vertices and faces must follow OFF, found {counts[:20]!r}")
    vertex_count, face_count = map(int, counts.split()[:2])
    if vertex_count + face_count > len(lines) - 1:
        raise BadMesh(
            f"the header announces {vertex_count} vertices and {face_count} faces, found {len(lines) - 1} lines"
        )
    vertices: list[list[float]] = []
    faces: list[tuple[int, int, int]] = []
    for row, (number, line) in enumerate(lines[1 : 1 + vertex_count + face_count]):
        words = line.split()
        try:
            if row < vertex_count:
                x, y, z = words[:3]
                vertices.append([float(x), float(y), float(z)])
                continue
            corners = [int(word) for word in words[1 : 1 + int(words[0])]]
            if int(words[0]) < 3 or len(corners) < int(words[0]):
                raise ValueError(f"a face needs three corners and as many as it says, found {line[:40]!r}")
            faces += fan(corners)
        except ValueError as error:
            raise BadMesh(f"line {number} is not OFF: {error}") from error
    return _arrays(vertices, faces)


def _arrays(
    vertices: list[list[float]], faces: list[tuple[int, int, int]]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    try:
        return np.array(vertices, np.float64).reshape(-1, 3), np.array(faces, np.int64).reshape(-1, 3)
    except OverflowError as error:
        raise BadMesh(f"a corner is no vertex: {error}") from error
