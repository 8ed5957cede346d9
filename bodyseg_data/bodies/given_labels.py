"""Labels that a mesh brings along: of its vertices or polygons, by names, numbers, lists of vertices or colours.

Every triangle gets a name at each of its three corners, before vertices are joined; `SceneMesh` says what a point
between them has. A name is a class by classes.json.
"""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from tokenize import TokenError
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig, BadMesh, reported
from bodyseg_data.files import read_json, refuse_special, without_doubles
from bodyseg_data.labels import BACKGROUND, UNLABELLED, Classes, classes_from_json
from bodyseg_data.meshes import MeshContent

_NAMES: Final = "label", "labels", "class", "class_id", "classification", "category", "category_id", "semantic"
LABEL_PROPERTIES: Final = (*_NAMES, *(f"scalar_{name}" for name in _NAMES))
"""Properties of a PLY file that hold labels, in lower case; of several, the first."""

NO_CLASS: Final = (-1, UNLABELLED, BACKGROUND)
"""Numbers that mark a surface without a class, unless a class is numbered so."""

NAMING: Final = ("groups", "nodes", "objects", "materials")
"""What names polygons in mesh files."""

_CHANNELS: Final = ("red", "green", "blue")


class ClassTable:
    """The content of classes.json in a folder; without it, every name is a class of its own.

    classes: of the set, None without the file. numbers: number -> name. colours: "#rrggbb" -> name. labels: where they
    are read from, as `file_labels` takes it. Raises BadConfig, naming the file.
    """

    def __init__(self, folder: Path) -> None:
        self.classes: Classes | None = None
        self.numbers: dict[int, str] = {}
        self.colours: dict[str, str] = {}
        self.labels: str | None = None
        self._also: list[tuple[str, str | None]] = []
        self.path = folder / "classes.json"
        if not self.path.exists():
            return
        tree = read_json(self.path)
        self._also += [(each, None) for each in _patterns(tree.pop("unlabelled", []), f"{self.path}: 'unlabelled'")]
        if "labels" in tree:
            (self.labels,) = _texts([tree.pop("labels")], f"{self.path}: 'labels'")
        given = tree.get("classes")
        rows = [{"name": row} if isinstance(row, str) else row for row in given] if isinstance(given, list) else []
        for at, row in enumerate(rows):
            if not isinstance(row, dict) or not isinstance(row.get("name"), str):
                raise BadConfig(f"{self.path}: a class is a name, or an object with one, found {row!r:.60}")
            number = row.pop("number", at)
            if type(number) is not int or number in self.numbers:
                raise BadConfig(f"{self.path}: the 'number' of {row['name']!r} must be whole and its own: {number!r}")
            self.numbers[number] = row["name"]
            self._also += [(each, row["name"]) for each in _patterns(row.pop("also", []), f"{self.path}: 'also'")]
        tree = {"name": folder.name or "labelled", **tree, "classes": rows}
        self.classes = classes_from_json(tree, str(self.path), of_pairs=True)
        entries = self.classes.entries
        colours = [entry.colour for entry in entries]  # a colour of two classes tells neither of them
        self.colours = {each.colour: each.name for each in entries if each.colour and colours.count(each.colour) < 2}

    def knows(self, name: str) -> bool:
        """True if classes.json says of which class a name is, or that it is of none."""
        of_class = self.classes is not None and name in self.classes.names
        return of_class or any(fnmatchcase(name, pattern) for pattern, _ in self._also)

    def class_of(self, name: str, where: str) -> str | None:
        """The class that a name stands for, None for none. Raises BadMesh for one that classes.json does not know."""
        if self.classes is None or name in self.classes.names:
            return name
        for pattern, found in self._also:
            if fnmatchcase(name, pattern):
                return found
        raise BadMesh(f"{where}: {name!r} is no class of {self.path}, and neither in 'also' nor in 'unlabelled'")


@dataclass(frozen=True)
class NamedCorners:
    """Names at the corners of triangles. corners: int64 [F, 3], index in `names`, -1 for none. notes: for the owner."""

    names: tuple[str, ...]
    corners: NDArray[np.int64]
    notes: tuple[str, ...] = ()


def labels_of_parts(parts: Mapping[str, Any], content: MeshContent, where: str) -> NamedCorners:
    """Labels from lists of vertices by name, as SMPL's parts are published: {"head": [0, 1, ...], ...}.

    A triangle is of the first part that holds all of its corners; the others get those of their corners, each the first
    that holds it: published parts share the vertices of their borders. Raises BadMesh, naming `where`, for what is no
    list of vertices of the mesh.
    """
    count = len(content.vertices)
    of_vertex = np.full(count, -1, np.int64)
    of_face = np.full(len(content.faces), -1, np.int64)
    shared = 0
    for number, (name, given) in enumerate(parts.items()):
        if not isinstance(given, list) or {*map(type, given)} - {int}:
            raise BadMesh(f"{where}: the part {name!r} must be a list of vertices, whole numbers, found {given!r:.40}")
        outside = [vertex for vertex in (min(given, default=0), max(given, default=0)) if not 0 <= vertex < count]
        if outside:
            raise BadMesh(f"{where}: the part {name!r} must hold vertices 0 to {count - 1}, found {outside[0]}")
        member = np.zeros(count, np.bool_)
        member[given] = True
        shared += int((member & (of_vertex >= 0)).sum())
        of_vertex[member & (of_vertex < 0)] = number
        of_face[member[content.faces].all(axis=1) & (of_face < 0)] = number
    corners = of_vertex[content.faces]
    corners[of_face >= 0] = of_face[of_face >= 0, None]
    notes = (f"{shared} vertices are in two parts: their triangles go by all three corners",) if shared else ()
    return NamedCorners(tuple(parts), corners, notes)


def labels_of_numbers(
    values: NDArray[Any], content: MeshContent, table: Mapping[int, str], where: str, of: str = ""
) -> NamedCorners:
    """Labels from a number for each vertex or polygon. values: whole numbers [V], [P] or [F].

    table: number -> name. of: "vertices" or "faces"; "" tells it by the count. Raises BadMesh, naming `where`, for
    another count, one that both have, numbers that are not whole, a number of no class, or an empty table.
    """
    if not table:
        raise BadMesh(f"{where}: labels are numbers: classes.json must name the classes, in their order")
    found = np.asarray(values)
    if found.ndim == 2 and 1 in found.shape:
        found = found.ravel()
    with np.errstate(invalid="ignore"):
        numbers = found.astype(np.int64) if found.ndim == 1 and found.dtype.kind in "iuf" else None
    if numbers is None or not np.array_equal(numbers, found):
        raise BadMesh(f"{where}: labels must be whole numbers in one row, found {found.dtype} {found.shape}")
    corners = _at_corners(numbers, content, where, of)
    names = tuple(table.values())
    place = {number: at for at, number in enumerate(table)}
    distinct, index = np.unique(corners, return_inverse=True)
    unknown = [number for number in distinct.tolist() if number not in place and number not in NO_CLASS]
    if unknown:
        known = f"{min(table)} to {max(table)}"
        raise BadMesh(f"{where}: labels must be numbers of classes, {known}, found {unknown[0]}")
    coded = np.array([place.get(number, -1) for number in distinct.tolist()], np.int64)
    return NamedCorners(names, coded[index.reshape(corners.shape)])


def _at_corners(numbers: NDArray[np.int64], content: MeshContent, where: str, of: str) -> NDArray[np.int64]:
    """Numbers of vertices or polygons at the corners of triangles, [F, 3]."""
    vertices, polygons, triangles = len(content.vertices), int(content.polygon[-1]) + 1, len(content.faces)
    counts = {"vertices": (vertices,), "faces": (polygons, triangles)}
    fits = [kind for kind, sizes in counts.items() if len(numbers) in sizes and of in ("", kind)]
    if not fits:
        what = f"{vertices} vertices" if of == "vertices" else f"{polygons} faces"
        both = f"{vertices} vertices or {polygons} faces"
        why = "a program that splits vertices along seams of textures changes their number and order"
        rule = f"there must be one label for each of the mesh's {what if of else both}"
        raise BadMesh(f"{where}: {rule}, found {len(numbers)} ({why})")
    if len(fits) == 2:
        raise BadMesh(f"{where}: {len(numbers)} vertices and as many faces: call it vertex_labels or face_labels")
    if fits[0] == "vertices":
        return numbers[content.faces]
    of_triangle = numbers if len(numbers) != polygons else numbers[content.polygon]
    return np.repeat(of_triangle[:, None], 3, axis=1)


def labels_of_colours(content: MeshContent, table: Mapping[str, str], where: str) -> NamedCorners:
    """Labels from colours of polygons or, without those, of vertices. table: "#rrggbb" -> name.

    Raises BadMesh, naming `where`, for a mesh without colours, or a colour of no class, such as a blend of two.
    """
    of, columns = _having(content, _CHANNELS)
    if not of:
        raise BadMesh(f"{where}: labels by colour need colours of vertices or faces, found none")
    channels = np.stack([columns[name] for name in _CHANNELS], axis=1)
    if channels.dtype.kind == "f" and channels.max(initial=0.0) <= 1.0:
        channels = channels * 255
    values = np.rint(channels).astype(np.int64) @ np.array([1 << 16, 1 << 8, 1])
    known = {int(colour[1:], 16): name for colour, name in table.items()}
    for rgb in np.unique(values).tolist():
        if rgb not in known:
            at = int(np.flatnonzero(values == rgb)[0])
            raise BadMesh(f"{where}: the colour #{rgb:06x}, of number {at} of {of}, is no class's (blended? linear?)")
    return labels_of_numbers(values, content, known, where, of)


def labels_from_file(path: Path, content: MeshContent, table: Mapping[int, str]) -> NamedCorners:
    """Labels of a mesh from a file: .npy, or .json with lists of vertices by name or one list of numbers or names.

    table: number -> name. The names "face_labels" and "vertex_labels" of a file say whose labels it holds. Raises
    BadMesh, naming the file, for one that cannot be read, or labels that do not fit the mesh.
    """
    if content.nodes > 1:
        rule = "a file of labels goes with a mesh of one node, as nothing says in which order several count"
        raise BadMesh(f"{path}: {rule}, found {content.nodes}: join them, or let names of nodes be the labels")
    said = {"faces": "face_labels", "vertices": "vertex_labels"}
    of = next((of for of, name in said.items() if re.search(f"(?<![a-z]){name}", path.name.lower())), "")
    what = f"cannot read the labels {path}"
    with reported(what, BadMesh, OSError, ValueError, EOFError, RecursionError, SyntaxError, TokenError):
        refuse_special(path)
        if path.suffix.lower() == ".npy":
            given: Any = np.load(path, mmap_mode="r", allow_pickle=False)  # takes no memory for a size that it claims
        else:
            given = json.loads(path.read_bytes(), object_pairs_hook=without_doubles)
    if isinstance(given, dict):
        return labels_of_parts(given, content, str(path))
    if isinstance(given, list) and given and all(isinstance(each, str) for each in given):
        place = {name: at for at, name in enumerate(dict.fromkeys(given))}
        table, given = dict(enumerate(place)), [place[name] for name in given]
    if not isinstance(given, np.ndarray) and (not isinstance(given, list) or {*map(type, given)} != {int}):
        raise BadMesh(f"{path}: labels must be lists of vertices by name, or one list of numbers or of names")
    return labels_of_numbers(np.asarray(given), content, table, str(path), of)


def file_labels(content: MeshContent, wanted: str | None, table: ClassTable, where: str) -> NamedCorners:
    """Labels that stand in the mesh's own file.

    wanted: "groups", "objects", "materials", "nodes", "colours", or "property NAME"; None: the first that is there of
    a property that holds labels, names of polygons, and colours. Raises BadMesh, naming `where`, if there are none.
    """
    kind, _, name = (wanted or "").partition(" ")
    if wanted is not None and kind not in (*NAMING, "colours", "property"):
        raise BadMesh(f"{where}: 'labels' are a file, {', '.join(NAMING)}, colours or property NAME, found {wanted!r}")
    for column in (name.lower(),) if name else LABEL_PROPERTIES if kind in ("", "property") else ():
        of, columns = _having(content, (column,))
        if of:
            return labels_of_numbers(columns[column], content, table.numbers, f"{where}: property {column!r}", of)
    used = {each: {own.names[at] for at in np.unique(own.numbers) if at >= 0} for each, own in content.names.items()}
    naming = [each for each in NAMING if used.get(each) and kind in ("", each)]
    if naming:
        fitting = [each for each in naming if all(map(table.knows, used[each]))]
        several = [each for each in naming if len(used[each]) > 1]
        given = content.names[(*fitting, *several, *naming)[0]]
        return NamedCorners(given.names, np.repeat(given.numbers[content.polygon][:, None], 3, axis=1))
    if kind == "colours" or (not kind and table.colours and _having(content, _CHANNELS)[0]):
        return labels_of_colours(content, table.colours, where)
    if wanted is not None:
        raise BadMesh(f"{where}: labels were asked for by {wanted!r}, the file has none")
    why = "files of this kind hold none" if where.lower().endswith((".stl", ".off")) else "the file holds none"
    if _having(content, _CHANNELS)[0]:
        why = "its colours are labels only where classes.json gives classes colours"
    ways = "put a .labels.json or .labels.npy beside it, or give its 'class' in scene.json"
    raise BadMesh(f"{where}: a mesh needs labels, {why}: {ways}")


def _having(content: MeshContent, names: Sequence[str]) -> tuple[str, dict[str, NDArray[Any]]]:
    """Columns with all of the names, and whether they are of "faces" or "vertices"; "" and none if neither has all."""
    for of, columns in (("faces", content.of_polygons), ("vertices", content.of_vertices)):
        if all(name in columns for name in names):
            return of, {name: np.asarray(columns[name]) for name in names}
    return "", {}


def _texts(given: Any, where: str) -> list[str]:
    if not isinstance(given, list) or not all(isinstance(each, str) for each in given):
        raise BadConfig(f"{where} must be a list of names, found {given!r:.60}")
    return given


def _patterns(given: Any, where: str) -> list[str]:
    """Names as patterns of `fnmatch`, in which brackets stand for themselves: CAD programs write bolt[1]."""
    return [each.replace("[", "[[]") for each in _texts(given, where)]
