"""Landmarks by coordinate: 33 points near a surface, projected onto it.

Their files are JSON, like those of landmarks by vertex (`by_vertex`), with points instead of vertices:

    {"format": "bodyseg landmarks 1", "units": "mm", "points": {"Sellion": [12.1, 1630.0, 98.4], ...}}
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadLandmarks
from bodyseg_data.core.parts import LANDMARKS, PART_COUNT
from bodyseg_data.meshes.landmarks.by_vertex import LandmarkSet, check_keys, check_landmark_names, json_table
from bodyseg_data.meshes.landmarks.coincident import separate
from bodyseg_data.meshes.mesh import Mesh
from bodyseg_data.meshes.nearest import nearest_corner

FARTHEST_M: Final = 0.03
"""Largest accepted distance of a landmark from the surface, metres.

Markers on the skin and a scan's surface differ by millimetres; hair, clothes and holes in a scan add centimetres. A
landmark farther away belongs to another body, unit or frame.
"""

METRES: Final[Mapping[str, float]] = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}
"""Metres in a unit of length."""

_KEYS: Final = ("format", "units", "points")
_FEATURE: Final = "putting landmarks onto a surface"


@dataclass(frozen=True)
class SnappedLandmarks:
    """Landmarks projected onto a surface. vertices: int64 [33], of the triangle nearest to each point the nearest
    corner, or a free vertex beside it where two landmarks have the same (`separate`). distance_m: float64 [33], from
    each point to the surface, metres. Both in the order of `parts.PARTS`. notes: lines on landmarks that moved.
    """

    vertices: NDArray[np.int64]
    distance_m: NDArray[np.float64]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class PointLandmarks:
    """The landmarks of one body in space. source: file they were read from, for messages.

    points: float64 [33, 3] in the order of `parts.LANDMARKS`, metres, in the frame of the file they came from, which is
    not always that of the mesh (`transformed`). ignored: other names in the file. Raises BadLandmarks unless they are
    33 finite points.
    """

    source: str
    points: NDArray[np.float64]
    ignored: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        points: NDArray[np.float64] = np.array(self.points, np.float64)
        if points.shape != (PART_COUNT, 3):
            raise BadLandmarks(f"landmarks {self.source}: there must be {PART_COUNT} points, found {points.shape}")
        bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
        if len(bad):
            found = points[bad[0]].tolist()
            raise BadLandmarks(f"landmarks {self.source}: {LANDMARKS[bad[0]]!r} must be finite, found {found}")
        points.flags.writeable = False
        object.__setattr__(self, "points", points)

    def transformed(self, scale: float, rotation: NDArray[np.float64]) -> PointLandmarks:
        """The same landmarks, scaled and then rotated by `rotation` [3, 3], as the mesh was to reach the body frame."""
        return replace(self, points=self.points @ rotation.T * scale)

    def for_mesh(self, mesh: Mesh) -> SnappedLandmarks:
        """Project the landmarks onto the surface of `mesh`, whose frame the points must be in.

        Raises BadLandmarks, naming the landmark, for one farther than `FARTHEST_M` from the surface, three in one
        place, and one on another piece of the surface than most; MissingLibrary without trimesh, rtree or scipy.
        """
        where = f"landmarks {self.source} on mesh {mesh.name}"
        vertices, distance = snap(mesh, self.points)
        worst = int(distance.argmax())
        if distance[worst] > FARTHEST_M:
            others = int((distance > FARTHEST_M).sum()) - 1
            raise BadLandmarks(
                f"{where}: a landmark must lie within {100 * FARTHEST_M:g} cm of the surface, found "
                f"{LANDMARKS[worst]!r} {100 * distance[worst]:.1f} cm off it at "
                f"{np.round(self.points[worst], 4).tolist()}"
                + (f", and {others} more beyond {100 * FARTHEST_M:g} cm" if others else "")
            )
        vertices, notes = separate(mesh, vertices, self.points, where)
        piece = mesh.pieces(_FEATURE)[vertices]
        body = np.bincount(piece).argmax()
        if (piece != body).any():
            stray = int(np.flatnonzero(piece != body)[0])
            raise BadLandmarks(
                f"{where}: landmarks must lie on one piece of the surface, found {LANDMARKS[stray]!r} at vertex "
                f"{vertices[stray]} of another piece than the one that holds {(piece == body).sum()} of them"
            )
        return SnappedLandmarks(vertices, distance, notes)

    def to_landmark_set(self, mesh: Mesh, topology: str) -> tuple[LandmarkSet, SnappedLandmarks]:
        """Convert to landmarks by vertex, for all meshes with the vertex order of `mesh`; also returns the projection.

        topology: description of those meshes. Raises the errors of `for_mesh`.
        """
        snapped = self.for_mesh(mesh)
        counts = len(mesh.vertices), len(mesh.faces)
        vertices = tuple(snapped.vertices.tolist())
        return LandmarkSet(self.source, topology, *counts, vertices, self.ignored), snapped


def snap(mesh: Mesh, points: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Find the triangle nearest to each of `points` [N, 3]: its corner nearest to the point, int64 [N], and the
    distance from the point to the triangle, float64 [N], metres.

    Raises MissingLibrary without trimesh, rtree or scipy.
    """
    faces = mesh.faces[(mesh.normals != 0).any(axis=1)]  # a triangle without area has no nearest point
    vertices, distance = nearest_corner(mesh.vertices, faces, points, _FEATURE)
    return vertices.astype(np.int64), distance


def parse_points(text: str, source: str) -> PointLandmarks:
    """Parse landmarks by coordinate from JSON text; `source` names it in messages. Raises BadLandmarks."""
    where = f"landmarks {source}"
    tree = json_table(text, source)
    check_keys(tree, _KEYS, where)
    units, table = tree["units"], tree["points"]
    if not isinstance(units, str) or units not in METRES:
        raise BadLandmarks(f"{where}: 'units' must be one of {', '.join(METRES)}, found {units!r}")
    if not isinstance(table, dict):
        raise BadLandmarks(f"{where}: 'points' must map names to coordinates, found {table!r}")
    ignored = check_landmark_names(list(table), where)
    points = [_point(table[name], f"{where}: the point of {name!r}") for name in LANDMARKS]
    return PointLandmarks(source, np.array(points) * METRES[units], ignored)


def _point(value: Any, what: str) -> list[float]:
    if (
        not isinstance(value, list)
        or len(value) != 3
        or any(isinstance(number, bool) or not isinstance(number, int | float) for number in value)
        or not all(abs(number) < 1e9 and math.isfinite(number) for number in value)
    ):
        raise BadLandmarks(f"{what} must be three finite numbers, found {value!r}")
    return [float(number) for number in value]
