"""`bench interpenetration`: how far the skin of posed bodies goes through itself."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from benches.measuring import counter
from bodyseg_data.bodies import Body, BodyRef
from bodyseg_data.bodies.sources.hard import HardBodies
from bodyseg_data.bodies.sources.open_bodies import MadeBodies, OpenBodies
from bodyseg_data.core import ProgressCallback, silent
from bodyseg_data.machine import missing_library
from bodyseg_data.meshes import Mesh

_OUTSIDE_M: Final = 1e-4  # how far off the skin rays start
_SLIGHT_M: Final = 0.002  # skin that touches skin
_FOLD_M: Final = 0.45  # along the skin: across groin, armpit, elbow and knee
_SOURCE_STEP: Final = 40
_NEUTRAL: Final = "a_pose"
_PEOPLE_STEP: Final = 10

Floats = NDArray[np.float64]


def penetration(mesh: Mesh) -> tuple[Floats, NDArray[np.int32]]:
    """Depth of every vertex inside the body, and the triangle in which it would come out.

    A vertex is inside if the surface first met on the way outwards, along its normal, is seen from behind. Its depth is
    the least of three distances: that way; the way back, against its normal, to the first surface seen from behind,
    which is the other part's skin where two overlap; and to the nearest vertex outside. Of a thin part wholly inside a
    thick one only its own thickness is seen.
    Returns depths float64 [V] in metres, 0 outside, and triangles int32 [V], -1 outside. Raises MissingLibrary.
    """
    try:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene
        from scipy.spatial import cKDTree
    except ImportError as error:
        raise missing_library("bench interpenetration", error) from error
    scene = EmbreeScene(robust=True)
    TriangleMesh(scene, (mesh.vertices - mesh.centre).astype(np.float32), mesh.faces)
    normals = mesh.vertex_normals

    def first(vertices: NDArray[np.intp], side: int) -> tuple[Floats, NDArray[np.int32]]:
        """Distance along rays from just off the skin, out or in, and the triangle if it is met from behind."""
        ways = (side * normals[vertices]).astype(np.float32)
        starts = (mesh.vertices[vertices] - mesh.centre + side * _OUTSIDE_M * normals[vertices]).astype(np.float32)
        hits = scene.run(starts, ways, output=True)
        faces = hits["primID"].astype(np.int32)
        behind = (faces >= 0) & (np.einsum("ij,ij->i", mesh.normals[faces], ways) > 0)
        return hits["tfar"].astype(np.float64), np.where(behind, faces, -1).astype(np.int32)

    used = np.unique(mesh.faces).astype(np.intp)
    outwards, met_outwards = first(used, 1)
    inside = met_outwards >= 0
    inwards, met_inwards = first(used[inside], -1)
    back = (met_inwards >= 0) & (inwards < outwards[inside])
    along = np.where(back, inwards, outwards[inside])
    outside = used[~inside]
    nearest, neighbour = cKDTree(mesh.vertices[outside]).query(mesh.vertices[used[inside]])
    a_face = np.empty(len(mesh.vertices), np.int32)
    a_face[mesh.faces.ravel()] = np.repeat(np.arange(len(mesh.faces), dtype=np.int32), 3)
    met = np.where(back, met_inwards, met_outwards[inside])
    depths, faces = np.zeros(len(mesh.vertices)), np.full(len(mesh.vertices), -1, np.int32)
    depths[used[inside]] = np.minimum(along, nearest)
    faces[used[inside]] = np.where(along < nearest, met, a_face[outside[neighbour]])
    return depths, faces


def bench_interpenetration(views: int = 5, progress: ProgressCallback = silent) -> dict[str, Any]:
    """Measure how deep skin goes through itself: every `views`-th frame of each motion, all other poses.

    For every group of poses, in millimetres: "fold_mm", the deepest vertex within 0.45 m of the skin it meets, measured
    along the skin, as in groin, armpit, elbow and knee; "contact_mm", the deepest one farther from it: a limb in
    another or in the trunk; "over_10_mm" and "over_20_mm", the
    shares of bodies with a deeper contact. Of dressed bodies the body is measured, and "dressed_contact_mm" is that of
    the clothes. Eyes and mouth do not count, nor what is inside in a stance with the arms off the body.
    Raises MissingLibrary.
    """
    open_bodies, hard_bodies = OpenBodies(), HardBodies()
    neutral = next(body for body in open_bodies.bodies() if body.pose == _NEUTRAL)
    skin = Skin(open_bodies.build(neutral))
    groups = groups_to_measure(open_bodies, hard_bodies, views)
    total = sum(len(bodies) for _, bodies in groups.values())
    advance = counter(progress, total)
    found: dict[str, Any] = {}
    for name, (source, bodies) in groups.items():
        bare, dressed = [], []
        for body in bodies:
            naked = source.build(body, dressed=False).mesh
            bare.append(skin.measured(naked, naked))
            clothed = source.figure(body).outfit is not None
            dressed.append(skin.measured(source.build(body).mesh, naked) if clothed else bare[-1])
            advance()
        found[name] = _summary(bare, dressed)
    return {"groups": found, "bodies": total, "views": views}


@dataclass(frozen=True)
class Depths:
    """One body's deepest fold and contact, metres."""

    fold: float
    contact: float


class Skin:
    """One topology's surface as it lies on a neutral body: which of its points are neighbours by nature."""

    def __init__(self, neutral: Body) -> None:
        from scipy.sparse import coo_matrix
        from scipy.sparse.csgraph import dijkstra

        mesh = neutral.mesh
        pieces = mesh.pieces()
        body = pieces == np.bincount(pieces).argmax()
        self._labels = neutral.partition().labels
        self._counted = body & (penetration(mesh)[0] == 0)
        ends = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
        lengths = np.linalg.norm(mesh.vertices[ends[:, 0]] - mesh.vertices[ends[:, 1]], axis=1)
        graph = coo_matrix((lengths, (ends[:, 0], ends[:, 1])), shape=(len(mesh.vertices),) * 2).tocsr()
        # Distances along the skin from one vertex in forty, near enough to distinguish folds from contacts.
        self._along = dijkstra(graph, directed=False, indices=np.flatnonzero(body)[::_SOURCE_STEP]).astype(np.float32)
        self._source = self._along.argmin(axis=0)

    def measured(self, mesh: Mesh, bare: Mesh) -> Depths:
        """Measure how deep a body goes through itself; bare: the same body undressed, its first vertices the skin's.

        Vertices that smaller triangles add count as the nearest of those.
        """
        from scipy.spatial import cKDTree

        depths, faces = penetration(mesh)
        own = cKDTree(bare.vertices[: len(self._labels)]).query(bare.vertices)[1]
        deep = np.flatnonzero((depths > _SLIGHT_M) & self._counted[own])
        met = own[mesh.faces[faces[deep], 0]]
        deep, met = deep[self._counted[met]], met[self._counted[met]]
        if not len(deep):
            return Depths(0, 0)
        apart = self._along[self._source[own[deep]], met] > _FOLD_M
        folds, contacts = np.where(apart, 0, depths[deep]), np.where(apart, depths[deep], 0)
        return Depths(float(folds.max()), float(contacts.max()))


def groups_to_measure(
    open_bodies: MadeBodies, hard_bodies: MadeBodies, step: int
) -> dict[str, tuple[MadeBodies, list[BodyRef]]]:
    """Sources and bodies by what is measured together."""
    groups: dict[str, tuple[MadeBodies, list[BodyRef]]] = {}
    for source in (open_bodies, hard_bodies):
        taken: Counter[str] = Counter()
        for body in source.bodies():
            moving = body.subset in ("B", "C")
            name = f"{body.subset} {body.pose}" if moving else body.subset
            taken[name] += 1
            if (taken[name] - 1) % (step if moving else _PEOPLE_STEP if name == "people" else 1) == 0:
                groups.setdefault(name, (source, []))[1].append(body)
    return groups


def _summary(bare: Sequence[Depths], dressed: Sequence[Depths]) -> dict[str, Any]:
    contacts = np.array([depths.contact for depths in bare])
    return {
        "bodies": len(bare),
        "fold_mm": round(max(depths.fold for depths in bare) * 1e3),
        "contact_mm": round(float(contacts.max()) * 1e3),
        "over_10_mm": round(float((contacts > 0.01).mean()), 3),
        "over_20_mm": round(float((contacts > 0.02).mean()), 3),
        "dressed_contact_mm": round(max(depths.contact for depths in dressed) * 1e3),
    }
