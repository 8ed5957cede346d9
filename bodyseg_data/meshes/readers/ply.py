"""PLY files, text or binary of either byte order: the vertices and faces of one, whatever else it holds.

A header lists elements, each with a count and its properties; the rows follow in that order. Properties may be lists,
so that rows need not be equally long: rows that are (nearly all files have triangles only) are read at once.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadMesh

_KINDS: Final = {
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
_LETTERS: Final = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I", "f4": "f", "f8": "d"}
_ORDERS: Final = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_CORNERS: Final = ("vertex_indices", "vertex_index")
_LONGEST_HEADER: Final = 1 << 16

Vertices = NDArray[np.float64]
Faces = NDArray[np.int64]


@dataclass(frozen=True)
class _Property:
    """kind: NumPy's name of the type; length: that of the type of a list's length, None if it is no list."""

    name: str
    kind: str
    length: str | None


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    properties: tuple[_Property, ...]

    def place(self, *names: str) -> int:
        """Which of the properties has one of these names. Raises BadMesh if none has."""
        for place, its in enumerate(self.properties):
            if its.name in names:
                return place
        raise BadMesh(f"the element {self.name!r} must have the property {names[0]!r}")

    def has_lists(self) -> bool:
        return any(its.length is not None for its in self.properties)


def read_ply(data: bytes) -> tuple[Vertices, Faces]:
    """Vertices float64 [V, 3] and triangles int64 [F, 3] of a PLY file, in its order; polygons become fans.

    Raises BadMesh for a file that is not PLY, is cut short or holds less than its header announces.
    """
    order, elements, start = _header(data)
    rows = _TextRows(data, start) if not order else _BinaryRows(data, start, order)
    vertices, faces = np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    for element in elements:
        if element.name == "vertex":
            if element.has_lists():
                raise BadMesh("the element 'vertex' must have no lists")
            vertices = rows.scalars(element, [element.place(axis) for axis in "xyz"])
        elif element.name == "face":
            place = element.place(*_CORNERS)
            if element.properties[place].length is None or element.properties[place].kind[0] == "f":
                raise BadMesh(f"the property {element.properties[place].name!r} must be a list of whole numbers")
            faces = rows.polygons(element, place)
        else:
            rows.skip(element)
    return vertices, faces


def _header(data: bytes) -> tuple[str, list[_Element], int]:
    """The byte order ("" for text), the elements, and where the rows begin."""
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
            case ["property", "list", length, kind, name] if elements and {length, kind} <= set(_KINDS):
                if _KINDS[length][0] == "f":
                    raise BadMesh(f"line {number} of the header: a list's length must be whole, found {line!r}")
                elements[-1][2].append(_Property(name, _KINDS[kind], _KINDS[length]))
            case ["property", kind, name] if elements and kind in _KINDS:
                elements[-1][2].append(_Property(name, _KINDS[kind], None))
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


def _short(element: _Element, found: int) -> BadMesh:
    return BadMesh(f"the header announces {element.count} rows of {element.name!r}, the file ends after {found}")


def fan(corners: Sequence[int]) -> list[tuple[int, int, int]]:
    """The triangles of a polygon about its first corner."""
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
    """Rows of a PLY file in text: one a line."""

    def __init__(self, data: bytes, start: int) -> None:
        self._first = data.count(b"\n", 0, start) + 1
        self._lines = data[start:].decode("latin-1").split("\n")
        self._next = 0

    def _take(self, element: _Element) -> list[tuple[int, list[str]]]:
        """(line, words) of every row of an element; empty lines do not count."""
        rows: list[tuple[int, list[str]]] = []
        while len(rows) < element.count:
            if self._next >= len(self._lines):
                raise _short(element, len(rows))
            words = self._lines[self._next].split()
            if words:
                rows.append((self._first + self._next, words))
            self._next += 1
        return rows

    def skip(self, element: _Element) -> None:
        self._take(element)

    def scalars(self, element: _Element, places: list[int]) -> Vertices:
        values = []
        for line, words in self._take(element):
            if len(words) != len(element.properties):
                raise BadMesh(f"line {line}: {len(element.properties)} numbers must stand here, found {len(words)}")
            try:
                values.append([float(words[place]) for place in places])
            except ValueError as error:
                raise BadMesh(f"line {line}: {error}") from error
        return np.array(values, np.float64).reshape(-1, len(places))

    def polygons(self, element: _Element, place: int) -> Faces:
        polygons = []
        for line, words in self._take(element):
            at = 0
            try:
                for its in element.properties[:place]:
                    at += 1 if its.length is None else 1 + int(words[at])
                corners = [int(word) for word in words[at + 1 : at + 1 + int(words[at])]]
                if len(corners) != int(words[at]):
                    raise ValueError(f"a face of {words[at]} corners must list them, found {len(corners)}")
            except (ValueError, IndexError) as error:
                raise BadMesh(f"line {line}: {error}") from error
            polygons.append(corners)
        return _triangles(polygons)


class _BinaryRows:
    """Rows of a binary PLY file."""

    def __init__(self, data: bytes, start: int, order: str) -> None:
        self._data, self._at, self._order = data, start, order

    def skip(self, element: _Element) -> None:
        if element.has_lists():
            self._walk(element, None)
        else:
            self._table(element, {})

    def scalars(self, element: _Element, places: list[int]) -> Vertices:
        table = self._table(element, {})
        return np.stack([table[str(place)].astype(np.float64) for place in places], axis=1)

    def polygons(self, element: _Element, place: int) -> Faces:
        table = self._even_table(element)
        if table is None or table[str(place)].shape[1] < 3:
            return _triangles(self._walk(element, place))
        self._at += table.nbytes
        corners = table[str(place)].astype(np.int64)
        fans = [corners[:, [0, i, i + 1]] for i in range(1, corners.shape[1] - 1)]
        return np.stack(fans, axis=1).reshape(-1, 3)

    def _table(self, element: _Element, lengths: dict[int, int]) -> NDArray[Any]:
        """All rows of an element, its lists of the given lengths; moves on only if there are no lists."""
        fields: list[tuple[Any, ...]] = []
        for place, its in enumerate(element.properties):
            if its.length is not None:
                fields.append((f"length {place}", self._order + its.length))
                fields.append((str(place), self._order + its.kind, (lengths[place],)))
            else:
                fields.append((str(place), self._order + its.kind))
        row = np.dtype(fields)
        fit = (len(self._data) - self._at) // row.itemsize if row.itemsize else 0
        if fit < element.count:
            raise _short(element, fit)
        table = np.frombuffer(self._data, row, element.count, self._at)
        if not lengths:
            self._at += table.nbytes
        return table

    def _even_table(self, element: _Element) -> NDArray[Any] | None:
        """All rows of an element with lists, if each list is as long as in the first row; else None."""
        lengths: dict[int, int] = {}
        if not element.count:
            return None
        at = self._at
        for place, its in enumerate(element.properties):
            if its.length is not None:
                lengths[place] = self._length(element, its, at, 0)
                at += np.dtype(its.length).itemsize
            at += lengths.get(place, 1) * np.dtype(its.kind).itemsize
        try:
            table = self._table(element, lengths)
        except BadMesh:
            return None  # shorter rows may follow
        even = all((table[f"length {place}"] == length).all() for place, length in lengths.items())
        return table if even else None

    def _length(self, element: _Element, its: _Property, at: int, row: int) -> int:
        letter = _LETTERS[its.length or ""]
        try:
            length: int = struct.unpack_from(self._order + letter, self._data, at)[0]
        except struct.error:
            raise _short(element, row) from None
        if not 0 <= length * np.dtype(its.kind).itemsize <= len(self._data) - at:
            raise BadMesh(f"a list of {length} in row {row} of {element.name!r} is longer than the file")
        return length

    def _walk(self, element: _Element, wanted: int | None) -> list[list[int]]:
        """Go over an element row by row; the lists at place `wanted`."""
        found: list[list[int]] = []
        steps = [(place, its, np.dtype(its.kind).itemsize) for place, its in enumerate(element.properties)]
        for row in range(element.count):
            for place, its, size in steps:
                length = 1
                if its.length is not None:
                    length = self._length(element, its, self._at, row)
                    self._at += np.dtype(its.length).itemsize
                if self._at + length * size > len(self._data):
                    raise _short(element, row)
                if place == wanted:
                    form = f"{self._order}{length}{_LETTERS[its.kind]}"
                    found.append(list(struct.unpack_from(form, self._data, self._at)))
                self._at += length * size
        return found
