"""Triangle meshes from .ply, .obj and .off files, each also with .gz behind it, in the order of the file.

Landmarks name vertices by index, so no vertex may be merged, split at a texture seam or left out. General mesh
libraries do one of these, or trust the counts in a header.

A .ply file is text or binary of either byte order. Its header lists elements, each with a count and its properties; the
rows follow in that order. Properties may be lists, so rows may differ in length; rows of equal length, as in nearly all
files (triangles only), are read in one call.
"""

from __future__ import annotations

import gzip
import re
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadMesh
from bodyseg_data.files import contents
from bodyseg_data.meshes.mesh import check_arrays

_TYPES: Final = {
    name: kind
    for kind, names in {
        "i1": ("char", "int8"),
        "u1": ("uchar", "uint8"),
        "i2": ("short", "int16"),
        "u2": ("ushort", "uint16"),
        "i4": ("int", "int32"),
        "u4": ("uint", "uint32"),
        "f4": ("float", "float32"),
        "f8": ("double", "float64"),
    }.items()
    for name in names
}
_STRUCT_CODES: Final = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I", "f4": "f", "f8": "d"}
_ORDERS: Final = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_CORNERS: Final = ("vertex_indices", "vertex_index")
_LONGEST_HEADER: Final = 1 << 16

Vertices = NDArray[np.float64]
Faces = NDArray[np.int64]

MESH_SUFFIXES: Final = (".ply", ".obj", ".off", ".ply.gz", ".obj.gz", ".off.gz")
"""Suffixes of mesh files, in upper or lower case; of several files of one mesh, the first in this order is read."""

LARGEST_BYTES: Final = 1 << 28
"""Largest size of a mesh file, also after unpacking: a scan of a million triangles has a tenth of it."""

_OFF_HEADER: Final = re.compile(r"(?:ST)?C?N?OFF\b|OFF(?=\d)")


@dataclass(frozen=True)
class _Property:
    """A property. kind: NumPy's code of its type. length: code of the type of a list's length, None if not a list."""

    name: str
    kind: str
    length: str | None


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    properties: tuple[_Property, ...]

    def index(self, *names: str) -> int:
        """Index of the property that has one of these names. Raises BadMesh without one."""
        for index, prop in enumerate(self.properties):
            if prop.name in names:
                return index
        raise BadMesh(f"the element {self.name!r} must have the property {names[0]!r}")

    def has_lists(self) -> bool:
        return any(prop.length is not None for prop in self.properties)


def read_ply(data: bytes) -> tuple[Vertices, Faces]:
    """Parse vertices float64 [V, 3] and triangles int64 [F, 3] of a PLY file, in its order; polygons become fans.

    Raises BadMesh for a file that is not PLY, is truncated or holds less than its header announces.
    """
    order, elements, start = _header(data)
    rows = _TextRows(data, start) if not order else _BinaryRows(data, start, order)
    vertices, faces = np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    for element in elements:
        if element.name == "vertex":
            if element.has_lists():
                raise BadMesh("the element 'vertex' must have no lists")
            vertices = rows.scalars(element, [element.index(axis) for axis in "xyz"])
        elif element.name == "face":
            index = element.index(*_CORNERS)
            if element.properties[index].length is None or element.properties[index].kind[0] == "f":
                raise BadMesh(f"the property {element.properties[index].name!r} must be a list of whole numbers")
            faces = rows.polygons(element, index)
        else:
            rows.skip(element)
    return vertices, faces


def _header(data: bytes) -> tuple[str, list[_Element], int]:
    """The byte order ("" for text), the elements, and the offset of the first row, bytes."""
    if not data.startswith((b"ply\n", b"ply\r\n")):
        raise BadMesh(f"a PLY file must begin with 'ply', found {data[:8]!r}" if data else "the file is empty")
    lines: list[str] = []
    start = 0
    while not lines or lines[-1] != "end_header":
        end = data.find(b"\n", start, _LONGEST_HEADER)
        if end < 0:
            raise BadMesh("the header must end with a line 'end_header', found none")
        lines.append(data[start:end].decode("latin-1").strip())
        start = end + 1
    order: str | None = None
    elements: list[tuple[str, int, list[_Property]]] = []
    for number, line in enumerate(lines, 1):
        match line.split():
            case ["format", name, "1.0"] if name in _ORDERS:
                order = _ORDERS[name]
            case ["element", name, count] if count.isascii() and count.isdigit() and len(count) < 16:
                elements.append((name, int(count), []))
            case ["property", "list", length, kind, name] if elements and {length, kind} <= set(_TYPES):
                if _TYPES[length][0] == "f":
                    raise BadMesh(f"line {number} of the header: a list's length must be whole, found {line!r}")
                elements[-1][2].append(_Property(name, _TYPES[kind], _TYPES[length]))
            case ["property", kind, name] if elements and kind in _TYPES:
                elements[-1][2].append(_Property(name, _TYPES[kind], None))
            case [] | ["ply"] | ["comment" | "obj_info", *_] | ["end_header"]:
                pass
            case _:
                raise BadMesh(f"line {number} of the header is not PLY: {line[:60]!r}")
    if order is None:
        raise BadMesh("the header must name the format")
    bare = [name for name, count, properties in elements if count and not properties]
    if bare:
        raise BadMesh(f"the element {bare[0]!r} must have properties")
    return order, [_Element(name, count, tuple(properties)) for name, count, properties in elements], start


def _truncated(element: _Element, found: int) -> BadMesh:
    return BadMesh(f"the header announces {element.count} rows of {element.name!r}, the file ends after {found}")


def fan(corners: Sequence[int]) -> list[tuple[int, int, int]]:
    """Split a polygon into triangles about its first corner."""
    return [(corners[0], corners[i], corners[i + 1]) for i in range(1, len(corners) - 1)]


def _triangles(polygons: list[list[int]]) -> Faces:
    triangles: list[tuple[int, int, int]] = []
    for number, corners in enumerate(polygons):
        if len(corners) < 3:
            raise BadMesh(f"a face needs three corners, found {len(corners)} at face {number}")
        triangles += fan(corners)
    try:
        return np.array(triangles, np.int64).reshape(-1, 3)
    except OverflowError as error:
        raise BadMesh(f"a corner is no vertex: {error}") from error


class _TextRows:
    """Reader of the rows of a PLY file in text, one a line."""

    def __init__(self, data: bytes, start: int) -> None:
        self._first = data.count(b"\n", 0, start) + 1
        self._lines = data[start:].decode("latin-1").split("\n")
        self._next = 0

    def _take(self, element: _Element) -> list[tuple[int, list[str]]]:
        """(line, words) of every row of an element; empty lines do not count."""
        rows: list[tuple[int, list[str]]] = []
        while len(rows) < element.count:
            if self._next >= len(self._lines):
                raise _truncated(element, len(rows))
            words = self._lines[self._next].split()
            if words:
                rows.append((self._first + self._next, words))
            self._next += 1
        return rows

    def skip(self, element: _Element) -> None:
        self._take(element)

    def scalars(self, element: _Element, indices: list[int]) -> Vertices:
        values = []
        for line, words in self._take(element):
            if len(words) != len(element.properties):
                raise BadMesh(f"line {line}: {len(element.properties)} numbers must stand here, found {len(words)}")
            try:
                values.append([float(words[index]) for index in indices])
            except ValueError as error:
                raise BadMesh(f"line {line}: {error}") from error
        return np.array(values, np.float64).reshape(-1, len(indices))

    def polygons(self, element: _Element, index: int) -> Faces:
        polygons = []
        for line, words in self._take(element):
            position = 0
            try:
                for prop in element.properties[:index]:
                    position += 1 if prop.length is None else 1 + int(words[position])
                corners = [int(word) for word in words[position + 1 : position + 1 + int(words[position])]]
                if len(corners) != int(words[position]):
                    raise ValueError(f"a face of {words[position]} corners must list them, found {len(corners)}")
            except (ValueError, IndexError) as error:
                raise BadMesh(f"line {line}: {error}") from error
            polygons.append(corners)
        return _triangles(polygons)


class _BinaryRows:
    """Reader of the rows of a binary PLY file."""

    def __init__(self, data: bytes, start: int, order: str) -> None:
        self._data, self._position, self._order = data, start, order

    def skip(self, element: _Element) -> None:
        if element.has_lists():
            self._read_lists(element, None)
        else:
            self._read_table(element, {})

    def scalars(self, element: _Element, indices: list[int]) -> Vertices:
        table = self._read_table(element, {})
        return np.stack([table[str(index)].astype(np.float64) for index in indices], axis=1)

    def polygons(self, element: _Element, index: int) -> Faces:
        table = self._regular_table(element)
        if table is None or table[str(index)].shape[1] < 3:
            return _triangles(self._read_lists(element, index))
        self._position += table.nbytes
        corners = table[str(index)].astype(np.int64)
        fans = [corners[:, [0, i, i + 1]] for i in range(1, corners.shape[1] - 1)]
        return np.stack(fans, axis=1).reshape(-1, 3)

    def _read_table(self, element: _Element, lengths: dict[int, int]) -> NDArray[Any]:
        """Rows of an element as a structured array. lengths: of its lists, by property index.

        The position advances only for an element without lists.
        """
        fields: list[tuple[Any, ...]] = []
        for index, prop in enumerate(element.properties):
            if prop.length is not None:
                fields.append((f"length {index}", self._order + prop.length))
                fields.append((str(index), self._order + prop.kind, (lengths[index],)))
            else:
                fields.append((str(index), self._order + prop.kind))
        row = np.dtype(fields)
        fit = (len(self._data) - self._position) // row.itemsize if row.itemsize else 0
        if fit < element.count:
            raise _truncated(element, fit)
        table = np.frombuffer(self._data, row, element.count, self._position)
        if not lengths:
            self._position += table.nbytes
        return table

    def _regular_table(self, element: _Element) -> NDArray[Any] | None:
        """Rows of an element with lists, if all lists are as long as those of the first row; else None."""
        lengths: dict[int, int] = {}
        if not element.count:
            return None
        position = self._position
        for index, prop in enumerate(element.properties):
            if prop.length is not None:
                lengths[index] = self._length(element, prop, position, 0)
                position += np.dtype(prop.length).itemsize
            position += lengths.get(index, 1) * np.dtype(prop.kind).itemsize
        try:
            table = self._read_table(element, lengths)
        except BadMesh:
            return None  # shorter rows may follow
        regular = all((table[f"length {index}"] == length).all() for index, length in lengths.items())
        return table if regular else None

    def _length(self, element: _Element, prop: _Property, position: int, row: int) -> int:
        letter = _STRUCT_CODES[prop.length or ""]
        try:
            length: int = struct.unpack_from(self._order + letter, self._data, position)[0]
        except struct.error:
            raise _truncated(element, row) from None
        if not 0 <= length * np.dtype(prop.kind).itemsize <= len(self._data) - position:
            raise BadMesh(f"a list of {length} in row {row} of {element.name!r} is longer than the file")
        return length

    def _read_lists(self, element: _Element, list_index: int | None) -> list[list[int]]:
        """Read an element row by row; returns the lists of property `list_index` (none for None)."""
        found: list[list[int]] = []
        fields = [(index, prop, np.dtype(prop.kind).itemsize) for index, prop in enumerate(element.properties)]
        for row in range(element.count):
            for index, prop, size in fields:
                length = 1
                if prop.length is not None:
                    length = self._length(element, prop, self._position, row)
                    self._position += np.dtype(prop.length).itemsize
                if self._position + length * size > len(self._data):
                    raise _truncated(element, row)
                if index == list_index:
                    form = f"{self._order}{length}{_STRUCT_CODES[prop.kind]}"
                    found.append(list(struct.unpack_from(form, self._data, self._position)))
                self._position += length * size
        return found


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
