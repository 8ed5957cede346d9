"""Landmarks by vertex: the vertex at each of the 33 landmarks, for all meshes of one topology.

A set is a JSON file:

    {"format": "bodyseg landmarks 1", "topology": "<which meshes, in words>", "vertex_count": 13718,
     "face_count": 27420, "landmarks": {"Sellion": 132, ..., "Lt. Digit II": 13101}}

with each of the 33 names of `parts.LANDMARKS` once, in any order, and vertex indices from 0; other names are ignored.
Two landmarks may share a vertex, as where hands touch (`coincident`). Meshes with the same vertex order, whatever their
pose and shape, share one set. Landmarks by coordinate are in `by_point`.
"""

from __future__ import annotations

import difflib
import json
from collections import Counter
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadLandmarks
from bodyseg_data.core.files import refuse_special
from bodyseg_data.core.parts import LANDMARKS
from bodyseg_data.meshes.mesh import Mesh

LANDMARKS_FORMAT: Final = "bodyseg landmarks 1"
_KEYS: Final = ("format", "topology", "vertex_count", "face_count", "landmarks")


@dataclass(frozen=True)
class LandmarkSet:
    """The landmarks of one topology, constructed by `load_landmarks` and `parse_landmarks`, which check all fields.

    source: file or name it was read from, for messages. topology: description of its meshes. vertex_count, face_count:
    of those meshes. vertices: index of each landmark's vertex, in the order of `parts.LANDMARKS`. ignored: other names
    in the file.
    """

    source: str
    topology: str
    vertex_count: int
    face_count: int
    vertices: tuple[int, ...]
    ignored: tuple[str, ...] = ()

    def for_mesh(self, mesh: Mesh) -> NDArray[np.int64]:
        """Vertices of the landmarks on `mesh`, int64 [33], in the order of `parts.PARTS`; two may be the same.

        Raises BadLandmarks, naming set and mesh, if the mesh has another number of vertices or faces, or if no face
        uses the vertex of a landmark.
        """
        found = (len(mesh.vertices), len(mesh.faces))
        if found != (self.vertex_count, self.face_count):
            raise BadLandmarks(
                f"landmarks {self.source} are for meshes of {self.vertex_count} vertices and {self.face_count} faces "
                f"({self.topology}), found {found[0]} and {found[1]} in mesh {mesh.name}: "
                "this mesh needs landmarks of its own"
            )
        vertices = np.array(self.vertices, np.int64)
        loose = np.flatnonzero(~np.isin(vertices, mesh.faces))
        if len(loose):
            raise BadLandmarks(
                f"landmarks {self.source}: {LANDMARKS[loose[0]]!r} must lie on the surface, found vertex "
                f"{vertices[loose[0]]}, which no face of mesh {mesh.name} uses"
            )
        return vertices

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


def load_landmarks(name_or_path: str | Path) -> LandmarkSet:
    """Read a landmark set by the name of one that ships with the package ("open", "mit_I"), or from a .json file.

    Raises BadLandmarks, naming the file and, where there is one, the landmark at fault.
    """
    path = Path(name_or_path)
    if path.suffix != ".json":
        folder = resources.files(__package__) / "sets"
        names = sorted(entry.name.removesuffix(".json") for entry in folder.iterdir() if entry.name.endswith(".json"))
        if str(name_or_path) not in names:
            raise BadLandmarks(
                f"no landmark set is called {str(name_or_path)!r}: give {', '.join(names)} or the path of a .json file"
            )
        text = (folder / f"{name_or_path}.json").read_text(encoding="utf-8")
    else:
        text = read_text(path)
    return parse_landmarks(text, str(name_or_path))


def read_text(path: Path) -> str:
    """Read a landmark file in UTF-8. Raises BadLandmarks."""
    try:
        refuse_special(path)
        return path.read_text(encoding="utf-8-sig")  # some editors write a byte-order mark
    except (OSError, UnicodeDecodeError) as error:
        raise BadLandmarks(f"cannot read the landmark file {path}: {error}") from error


def parse_landmarks(text: str, source: str) -> LandmarkSet:
    """Parse a landmark set from JSON text; `source` names it in messages. Raises BadLandmarks."""
    where = f"landmarks {source}"
    tree = json_table(text, source)
    check_keys(tree, _KEYS, where)
    if not isinstance(tree["topology"], str):
        raise BadLandmarks(f"{where}: 'topology' must be text, found {tree['topology']!r}")
    vertex_count = _whole(tree["vertex_count"], 1, None, f"{where}: 'vertex_count'")
    face_count = _whole(tree["face_count"], 1, None, f"{where}: 'face_count'")
    table = tree["landmarks"]
    if not isinstance(table, dict):
        raise BadLandmarks(f"{where}: 'landmarks' must map names to vertices, found {table!r}")
    ignored = check_landmark_names(list(table), where)
    return LandmarkSet(
        source, tree["topology"], vertex_count, face_count, _vertices(table, vertex_count, where), ignored
    )


def _vertices(table: dict[str, Any], vertex_count: int, where: str) -> tuple[int, ...]:
    vertices = [_whole(table[name], 0, vertex_count - 1, f"{where}: the vertex of {name!r}") for name in LANDMARKS]
    vertex, count = Counter(vertices).most_common(1)[0]
    if count > 2:
        names = ", ".join(repr(name) for name, each in zip(LANDMARKS, vertices, strict=True) if each == vertex)
        raise BadLandmarks(f"{where}: at most two landmarks may share a vertex, found {names} at {vertex}")
    return tuple(vertices)


def check_landmark_names(found: list[str], where: str) -> tuple[str, ...]:
    """Return the names that are not among the 33. Raises BadLandmarks, naming each of the 33 that is missing and what
    it may have been misspelt as.
    """
    others = [name for name in found if name not in LANDMARKS]
    missing = []
    for name in LANDMARKS:
        if name not in found:
            close = difflib.get_close_matches(name, others, 1)
            missing.append(repr(name) + (f" (misspelt as {close[0]!r}?)" if close else ""))
    if missing:
        raise BadLandmarks(f"{where}: landmark {', '.join(missing)} is missing")
    return tuple(others)


def json_table(text: str, source: str) -> dict[str, Any]:
    """Parse the JSON object of a landmark file and check its format. Raises BadLandmarks."""
    where = f"landmarks {source}"
    try:
        tree = json.loads(text, object_pairs_hook=lambda pairs: _without_doubles(pairs, where))
    except (ValueError, RecursionError) as error:  # RecursionError: brackets nested beyond reason
        raise BadLandmarks(f"{where} is not JSON: {error}") from error
    if not isinstance(tree, dict) or tree.get("format") != LANDMARKS_FORMAT:
        raise BadLandmarks(f"{where}: 'format' must be {LANDMARKS_FORMAT!r}")
    return tree


def check_keys(tree: dict[str, Any], wanted: tuple[str, ...], where: str) -> None:
    """Raise BadLandmarks unless the keys of a landmark file are those `wanted`."""
    unknown = [key for key in tree if key not in wanted]
    if unknown:
        raise BadLandmarks(f"{where}: unknown key {', '.join(map(repr, unknown))}")
    missing = [key for key in wanted if key not in tree]
    if missing:
        raise BadLandmarks(f"{where}: key {', '.join(map(repr, missing))} is missing")


def _whole(value: Any, low: int, high: int | None, what: str) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or value < low or (high is not None and value > high):
        span = f"at least {low}" if high is None else f"{low} to {high}"
        raise BadLandmarks(f"{what} must be a whole number, {span}, found {value!r}")
    return value


def _without_doubles(pairs: list[tuple[str, Any]], where: str) -> dict[str, Any]:
    """Raise BadLandmarks for repeated keys, of which `json` would silently keep the last."""
    tree: dict[str, Any] = {}
    for key, value in pairs:
        if key in tree:
            raise BadLandmarks(f"{where}: {key!r} is given twice")
        tree[key] = value
    return tree
