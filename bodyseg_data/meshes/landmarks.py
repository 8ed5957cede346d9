"""The 33 landmarks of bodies: by vertex, for all meshes of one topology, or by coordinate, for one body.

docs/how-to/landmarks.md has the formats of both. Two landmarks may share a vertex, as where hands touch (`coincident`).
Points lie near a surface, onto which they are projected.

A .lnd file of the CAESAR survey holds rows of numbers and names, typed by hand, some names truncated, which may hold
blanks or begin with a digit:

    3  0  0  1   12.3  -101.2  1544.0  Rt. Thelion/Bustpoin

A name is recognised if it is one of the 33 in full, regardless of case, blanks and punctuation, or a prefix of only one
of them, or differs from one by a letter or two and from all others of its side by clearly more. Sides and numbers, like
the "II" of a toe, must be exact. So none of the survey's 40 other names, cut or misspelt by a letter, is taken for one.
"""

from __future__ import annotations

import difflib
import json
import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig, BadLandmarks, check_choice, reported
from bodyseg_data.files import Table, parse_json
from bodyseg_data.labels import LANDMARKS
from bodyseg_data.machine import required
from bodyseg_data.meshes.coincident import separate
from bodyseg_data.meshes.mending import welded
from bodyseg_data.meshes.mesh import Floats, Indices, Mesh, face_components, face_normals
from bodyseg_data.meshes.mesh_files import file_bytes

LANDMARKS_FORMAT: Final = "bodyseg landmarks 1"

FARTHEST_M: Final = 0.03
"""Largest accepted distance of a landmark from the surface, metres.

Markers on the skin and a scan's surface differ by millimetres; hair, clothes and holes in a scan add centimetres. A
landmark farther away belongs to another body, unit or frame.
"""

METRES: Final[Mapping[str, float]] = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}
"""Metres in a unit of length."""

LARGEST_BYTES: Final = 1 << 20
"""Largest size of a landmark file, also after unpacking: those of the survey have a hundredth of it."""

_SIDES: Final = {"rt": "rt", "right": "rt", "lt": "lt", "left": "lt"}
_PLACEHOLDER_MM: Final = -999.0
_LEAST_SHARE: Final = 0.6  # of a name that a truncated one must have
_LONGEST_NAME: Final = 60  # twice the survey's longest; the edit distance takes quadratic time
_MARGIN: Final = 2  # letters by which a misspelt name must be nearer to one than to the next
_AUX: Final = re.compile(r"\s*AUX\s*=", re.IGNORECASE)
_END: Final = re.compile(r"\s*END\s*=", re.IGNORECASE)


@dataclass(frozen=True)
class LandmarkSet:
    """The landmarks of one topology, constructed by `load_landmarks` and `parse_landmarks`, which check all fields.

    source: file or name it was read from, for messages. topology: description of its meshes. vertex_count, face_count:
    of those meshes. vertices: index of each landmark's vertex, in the order of `LANDMARKS`. ignored: names of others.
    """

    source: str
    topology: str
    vertex_count: int
    face_count: int
    vertices: tuple[int, ...]
    ignored: tuple[str, ...] = ()

    def for_mesh(self, mesh: Mesh) -> Indices:
        """Vertices of the landmarks on `mesh`, int64 [33], in the order of `PARTS`; two may be the same.

        Raises BadLandmarks, naming set and mesh, if the mesh has another number of vertices or faces, or if no face
        uses the vertex of a landmark.
        """
        self.check_counts(len(mesh.vertices), len(mesh.faces), f"mesh {mesh.name}")
        vertices = np.array(self.vertices, np.int64)
        loose = np.flatnonzero(~np.isin(vertices, mesh.faces))
        if len(loose):
            raise BadLandmarks(f"landmarks {self.source}: no face of {mesh.name} uses that of {LANDMARKS[loose[0]]!r}")
        return vertices

    def check_counts(self, vertices: int, faces: int, where: str) -> None:
        """Raise BadLandmarks for a mesh, named by `where`, of another number of vertices or faces."""
        if (vertices, faces) != (self.vertex_count, self.face_count):
            raise BadLandmarks(
                f"landmarks {self.source} are for meshes of {self.vertex_count} vertices and {self.face_count} faces "
                f"({self.topology}), found {vertices} and {faces} in {where}: this mesh needs landmarks of its own"
            )

    def to_json(self) -> str:
        """Serialise the set as the JSON text that `load_landmarks` reads."""
        tree = {
            "format": LANDMARKS_FORMAT,
            "topology": self.topology,
            "vertex_count": self.vertex_count,
            "face_count": self.face_count,
            "landmarks": dict(zip(LANDMARKS, self.vertices, strict=True)),
        }
        return json.dumps(tree, indent=2, ensure_ascii=False) + "\n"


def load_landmarks(name: str) -> LandmarkSet:
    """Read a landmark set that ships with the package, "open" or "mit_I". Raises BadLandmarks for another name."""
    folder = resources.files(__package__) / "landmark_sets"
    names = sorted(entry.name.removesuffix(".json") for entry in folder.iterdir() if entry.name.endswith(".json"))
    if name not in names:
        raise BadLandmarks(f"no landmark set is called {name!r}: give {' or '.join(names)}")
    return parse_landmarks((folder / f"{name}.json").read_bytes(), name)


def parse_landmarks(text: str | bytes, source: str) -> LandmarkSet:
    """Parse a landmark set from JSON text; `source` names it in messages. Raises BadLandmarks."""
    tree = json_table(text, source)
    with reported("", BadLandmarks, BadConfig):
        topology, counts = tree.text("topology"), (tree.whole("vertex_count"), tree.whole("face_count"))
        table, ignored = _by_name(tree, "landmarks")
        vertices = tuple(table.whole(name) for name in LANDMARKS)
    for name, vertex in zip(LANDMARKS, vertices, strict=True):
        if not 0 <= vertex < counts[0]:
            raise BadLandmarks(f"{table.where}: {name!r} must be a vertex, 0 to {counts[0] - 1}, found {vertex}")
    vertex, count = Counter(vertices).most_common(1)[0]
    if count > 2:
        names = ", ".join(repr(name) for name, each in zip(LANDMARKS, vertices, strict=True) if each == vertex)
        raise BadLandmarks(f"{table.where}: at most two landmarks may share a vertex, found {names} at {vertex}")
    return LandmarkSet(source, topology, *counts, vertices, ignored)


@dataclass(frozen=True)
class SnappedLandmarks:
    """Landmarks projected onto a surface. vertices: int64 [33], of the triangle nearest to each point the nearest
    corner, or a free vertex beside it where two landmarks have the same (`separate`). distance_m: float64 [33], from
    each point to the surface, metres. Both in the order of `PARTS`. notes: lines on landmarks that moved.
    """

    vertices: Indices
    distance_m: Floats
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class PointLandmarks:
    """The landmarks of one body in space. source: file they were read from, for messages.

    points: float64 [33, 3] in the order of `LANDMARKS`, metres, finite, in the frame of the file they came from, which
    is not always that of the mesh (`transformed`). ignored: other names in the file.
    """

    source: str
    points: Floats
    ignored: tuple[str, ...] = ()

    def transformed(self, scale: float, rotation: Floats) -> PointLandmarks:
        """The same landmarks, scaled and then rotated by `rotation` [3, 3], as the mesh was to reach the body frame."""
        return replace(self, points=self.points @ rotation.T * scale)

    def for_mesh(self, mesh: Mesh) -> SnappedLandmarks:
        """Project the landmarks onto the surface of `mesh`, whose frame the points must be in.

        Raises BadLandmarks, naming the landmark, for one farther than `FARTHEST_M` from the surface, three in one
        place, and one on another piece of the surface than most; MissingLibrary without trimesh or rtree.
        """
        where = f"landmarks {self.source} on mesh {mesh.name}"
        nearest, distance = nearest_corner(mesh.vertices, mesh.faces, self.points)
        worst = int(distance.argmax())
        if distance[worst] > FARTHEST_M:
            off = f"{LANDMARKS[worst]!r} {100 * distance[worst]:.1f} cm off it"
            raise BadLandmarks(f"{where}: landmarks lie within {100 * FARTHEST_M:g} cm of the surface, found {off}")
        vertices, notes = separate(mesh, nearest.astype(np.int64), self.points, where)
        piece = mesh.pieces()[vertices]
        if (piece != piece[0]).any():  # pieces that only lack common vertices are one surface
            kept, place = welded(mesh.vertices)
            piece = face_components(len(kept), place[mesh.faces])[place[vertices]]
        body = np.bincount(piece).argmax()
        if (piece != body).any():
            stray = int(np.flatnonzero(piece != body)[0])
            raise BadLandmarks(f"{where}: landmarks must lie on one piece, found {LANDMARKS[stray]!r} on another")
        return SnappedLandmarks(vertices, distance, notes)


def parse_points(text: str | bytes, source: str) -> PointLandmarks:
    """Parse landmarks by coordinate from JSON text; `source` names it in messages. Raises BadLandmarks."""
    tree = json_table(text, source)
    with reported("", BadLandmarks, BadConfig):
        units = check_choice(f"{tree.where}: 'units'", tree.text("units"), METRES)
        table, ignored = _by_name(tree, "points")
        points = [table.numbers(name, 3) for name in LANDMARKS]
    return PointLandmarks(source, np.array(points) * METRES[units], ignored)


def json_table(text: str | bytes, source: str) -> Table:
    """Parse the JSON object of a landmark file and check its format. Raises BadLandmarks."""
    where = f"landmarks {source}"
    with reported("", BadLandmarks, BadConfig):
        tree = parse_json(text.encode() if isinstance(text, str) else text, where)
    if tree.pop("format", None) != LANDMARKS_FORMAT:
        raise BadLandmarks(f"{where}: 'format' must be {LANDMARKS_FORMAT!r}")
    return Table(tree, where)


def _misspelt(name: str, others: list[str]) -> str:
    """A missing name, and which of the other names in its file may be meant."""
    close = difflib.get_close_matches(name, others, 1)
    return repr(name) + (f" (misspelt as {close[0]!r}?)" if close else "")


def _by_name(tree: Table, key: str) -> tuple[Table, tuple[str, ...]]:
    """The last table of a landmark file, by name, and the names in it that are not among the 33.

    Raises BadLandmarks, naming each of the 33 that is missing and what it may have been misspelt as.
    """
    table = tree.table(key)
    tree.finish()
    others = [name for name in table if name not in LANDMARKS]
    missing = [_misspelt(name, others) for name in LANDMARKS if name not in table]
    if missing:
        raise BadLandmarks(f"{tree.where}: landmark {', '.join(missing)} is missing")
    return table, tuple(others)


def read_lnd(path: Path) -> PointLandmarks:
    """Read a .lnd file (or .lnd.gz): the points in metres, in the frame of the survey's scan of the same subject.

    Landmarks that are not among the 33 are left out, and so are rows without coordinates (-999, all 0, or not
    numbers). Raises BadLandmarks, naming the file and the landmarks, for one that is missing or given twice in
    different places, and for a file that cannot be read or lacks the lines "AUX =" and "END =".
    """
    found: dict[str, tuple[float, ...]] = {}
    unknown: list[str] = []
    text = file_bytes(path, ".lnd", LARGEST_BYTES, BadLandmarks).decode("latin-1")
    for number, point, written in _rows(text, path):
        name = recognise(written)
        if name is None:
            unknown.append(written)
        unset = not any(point) or any(not math.isfinite(value) or value == _PLACEHOLDER_MM for value in point)
        if name is None or unset:
            continue
        if name in found and found[name] != point:
            raise BadLandmarks(f"landmarks {path}, line {number}: {name!r} is given twice, {found[name]} and {point}")
        found[name] = point
    missing = [name for name in LANDMARKS if name not in found]
    if missing:
        raise BadLandmarks(f"landmarks {path}: {', '.join(_misspelt(name, unknown) for name in missing)} missing")
    return PointLandmarks(str(path), np.array([found[name] for name in LANDMARKS]) * METRES["mm"])


@lru_cache(maxsize=4096)
def recognise(written: str) -> str | None:
    """Find the one of the 33 that a name in a file means; None if it is not certain."""
    if len(written) > _LONGEST_NAME:
        return None
    side, words = _normalised(written.partition("#")[0])
    names = {known: words for known, (its_side, words) in _KNOWN.items() if its_side == side}
    exact = [known for known, other in names.items() if other == words]
    if exact:
        return exact[0]
    whole = " ".join(words)
    whole_names = {known: " ".join(other) for known, other in names.items()}
    cut = [known for known, other in whole_names.items() if other.startswith(whole)]
    if cut:
        other = whole_names[cut[0]]
        enough = len(cut) == 1 and len(whole) >= max(3, _LEAST_SHARE * len(other))
        return cut[0] if enough and set(_numbers(words)) <= set(_numbers(other.split())) else None
    distances = sorted((_edits(whole, other), known) for known, other in whole_names.items())
    (edits, nearest), (next_edits, _) = distances[:2]
    allowed = 0 if len(whole) < 6 else 1 if len(whole) < 10 else 2
    same_numbers = _numbers(words) == _numbers(names[nearest])
    return nearest if edits <= allowed and next_edits >= edits + _MARGIN and same_numbers else None


def _normalised(name: str) -> tuple[str, tuple[str, ...]]:
    """Split a name into side ("rt", "lt" or "") and other words, in lower case without punctuation."""
    words = tuple(re.findall(r"[^\W_]+", name.lower()))
    side = _SIDES.get(words[0], "") if words else ""
    return side, words[1:] if side else words


def _numbers(words: tuple[str, ...] | list[str]) -> list[str]:
    """Words that are numbers, Roman or Arabic: a different number means another landmark, not a misspelling."""
    return [word for word in words if re.fullmatch(r"[ivx]+|\d+\w*", word)]


def _edits(a: str, b: str) -> int:
    """Edit distance: the least number of letters to add, remove or change (Levenshtein 1966)."""
    row = list(range(len(b) + 1))
    for i, left in enumerate(a, 1):
        diagonal, row[0] = row[0], i
        for j, right in enumerate(b, 1):
            diagonal, row[j] = row[j], min(row[j] + 1, row[j - 1] + 1, diagonal + (left != right))
    return row[-1]


_KNOWN: Final = {name: _normalised(name) for name in LANDMARKS}


def _rows(text: str, path: Path) -> Iterator[tuple[int, tuple[float, ...], str]]:
    """Line number, x y z in millimetres and name as written, of every row that has coordinates and a name."""
    lines = list(enumerate(text.splitlines(), 1))
    begin = next((number for number, line in lines if _AUX.match(line)), None)
    end = next((number for number, line in lines if begin and number > begin and _END.match(line)), None)
    if begin is None or end is None:
        lacking = "AUX =" if begin is None else "END ="
        raise BadLandmarks(f"landmarks {path}: rows must stand between 'AUX =' and 'END =', found no {lacking!r}")
    for number, line in lines[begin : end - 1]:
        words = line.split()
        count = next((index for index, word in enumerate(words) if not _is_number(word)), len(words))
        if 3 <= count < len(words):
            yield number, tuple(float(word) for word in words[count - 3 : count]), " ".join(words[count:])


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def load_landmark_file(path: Path) -> LandmarkSet | PointLandmarks:
    """Read a landmark file: .lnd (or .lnd.gz), or .json, by vertex or, if it has "points", by coordinate.

    Raises BadLandmarks, naming the file and, where there is one, the landmark at fault.
    """
    name = path.name.lower().removesuffix(".gz")
    if name.endswith(".lnd"):
        return read_lnd(path)
    if path.suffix.lower() != ".json":
        raise BadLandmarks(f"a landmark file must be .json, .lnd or .lnd.gz, found {path}")
    data = file_bytes(path, "landmark", LARGEST_BYTES, BadLandmarks)
    return (parse_points if "points" in json_table(data, str(path)) else parse_landmarks)(data, str(path))


def nearest_corner(vertices: Floats, faces: NDArray[np.int32], points: Floats) -> tuple[NDArray[np.int32], Floats]:
    """Find the triangle nearest to each of `points` [P, 3]: its corner nearest to the point, int32 [P], and the
    distance from the point to the triangle, float64 [P], metres.

    vertices: [V, 3], metres. faces: [F, 3]; those without area have no nearest point and are left out. Raises
    MissingLibrary without trimesh or rtree.
    """
    from scipy.spatial import KDTree

    feature = "measuring distances to a surface"
    required("rtree", feature)  # trimesh imports it late and reports its absence in other words
    trimesh = required("trimesh", feature)
    faces = faces[(face_normals(vertices, faces) != 0).any(axis=1)]
    # No point is farther from the surface than from its nearest vertex, so only triangles within that distance of the
    # points' bounding box can be nearest: for eyes in a head a few hundred instead of all.
    reach = KDTree(vertices[np.unique(faces)]).query(points)[0].max() + 1e-9  # rounding must not lose the nearest
    corners = vertices[faces]
    low, high = points.min(axis=0) - reach, points.max(axis=0) + reach
    faces = faces[((corners.max(axis=1) >= low) & (corners.min(axis=1) <= high)).all(axis=1)]
    surface = trimesh.Trimesh(vertices, faces, process=False)
    _, distance, triangle = trimesh.proximity.closest_point(surface, points)
    candidates = faces[triangle]
    away = np.linalg.norm(vertices[candidates] - points[:, None], axis=2)
    nearest: NDArray[np.int32] = candidates[np.arange(len(points)), away.argmin(axis=1)]
    return nearest, np.asarray(distance, np.float64)
