"""Triangle meshes from .ply, .obj and .off files, each also with .gz behind it, in the order of the file.

Landmarks name vertices by index, so no vertex may be merged, split at a texture seam or left out. General mesh
libraries do one of these, or trust the counts in a header.

A .ply file is text or binary of either byte order. Its header lists elements, each with a count and its properties; the
rows follow in that order. Properties may be lists, so rows may differ in length; rows of equal length, as in nearly all
files (triangles only), are read in one call.
"""

import gzip
import re
import struct
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadMesh, BodysegError, reported
from bodyseg_data.files import contents
from bodyseg_data.meshes.mesh import check_arrays, face_normals

_TYPES: Final = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
_ORDERS: Final = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_CORNERS: Final = ("vertex_indices", "vertex_index")
_LONGEST_HEADER: Final = 1 << 16

_LAST_LINE: Final = re.compile(rb"^[ \t]*end_header[ \t\r]*\n", re.MULTILINE)

Vertices = list[list[float]]
Polygons = list[list[int]]
Faces = NDArray[np.int64]

MESH_SUFFIXES: Final = (".ply", ".obj", ".off", ".ply.gz", ".obj.gz", ".off.gz")
"""Suffixes of mesh files, in upper or lower case; of several files of one mesh, the first in this order is read."""

LARGEST_BYTES: Final = 1 << 28
"""Largest size of a mesh file, also after unpacking: a scan of a million triangles has a tenth of it."""

_FOLD: Final = 1e-4  # share of a polygon's area that a triangle folds back; less is rounding, as of quads of 2 cm

_OFF_HEADER: Final = re.compile(r"(?:ST|C|N)*OFF\b|OFF(?=\d)")

OBJ_NAMES: Final = {"g": "groups", "o": "objects", "usemtl": "materials"}
"""Word that begins a line of an OBJ file -> what it names: the faces that follow, up to the next such line."""


@dataclass(frozen=True)
class FaceNames:
    """Names that a mesh file gives its polygons. numbers: int64 [P], index of each polygon's in `names`; -1: none."""

    names: tuple[str, ...]
    numbers: NDArray[np.int64]


def face_names(names: Sequence[str], counts: Any) -> FaceNames:
    """Names of runs of polygons, "" for none. counts: of the polygons of each run."""
    place = {name: at for at, name in enumerate(dict.fromkeys(filter(None, names)))}
    return FaceNames(tuple(place), np.repeat([place.get(name, -1) for name in names], counts))


@dataclass(frozen=True)
class MeshContent:
    """Everything in a mesh file in which labels may stand.

    vertices: float64 [V, 3]; faces: int32 [F, 3], in the file's order, units and axes. polygon: int64 [F], of which of
    the file's P polygons each triangle is a part. of_vertices, of_polygons: numbers by their name in the file, in lower
    case, [V] or [P]. names: by kind, "groups", "objects", "materials" or "nodes". nodes: number of those of a glTF
    file that it is joined of, in the file's order, which a file of labels need not follow.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]
    polygon: NDArray[np.int64]
    of_vertices: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    of_polygons: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    names: Mapping[str, FaceNames] = field(default_factory=dict)
    nodes: int = 1


@dataclass
class _Parsed:
    """Content of a file: vertices, polygons, and what it says of them: numbers, and names."""

    vertices: Any = ()
    polygons: Any = ()
    of_vertices: dict[str, NDArray[Any]] = field(default_factory=dict)
    of_polygons: dict[str, NDArray[Any]] = field(default_factory=dict)
    names: dict[str, list[tuple[int, str]]] = field(default_factory=dict)  # kind -> first polygon, name


@dataclass(frozen=True)
class _Property:
    """A property. kind: NumPy's code of its type. length: code of the type of a list's length, None if not a list."""

    name: str
    kind: str
    length: str | None = None


@dataclass(frozen=True)
class _Element:
    """An element: as many rows as `count`, each with a value or a list of every property."""

    name: str
    count: int
    properties: list[_Property]

    def index(self, *names: str) -> int:
        """Index of the property that has one of these names. Raises BadMesh without one."""
        for index, prop in enumerate(self.properties):
            if prop.name in names:
                return index
        raise BadMesh(f"the element {self.name!r} must have the property {names[0]!r}")

    def has_lists(self) -> bool:
        return any(prop.length is not None for prop in self.properties)

    def numbers(self, columns: Sequence[Any]) -> dict[str, NDArray[Any]]:
        """The properties that are no lists, by name in lower case; of a text, all were read as fractions."""
        pairs = [(own, np.ravel(each)) for own, each in zip(self.properties, columns, strict=True) if not own.length]
        return {own.name.lower(): each if own.kind[0] == "f" else each.astype(np.int64) for own, each in pairs}

    def truncated(self, found: int) -> BadMesh:
        return BadMesh(f"the header announces {self.count} rows of {self.name!r}, the file ends after {found}")


def _read_ply(data: bytes) -> _Parsed:
    """Parse a PLY file, in its order. Raises BadMesh for one that is none or holds less than its header announces."""
    order, elements, start = _header(data)
    columns = _from_text(data, start) if not order else _from_bytes(data, start, order)
    parsed = _Parsed()
    for element in elements:
        if element.name == "vertex":
            if element.has_lists():
                raise BadMesh("the element 'vertex' must have no lists")
            axes = [element.index(axis) for axis in "xyz"]
            values = columns(element)
            parsed.vertices = np.stack([np.asarray(values[axis], np.float64) for axis in axes], axis=1)
            parsed.of_vertices = element.numbers(values)
        elif element.name == "face":
            corners = element.properties[element.index(*_CORNERS)]
            if corners.length is None or corners.kind[0] == "f":
                raise BadMesh(f"the property {corners.name!r} must be a list of whole numbers")
            values = columns(element)
            parsed.polygons = values[element.properties.index(corners)]
            parsed.of_polygons = element.numbers(values)
        else:
            columns(element)
    return parsed


def _header(data: bytes) -> tuple[str, list[_Element], int]:
    """The byte order ("" for text), the elements, and the offset of the first row, bytes."""
    if not data.startswith((b"ply\n", b"ply\r\n")):
        raise BadMesh(f"a PLY file must begin with 'ply', found {data[:8]!r}" if data else "the file is empty")
    last = _LAST_LINE.search(data, 0, _LONGEST_HEADER)
    if last is None:
        raise BadMesh("the header must end with a line 'end_header', found none")
    order: str | None = None
    elements: list[_Element] = []
    for number, line in enumerate(data[: last.start()].decode("latin-1").split("\n"), 1):
        match line.split():
            case ["format", name, "1.0"] if name in _ORDERS:
                order = _ORDERS[name]
            case ["element", name, count] if count.isascii() and count.isdigit() and len(count) < 16:
                elements.append(_Element(name, int(count), []))
            case ["property", "list", length, kind, name] if elements and {length, kind} <= set(_TYPES):
                if _TYPES[length][0] == "f":
                    raise BadMesh(f"line {number} of the header: a list's length must be whole, found {line.strip()!r}")
                elements[-1].properties.append(_Property(name, _TYPES[kind], _TYPES[length]))
            case ["property", kind, name] if elements and kind in _TYPES:
                elements[-1].properties.append(_Property(name, _TYPES[kind]))
            case [] | ["ply"] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise BadMesh(f"line {number} of the header is not PLY: {line.strip()[:60]!r}")
    if order is None:
        raise BadMesh("the header must name the format")
    bare = [element.name for element in elements if element.count and not element.properties]
    if bare:
        raise BadMesh(f"the element {bare[0]!r} must have properties")
    return order, elements, last.end()


def _from_text(data: bytes, start: int) -> Callable[[_Element], list[list[Any]]]:
    """A function that reads the next element of a text, one row a line: for every property its values or lists."""
    lines = enumerate(data[start:].decode("latin-1").split("\n"), data.count(b"\n", 0, start) + 1)
    rows = ((line, words) for line, text in lines if (words := text.split()))  # empty lines do not count

    def columns(element: _Element) -> list[list[Any]]:
        found: list[list[Any]] = [[] for _ in element.properties]
        for row in range(element.count):
            line, words = next(rows, (0, None))
            if words is None:
                raise element.truncated(row)
            if not element.has_lists() and len(words) != len(found):
                raise BadMesh(f"line {line}: {len(found)} numbers must stand here, found {len(words)}")
            left = iter(words)
            try:
                for prop, column in zip(element.properties, found, strict=True):
                    number = float if prop.kind[0] == "f" or prop.length is None else int
                    if prop.length is None:
                        column.append(number(next(left)))
                    else:
                        column.append([number(next(left)) for _ in range(int(next(left)))])
            except StopIteration:
                raise BadMesh(f"line {line}: a row must hold all that its lists announce") from None
            except ValueError as error:
                raise BadMesh(f"line {line}: {error}") from error
        return found

    return columns


def _from_bytes(data: bytes, start: int, order: str) -> Callable[[_Element], list[Any]]:
    """A function that reads the next element of a binary file, as `_from_text`, or arrays where all rows are alike."""
    position = start

    def take(kind: str, count: int) -> tuple[Any, ...]:
        nonlocal position
        form = f"{order}{count}{np.dtype(kind).char}"  # NumPy's letter of a type is that of `struct`
        values = struct.unpack_from(form, data, position)
        position += struct.calcsize(form)
        return values

    def row(element: _Element, number: int) -> list[tuple[Any, ...]]:
        try:
            return [take(each.kind, take(each.length, 1)[0] if each.length else 1) for each in element.properties]
        except struct.error:
            raise element.truncated(number) from None

    def columns(element: _Element) -> list[Any]:
        nonlocal position
        begin = position
        if not element.count:
            return [[] for _ in element.properties]
        first = row(element, 0)
        lengths = {index: len(first[index]) for index, prop in enumerate(element.properties) if prop.length is not None}
        fields: list[tuple[Any, ...]] = []
        for index, prop in enumerate(element.properties):
            if prop.length is not None:
                fields.append((f"length {index}", order + prop.length))
            fields.append((str(index), order + prop.kind, (lengths[index],) if index in lengths else ()))
        size = np.dtype(fields).itemsize
        fit = min((len(data) - begin) // size, element.count)
        table = np.frombuffer(data, np.dtype(fields), fit, begin)
        if fit == element.count and all((table[f"length {index}"] == each).all() for index, each in lengths.items()):
            position = begin + table.nbytes
            return [table[str(index)] for index in range(len(element.properties))]
        if not lengths:
            raise element.truncated(fit)
        rows = [first, *(row(element, number) for number in range(1, element.count))]
        return list(zip(*rows, strict=True))

    return columns


def _triangles(polygons: Any) -> Faces:
    """Split polygons, lists of corners or an array [N, corners], into triangles about their first corners."""
    if isinstance(polygons, np.ndarray) and polygons.shape[1] >= 3:
        fans = [polygons[:, [0, i, i + 1]].astype(np.int64) for i in range(1, polygons.shape[1] - 1)]
        return np.stack(fans, axis=1).reshape(-1, 3)
    triangles: list[tuple[int, int, int]] = []
    for number, corners in enumerate(polygons):
        if len(corners) < 3:
            raise BadMesh(f"a face needs three corners, found {len(corners)} at face {number}")
        triangles += [(corners[0], corners[i], corners[i + 1]) for i in range(1, len(corners) - 1)]
    with reported("a corner is no vertex", BadMesh, OverflowError):
        return np.array(triangles, np.int64).reshape(-1, 3)


def _unfolded(vertices: NDArray[np.float64], faces: Faces, polygon: Faces) -> Faces:
    """The triangles [F, 3] of polygons, with ears cut off where a fan folds, as that of an L or of a wall with a door.

    polygon: int64 [F], of which polygon each triangle is a part.
    """
    normals = face_normals(vertices, faces)
    whole = np.stack([np.bincount(polygon, axis) for axis in normals.T], axis=1)
    against = -np.einsum("ij,ij->i", normals, whole[polygon])
    for number in np.unique(polygon[against > _FOLD * (whole**2).sum(axis=1)[polygon]]).tolist():
        rows = slice(*np.searchsorted(polygon, [number, number + 1]))
        corners = np.array([faces[rows.start, 0], *faces[rows, 1], faces[rows.stop - 1, 2]])
        axis = int(np.abs(whole[number]).argmax())
        seen = vertices[corners][:, [(axis + 1) % 3, (axis + 2) % 3]]
        faces[rows] = corners[_ears((seen if whole[number, axis] > 0 else seen[:, ::-1]).tolist())]
    return faces


def _ears(points: list[list[float]]) -> list[tuple[int, int, int]]:
    """Cut a polygon, points [x, y] anticlockwise, into triangles (Meisters, Polygons have ears, 1975)."""

    def area(a: int, b: int, c: int) -> float:
        (x, y), (bx, by), (cx, cy) = points[a], points[b], points[c]
        return (bx - x) * (cy - y) - (by - y) * (cx - x)

    def is_ear(at: int, slack: float) -> bool:
        a, b, c = ring[at - 1], ring[at], ring[(at + 1) % len(ring)]
        inside = (area(c, a, p) >= -slack for p in concave if area(a, b, p) > 0 and area(b, c, p) > 0)
        return points[b] == points[c] or (area(a, b, c) > 0 and not any(inside))

    ring, ears, at = list(range(len(points))), [], 0
    rounding = 1e-12 * sum(area(0, b - 1, b) for b in ring)
    concave = [b for b in ring if area(b - 1, b, (b + 1) % len(ring)) <= rounding]
    while len(ring) > 2:
        around = [(at + step) % len(ring) for step in range(len(ring))]
        # No cut may pass through a corner, such as that of the next door, unless rounding leaves no other cut.
        cuts = (each for slack in (rounding, 0.0, -rounding) for each in around if is_ear(each, slack))
        at = next(cuts, around[0])
        ears.append((ring[at - 1], ring[at], ring[(at + 1) % len(ring)]))
        del ring[at]
    return ears


def read_mesh(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Read vertices float64 [V, 3] and triangles int32 [F, 3], both in the file's order, units and axes.

    Polygons become fans about their first corner, or other triangles where these would lie outside. Colours, normals
    and textures are ignored.
    Raises BadMesh, naming the file and, for text, the line, for a file that cannot be read, is truncated, is larger
    than `LARGEST_BYTES`, has no vertices or faces, or has faces with missing or non-finite vertices.
    """
    content = read_mesh_content(path)
    return content.vertices, content.faces


def read_mesh_content(path: Path) -> MeshContent:
    """Read a mesh file with all in which labels may stand. Raises BadMesh, as `read_mesh` does."""
    suffix = mesh_suffix(path.name)
    if suffix is None:
        raise BadMesh(f"a mesh file's name must end in {', '.join(MESH_SUFFIXES)}, found {path}")
    data = file_bytes(path, "mesh", LARGEST_BYTES, BadMesh)
    form = suffix.removesuffix(".gz")[1:]
    with reported(path, BadMesh):
        parsed = {"ply": _read_ply, "obj": _read_obj, "off": _read_off}[form](data)
        vertices, faces = np.array(parsed.vertices, np.float64).reshape(-1, 3), _triangles(parsed.polygons)
    check_arrays(str(path), vertices, faces, check_unused=False)
    count = len(parsed.polygons)
    polygon = np.repeat(np.arange(count), [len(corners) - 2 for corners in parsed.polygons])
    if len(faces) > count:
        faces = _unfolded(vertices, faces, polygon)
    names = {}
    for kind, runs in parsed.names.items():
        starts, own = zip(*runs, strict=True)
        names[kind] = face_names(["", *own], np.diff([0, *starts, count]))
    return MeshContent(vertices, faces.astype(np.int32), polygon, parsed.of_vertices, parsed.of_polygons, names)


def mesh_suffix(name: str, suffixes: Sequence[str] = MESH_SUFFIXES) -> str | None:
    """The one of `suffixes` that a file name ends in, or None."""
    return next((suffix for suffix in suffixes if name.lower().endswith(suffix)), None)


def mesh_stem(name: str, suffixes: Sequence[str] = MESH_SUFFIXES) -> str | None:
    """A mesh file's name without its suffix: "mesh000" for "mesh000.ply.gz"; None for a file that is no mesh's."""
    suffix = mesh_suffix(name, suffixes)
    return None if suffix is None else name[: -len(suffix)]


def preferred(names: Sequence[str], suffixes: Sequence[str] = MESH_SUFFIXES) -> str:
    """Choose the file to read among several of one mesh, by the order of `suffixes`."""
    return min(names, key=lambda name: (suffixes.index(mesh_suffix(name, suffixes) or ""), name))


def file_bytes(path: Path, kind: str, limit: int, error: type[BodysegError]) -> bytes:
    """Read a file of a kind, unpacked if its name ends in .gz.

    Raises `error`, naming the file, for one that cannot be read, is no whole gzip file, or holds more than `limit`.
    """
    try:
        data = contents(path, path.suffix.lower() == ".gz", limit)
    except (EOFError, zlib.error, gzip.BadGzipFile) as fault:
        raise error(f"{path} is not a whole gzip file: {fault}") from fault
    except OSError as fault:
        raise error(f"cannot read {path}: {fault.strerror or fault}") from fault
    if data is None:
        raise error(f"{path}: a {kind} file may hold {limit >> 20} MiB, found more")
    return data


def _read_obj(data: bytes) -> _Parsed:
    """Parse Wavefront OBJ: lines "v x y z ..." and "f a b c ..." (or "a/t/n"), with indices from 1, or back from -1.

    Of the names that lines give to faces, those of `OBJ_NAMES` are kept; colours may follow a vertex's coordinates.
    """
    vertices: Vertices = []
    polygons: Polygons = []
    colours: Vertices = []
    names: dict[str, list[tuple[int, str]]] = {}
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:  # names of a program that writes one byte a letter
        text = data.decode("latin-1")
    if "\\" in text:  # continued lines become one, numbered as the last of them
        text = re.sub(r"\\[ \t]*\r?\n", " ", text)
    for number, line in enumerate(text.split("\n"), 1):
        kind, *words = line.split() or ("",)
        if kind not in ("v", "f"):
            if kind in OBJ_NAMES:
                names.setdefault(OBJ_NAMES[kind], []).append((len(polygons), " ".join(words)))
            continue
        try:
            if "#" in line:
                words = line.partition("#")[0].split()[1:]
            if len(words) < 3:
                raise ValueError(f"three numbers must follow {kind!r}, found {len(words)}")
            if kind == "v":
                vertices.append([float(words[0]), float(words[1]), float(words[2])])
                if len(words) >= 6:
                    colours.append([float(words[3]), float(words[4]), float(words[5])])
            else:
                polygons.append([_from_one(int(word.partition("/")[0]), len(vertices)) for word in words])
        except ValueError as error:
            raise BadMesh(f"line {number} is not OBJ: {error}") from error
    channels = dict(zip(("red", "green", "blue"), np.array(colours).T, strict=False))
    return _Parsed(vertices, polygons, channels if len(colours) == len(vertices) else {}, names=names)


def _from_one(index: int, count: int) -> int:
    """Convert an OBJ index to one from 0; negative ones count back from the last of `count` vertices so far."""
    if index > 0:
        return index - 1
    if not 0 < -index <= count:
        raise ValueError(f"a corner must be a vertex, found {index} after {count} vertices")
    return count + index


def _read_off(data: bytes) -> _Parsed:
    """Parse the Object File Format in text: header, counts, a vertex a line, a polygon a line; # begins a comment."""
    numbered = enumerate(data.decode("latin-1").split("\n"), 1)
    lines = [(number, line) for number, full in numbered if (line := full.partition("#")[0].strip())]
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
        counted = f"{vertex_count} vertices and {face_count} faces"
        raise BadMesh(f"the header announces {counted}, found {len(lines) - 1} lines")
    vertices: Vertices = []
    polygons: Polygons = []
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
            polygons.append(corners)
        except ValueError as error:
            raise BadMesh(f"line {number} is not OFF: {error}") from error
    return _Parsed(vertices, polygons)
