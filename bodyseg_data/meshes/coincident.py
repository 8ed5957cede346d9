"""Landmarks in one place, as where hands touch: one of the two moves to a free vertex of its own limb."""

from typing import Final

import numpy as np

from bodyseg_data.core import BadLandmarks
from bodyseg_data.labels import LANDMARKS, PART_COUNT
from bodyseg_data.meshes.geodesics import nearest_sources
from bodyseg_data.meshes.mending import MendedSurface, mend
from bodyseg_data.meshes.mesh import Floats, Indices, Mesh
from bodyseg_data.meshes.repairing import SAME_POINT_M

REACH_M: Final = 0.03
"""Distance within which a free vertex is sought, metres; on a coarse mesh, the longest edge at the shared vertex."""

_WAYS_ROUND: Final = 4  # reaches by which the path along a crumpled surface may exceed the straight line

_TOWARDS: Final = {
    "Sellion": "Nuchale",
    "Nuchale": "Cervicale",
    "Supramenton": "Sellion",
    "Suprasternale": "Substernale",
    "Substernale": "Suprasternale",
    "Cervicale": "10th Rib Midspine",
    "10th Rib Midspine": "Cervicale",
    "Thelion/Bustpoint": "Acromion",
    "ASIS": "Trochanterion",
    "PSIS": "Trochanterion",
    "Axilla, Post.": "Acromion",
    "Acromion": "Axilla, Post.",
    "Olecranon": "Acromion",
    "Radial Styloid": "Olecranon",
    "Dactylion": "Radial Styloid",
    "Trochanterion": "ASIS",
    "Femoral Lateral Epicn": "Trochanterion",
    "Knee Crease": "Femoral Lateral Epicn",
    "Lateral Malleolus": "Femoral Lateral Epicn",
    "Digit II": "Lateral Malleolus",
}
"""Landmark -> the landmark of the same side from which its own limb, or its part of the trunk, is reached."""


def separate(mesh: Mesh, vertices: Indices, points: Floats, where: str) -> tuple[Indices, tuple[str, ...]]:
    """Give landmarks in one place different places; also returns a note on each that moves.

    vertices: int64 [33], of `mesh`. points: float64 [33, 3], where the landmarks were measured, metres, in the frame of
    the mesh. where: names file and mesh in messages.

    Of two landmarks, the second in the order of `LANDMARKS` moves; the first, if only that one is on a foreign
    limb, as measured along edges from the landmark before it on its own limb. It moves to the free vertex nearest to
    its point that is nearer to its own limb than the shared vertex. The same mesh gives the same vertices. Raises
    BadLandmarks for three landmarks in one place, or without a free vertex near.
    """
    places = mesh.vertices[vertices]
    apart = np.linalg.norm(places[:, None] - places, axis=2)
    together = (apart < SAME_POINT_M) & ~np.eye(PART_COUNT, dtype=np.bool_)
    if not together.any():
        return vertices, ()
    crowd = np.flatnonzero(together.sum(axis=1) > 1)
    if len(crowd):
        names = ", ".join(repr(LANDMARKS[index]) for index in (crowd[0], *np.flatnonzero(together[crowd[0]])))
        raise BadLandmarks(f"{where}: at most two landmarks may be in one place, found {names} at {vertices[crowd[0]]}")
    surface = mend(mesh.vertices, mesh.faces)
    separated, notes = vertices.copy(), []
    for first, second in np.argwhere(np.triu(together)).tolist():
        moved, vertex = _moved(mesh, surface, separated, points, (first, second), where)
        length_mm = 1000 * float(np.linalg.norm(mesh.vertices[vertex] - places[moved]))
        other = LANDMARKS[first + second - moved]
        notes.append(f"{LANDMARKS[moved]} moved by {length_mm:.1f} mm: it was in one place with {other}")
        separated[moved] = vertex
    return separated, tuple(notes)


def _moved(
    mesh: Mesh, surface: MendedSurface, vertices: Indices, points: Floats, pair: tuple[int, int], where: str
) -> tuple[int, int]:
    """The landmark of a pair that moves, and its new vertex."""
    shared = int(vertices[pair[1]])
    used = np.unique(surface.faces)
    around = surface.faces[(surface.faces == surface.representative[shared]).any(axis=1)]
    edges = np.linalg.norm(mesh.vertices[around] - mesh.vertices[shared], axis=2)
    reach = max(REACH_M, float(edges.max(initial=0.0)) * (1 + 1e-9))
    taken = mesh.vertices[vertices]
    found = {}
    for landmark in pair:
        distance = np.linalg.norm(mesh.vertices[used] - points[landmark], axis=1)
        near = used[distance <= reach + np.linalg.norm(mesh.vertices[shared] - points[landmark])]
        free = np.linalg.norm(mesh.vertices[near][:, None] - taken, axis=2).min(axis=1) >= SAME_POINT_M
        along = _along_edges(mesh, surface, int(vertices[_before(landmark)]))
        found[landmark] = near[free], along, min(along[near].min(initial=np.inf), along[shared])
    foreign = {
        landmark: along[shared] > nearest + _WAYS_ROUND * reach for landmark, (_, along, nearest) in found.items()
    }
    moved = pair[0] if foreign[pair[0]] and not foreign[pair[1]] else pair[1]
    near, along, nearest = found[moved]
    own = near[(along[near] <= nearest + _WAYS_ROUND * reach) & (along[near] < along[shared])]
    candidates = own if len(own) else near
    if not len(candidates):
        names = " and ".join(repr(LANDMARKS[index]) for index in pair)
        raise BadLandmarks(f"{where}: {names} are at vertex {shared}, and no free vertex lies within {reach:.3g} m")
    away = np.linalg.norm(mesh.vertices[candidates] - points[moved], axis=1)
    return moved, int(candidates[np.lexsort((candidates, away))[0]])


def _before(landmark: int) -> int:
    """The landmark from which a landmark's own limb is reached."""
    side, dot, name = LANDMARKS[landmark].partition(". ")
    if not dot:
        return LANDMARKS.index(_TOWARDS[LANDMARKS[landmark]])
    return LANDMARKS.index(f"{side}{dot}{_TOWARDS[name]}")


def _along_edges(mesh: Mesh, surface: MendedSurface, source: int) -> Floats:
    """Distance of every vertex from one of them along edges, metres, [V]; infinite where none leads."""
    used, corners = np.unique(surface.faces, return_inverse=True)
    distance = np.full(len(mesh.vertices), np.inf)
    start = np.searchsorted(used, surface.representative[[source]])
    distance[used] = nearest_sources("edges", mesh.vertices[used], corners.reshape(-1, 3), start).distance
    return distance[surface.representative]
