"""Bodies broken on purpose, as scans and careless files are, each by seeded steps that leave the surface where it was.

A broken body holds, for each of its triangles, the triangle of the sound body that it lies in: so its labels can be
compared, point by point, with the sound body's.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.bodies import Body
from bodyseg_data.meshes import Mesh, find_edges

Indices = NDArray[np.int64]


@dataclass(frozen=True)
class Broken:
    """A body being broken. vertices: float64 [V, 3]. faces: [F, 3]. parent: [F], the sound body's triangle that each
    face lies in, -1 for none. landmarks: [33].
    """

    vertices: NDArray[np.float64]
    faces: Indices
    parent: Indices
    landmarks: Indices

    def body(self, name: str) -> Body:
        """As a body. Raises BadMesh if it is broken so far that it is none."""
        return Body(Mesh(name, self.vertices, self.faces.astype(np.int32)), self.landmarks)

    def without(self, gone: NDArray[np.bool_]) -> Broken:
        """All faces but `gone`, bool [F], and those at landmarks."""
        kept = ~gone | np.isin(self.faces, self.landmarks).any(axis=1)
        return replace(self, faces=self.faces[kept], parent=self.parent[kept])

    def grown(self, faces: Indices, parent: Indices, vertices: NDArray[np.float64] | None = None) -> Broken:
        """With more faces, and more vertices."""
        points = self.vertices if vertices is None else np.concatenate([self.vertices, vertices])
        return replace(
            self,
            vertices=points,
            faces=np.concatenate([self.faces, faces]),
            parent=np.concatenate([self.parent, parent]),
        )

    def inside(self) -> NDArray[np.bool_]:
        """True for faces that share all their edges with others, bool [F]."""
        edges = find_edges(self.faces)
        return np.asarray((edges.faces[edges.of_side] > 1).all(axis=1), np.bool_)

    def middles(self) -> NDArray[np.float64]:
        """Centres of all faces, [F, 3]."""
        middle: NDArray[np.float64] = self.vertices[self.faces].mean(axis=1)
        return middle


def sound(body: Body) -> Broken:
    """The sound body, from which every broken one is made."""
    faces = body.mesh.faces.astype(np.int64)
    return Broken(body.mesh.vertices, faces, np.arange(len(faces)), body.landmarks)


Step = Callable[[Broken, np.random.Generator], Broken]


def flaps_and_pockets(body: Broken, rng: np.random.Generator) -> Broken:
    """100 flaps, 1 cm high, and 20 patches covered by a second layer 5 mm inside: edges with three faces."""
    chosen = rng.choice(np.flatnonzero(body.inside()), 100, replace=False)
    a, b, c = np.moveaxis(body.vertices[body.faces[chosen]], 1, 0)
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    up = normal / np.where(length > 0, length, 1)  # a sliver has no height
    tips = len(body.vertices) + np.arange(100)
    flaps = np.stack([*body.faces[chosen, :2].T, tips], axis=1)
    flapped = body.grown(flaps, np.full(100, -1), (a + b) / 2 + 0.01 * up)
    inside = body.inside()
    for patch in _patches(body, rng, 20, 0.02):
        patch = patch[inside[patch]]
        layer = flapped.faces[patch]
        inner, corners, uses = np.unique(layer, return_inverse=True, return_counts=True)
        around = np.bincount(flapped.faces.ravel(), minlength=len(flapped.vertices))[inner]
        free = uses == around  # vertices of this patch alone; the others lie on its rim and are shared
        inward = flapped.vertices[inner] - 0.005 * _normals(flapped, patch)[inner]
        renumbered = np.where(free, len(flapped.vertices) + np.cumsum(free) - 1, inner)
        flapped = flapped.grown(renumbered[corners.reshape(-1, 3)], np.full(len(patch), -1), inward[free])
    return flapped


def holes(body: Broken, rng: np.random.Generator) -> Broken:
    """40 round holes of 4 cm."""
    gone = np.zeros(len(body.faces), np.bool_)
    for patch in _patches(body, rng, 40, 0.02):
        gone[patch] = True
    return body.without(gone)


def split_components(body: Broken, rng: np.random.Generator) -> Broken:
    """The surface cut through at eight heights, a ring of triangles missing at each."""
    heights = body.vertices[:, 1]
    cuts = np.linspace(heights.min(), heights.max(), 10)[1:-1] + rng.uniform(-0.01, 0.01, 8)
    level = np.searchsorted(cuts, heights[body.faces])
    return body.without((level != level[:, :1]).any(axis=1))


def unwelded_seams(body: Broken, rng: np.random.Generator) -> Broken:
    """Twelve charts that share no vertices, as texture mapping cuts them: vertices along the seams are doubled."""
    middles = body.middles()
    seeds = middles[rng.choice(len(middles), 12, replace=False)]
    chart = np.linalg.norm(middles[:, None] - seeds, axis=2).argmin(axis=1)
    corners = (body.faces * 12 + chart[:, None]).ravel()
    used, corner = np.unique(corners, return_inverse=True)
    landmarks = np.searchsorted(used // 12, body.landmarks)
    return replace(body, vertices=body.vertices[used // 12], faces=corner.reshape(-1, 3), landmarks=landmarks)


def loose_triangles(body: Broken, rng: np.random.Generator) -> Broken:
    """Every triangle with three vertices of its own, in any order, as STL files have them."""
    order = rng.permutation(len(body.faces))
    faces = body.faces[order]
    landmarks = np.array([np.flatnonzero(faces.ravel() == landmark)[0] for landmark in body.landmarks])
    return Broken(body.vertices[faces.ravel()], np.arange(faces.size).reshape(-1, 3), body.parent[order], landmarks)


def slivers(body: Broken, rng: np.random.Generator) -> Broken:
    """1 000 triangles of no height along edges, and 1 000 needles with a side of a few picometres."""
    chosen = rng.choice(len(body.faces), 2000, replace=False)
    share = np.where(np.arange(2000) < 1000, rng.uniform(0.2, 0.8, 2000), 1e-9)[:, None]
    a, b, c = body.faces[chosen].T
    middle = len(body.vertices) + np.arange(2000)
    points = (1 - share) * body.vertices[a] + share * body.vertices[b]
    faces = body.faces.copy()
    faces[chosen] = np.stack([a, middle, c], axis=1)
    split = replace(body, faces=faces)
    parent = body.parent[chosen]
    more = np.concatenate([np.stack([middle, b, c], axis=1), np.stack([a, b, middle], axis=1)])
    return split.grown(more, np.concatenate([parent, parent]), points)


def doubled_faces(body: Broken, rng: np.random.Generator) -> Broken:
    """500 faces twice, 50 more with their other side up, 50 that have a vertex twice; none of them at a rim."""
    inner = np.flatnonzero(body.inside())
    twice, turned, flat = np.split(rng.choice(inner, 600, replace=False), [500, 550])
    faces = np.concatenate([body.faces[twice], body.faces[turned][:, ::-1], body.faces[flat][:, [0, 0, 1]]])
    return body.grown(faces, np.full(600, -1))


def everything(body: Broken, rng: np.random.Generator) -> Broken:
    """All of the above but loose triangles, one after the other."""
    for step in (holes, split_components, unwelded_seams, slivers, flaps_and_pockets, doubled_faces):
        body = step(body, rng)
    return body


def scan(body: Broken, rng: np.random.Generator, triangles: int = 200_000, noise_m: float = 0.0003) -> Broken:
    """As fine as a scan: longest edges halved until there are `triangles`, then every vertex moved at random."""
    while len(body.faces) < triangles:
        body = _halved(body, triangles)
    return replace(body, vertices=body.vertices + rng.normal(0, noise_m, body.vertices.shape))


CASES: Final[dict[str, Step]] = {
    "non-manifold edges": flaps_and_pockets,
    "holes": holes,
    "split components": split_components,
    "doubled vertices: seams": unwelded_seams,
    "doubled vertices: loose triangles": loose_triangles,
    "slivers": slivers,
    "doubled faces": doubled_faces,
    "all of these": everything,
    "scan of 200 000 triangles": scan,
}
"""The broken bodies that are measured."""


def _patches(body: Broken, rng: np.random.Generator, count: int, radius_m: float) -> list[Indices]:
    """Faces around `count` random places, no face in two patches."""
    middles = body.middles()
    centres = middles[rng.choice(len(middles), count, replace=False)]
    away = np.linalg.norm(middles[:, None] - centres, axis=2)
    nearest = away.argmin(axis=1)
    return [np.flatnonzero((nearest == index) & (away[:, index] < radius_m)) for index in range(count)]


def _normals(body: Broken, faces: Indices) -> NDArray[np.float64]:
    """Unit normals [V, 3] at the vertices of `faces`; zero elsewhere."""
    corners = body.vertices[body.faces[faces]]
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(body.vertices)
    for corner in range(3):
        np.add.at(normals, body.faces[faces][:, corner], flat)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    unit: NDArray[np.float64] = normals / np.where(length > 0, length, 1)
    return unit


def _halved(body: Broken, triangles: int) -> Broken:
    """Split, at their middles, edges that are the longest of both their triangles, the longest first."""
    count, faces = len(body.vertices), body.faces
    ends = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2)
    lengths = np.linalg.norm(body.vertices[ends[..., 0]] - body.vertices[ends[..., 1]], axis=2)
    longest = lengths.argmax(axis=1)
    row = np.arange(len(faces))
    side = ends[row, longest]
    keys, edge, uses = np.unique(side.min(axis=1) * count + side.max(axis=1), return_inverse=True, return_counts=True)
    length = np.zeros(len(keys))
    length[edge] = lengths[row, longest]
    both = np.flatnonzero(uses == 2)
    both = both[np.argsort(-length[both], kind="stable")][: (triangles - len(faces) + 1) // 2]
    new = np.full(len(keys), -1)
    new[both] = count + np.arange(len(both))
    split = np.flatnonzero(new[edge] >= 0)
    a, b, c = (faces[split, (longest[split] + step) % 3] for step in range(3))
    middle = new[edge[split]]
    points = body.vertices[np.stack(np.divmod(keys[both], count), axis=1)].mean(axis=1)
    kept = faces.copy()
    kept[split] = np.stack([a, middle, c], axis=1)
    return replace(body, faces=kept).grown(np.stack([middle, b, c], axis=1), body.parent[split], points)
