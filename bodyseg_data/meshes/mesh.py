"""The immutable triangle mesh of one body, checked once when it is constructed, and its edges and components.

Body frame: x to the subject's left, y up, z to the front; metres.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadMesh
from bodyseg_data.machine import required

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]

HEIGHT_RANGE_M: Final = (0.5, 2.5)
"""A body's largest extent must lie in this range, which catches millimetres, centimetres and inches."""

_SLIGHT_VOLUME_M3: Final = 1e-5  # a hundredth of a litre: a flat piece, like an eyelid, may enclose as little as that


@dataclass(frozen=True)
class Edges:
    """The edges of a triangle mesh, each once. ends: int64 [E, 2], the lower vertex first. faces: int64 [E], number of
    faces at the edge. of_side: int64 [F, 3], index of the edge from corner k to k + 1 of each face.
    """

    ends: Indices
    faces: Indices
    of_side: Indices

    def lengths(self, vertices: Floats) -> Floats:
        """Lengths of all edges, float64 [E], metres. vertices: [V, 3]."""
        length: Floats = np.linalg.norm(vertices[self.ends[:, 0]] - vertices[self.ends[:, 1]], axis=1)
        return length

    def two_sides(self) -> Indices:
        """Pairs of sides of all edges with two faces, int64 [N, 2], edge by edge; a side is 3 * face + k."""
        side = self.of_side.ravel()
        two = np.flatnonzero(self.faces[side] == 2)
        return two[np.argsort(side[two], kind="stable")].reshape(-1, 2)


def check_arrays(where: str, vertices: NDArray[Any], faces: NDArray[Any], check_unused: bool = True) -> None:
    """Raise BadMesh, beginning with `where`, unless the arrays are those of a mesh.

    vertices: float [V, 3], V > 0, finite; those that no face uses need not be unless `check_unused`. faces: int [F, 3],
    F > 0, 0 to V - 1.
    """
    if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
        raise BadMesh(f"{where}: vertices and faces must have three columns, found {vertices.shape}, {faces.shape}")
    if len(vertices) == 0 or len(faces) == 0:
        raise BadMesh(f"{where}: a mesh needs vertices and faces, found {len(vertices)} and {len(faces)}")
    if not np.issubdtype(faces.dtype, np.integer):
        raise BadMesh(f"{where}: faces must be whole numbers, found {faces.dtype}")
    bad = np.flatnonzero((faces < 0).any(axis=1) | (faces >= len(vertices)).any(axis=1))
    if len(bad):
        found = f"{faces[bad[0]].tolist()} at face {bad[0]}"
        raise BadMesh(f"{where}: faces must use vertices 0 to {len(vertices) - 1}, found {found}")
    checked = np.full(len(vertices), check_unused)
    checked[faces] = True
    bad = np.flatnonzero(checked & ~np.isfinite(vertices).all(axis=1))
    if len(bad):
        raise BadMesh(f"{where}: coordinates must be finite, found {vertices[bad[0]].tolist()} at vertex {bad[0]}")


def find_edges(faces: NDArray[Any]) -> Edges:
    """Find the edges of `faces` [F, 3]. A face with a repeated vertex has an edge from that vertex to itself."""
    start, end = faces.astype(np.int64), np.roll(faces, -1, axis=1).astype(np.int64)
    stride = int(faces.max(initial=0)) + 1
    keys = (np.minimum(start, end) * stride + np.maximum(start, end)).ravel()
    keys, of_side, count = np.unique(keys, return_inverse=True, return_counts=True)
    return Edges(np.stack(np.divmod(keys, stride), axis=1), count, of_side.reshape(-1, 3))


def face_components(count: int, faces: NDArray[np.integer[Any]]) -> NDArray[np.int32]:
    """Connected piece of the surface `faces` [F, 3] that each of `count` vertices belongs to; see `components`.

    Two edges of a triangle connect its three vertices.
    """
    return components(count, faces[:, [0, 1, 1, 2]].reshape(-1, 2))


def components(count: int, pairs: NDArray[np.integer[Any]]) -> NDArray[np.int32]:
    """Connected component of each node of a graph, int32 [count]. pairs: [N, 2], its edges, as indices of nodes.

    Raises MissingLibrary without scipy. Every `Mesh` comes past here, so whoever has one has scipy.
    """
    sparse, graphs = (required(name, "checking a mesh") for name in ("scipy.sparse", "scipy.sparse.csgraph"))
    links = sparse.coo_array((np.ones(len(pairs), np.bool_), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    component: NDArray[np.int32] = graphs.connected_components(links, directed=False)[1]
    return component


@dataclass(frozen=True, eq=False)
class Mesh:
    """The surface of a body. Both arrays are copied and read-only.

    vertices: float64 [V, 3], metres, body frame.
    faces: int32 [F, 3], vertex indices in such an order that normals point outwards by the right-hand rule.
    Raises BadMesh, naming the mesh, for: no vertices or faces, coordinates that are not finite, indices outside the
    vertices, a largest extent outside 0.5 to 2.5 m, faces that point inwards or disagree with their neighbours.
    """

    name: str
    vertices: Floats
    faces: NDArray[np.int32]

    _kind: ClassVar[str] = "body"
    _range_m: ClassVar[tuple[float, float]] = HEIGHT_RANGE_M
    _remedy: ClassVar[str] = ""

    def __repr__(self) -> str:
        return f"Mesh({self.name!r}, {len(self.vertices)} vertices, {len(self.faces)} faces)"

    def __post_init__(self) -> None:
        vertices: Floats = np.asarray(self.vertices, np.float64)
        faces: NDArray[Any] = np.asarray(self.faces)
        check_arrays(f"mesh {self.name}", vertices, faces)
        for field, array in (("vertices", vertices), ("faces", faces.astype(np.int32))):
            frozen = np.ascontiguousarray(array).copy()
            frozen.flags.writeable = False
            object.__setattr__(self, field, frozen)
        extent, (low, high) = float(np.ptp(self.surface_vertices, axis=0).max()), self._range_m
        if not low <= extent <= high:
            rule = f"a {self._kind} must be {low:g} to {high:g} m at its largest"
            raise BadMesh(f"mesh {self.name}: {rule}, found {extent:.3g} m{self._remedy}")
        self._check_orientation()

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Make a copy's arrays read-only, as of a mesh that came from another process: pickled ones are not."""
        vars(self).update(state)
        self.vertices.flags.writeable = self.faces.flags.writeable = False

    def _check_orientation(self) -> None:
        """Raise BadMesh unless neighbours agree and the whole and each closed piece enclose a positive volume.

        Open pieces are not judged one by one: the cavity of a mouth, cut off, would seem inside out.
        """
        edges = find_edges(self.faces)
        forwards = np.where(self.faces < np.roll(self.faces, -1, axis=1), 1, -1)
        balance = np.bincount(edges.of_side.ravel(), weights=forwards.ravel())
        proper = edges.ends[:, 0] != edges.ends[:, 1]  # not from a vertex to itself
        clashes = edges.ends[(edges.faces == 2) & (balance != 0) & proper]
        if len(clashes):
            raise BadMesh(f"mesh {self.name}: neighbouring faces must agree, found a clash at {clashes[0].tolist()}")
        whole, lowest = self.signed_volume(), self._lowest_closed_volume(edges)
        if whole <= 0 or lowest < -_SLIGHT_VOLUME_M3:
            raise BadMesh(f"mesh {self.name}: faces must point outwards, found {min(whole, lowest):.3g} m3 inside")

    def signed_volume(self) -> float:
        """Enclosed volume, m3, measured about the mean vertex; negative if faces point inwards."""
        return float(signed_volumes(self.vertices[self.faces] - self.surface_vertices.mean(axis=0)).sum())

    def _lowest_closed_volume(self, edges: Edges) -> float:
        """Smallest signed volume, m3, of all closed connected pieces; infinite if no piece is closed."""
        piece = self.pieces()
        closed = np.ones(piece.max() + 1, np.bool_)
        closed[piece[edges.ends[edges.faces == 1, 0]]] = False
        faces = self.faces[closed[piece[self.faces[:, 0]]]]
        owner = piece[faces[:, 0]]
        # Measured about one vertex of each piece: far from the piece, rounding would exceed its volume.
        first = np.unique(piece, return_index=True)[1]
        corners = self.vertices[faces] - self.vertices[first[owner]][:, None]
        volumes = np.bincount(owner, weights=signed_volumes(corners))
        return float(min(volumes[np.unique(owner)], default=np.inf))

    def pieces(self) -> NDArray[np.int32]:
        """Index of the connected piece of the surface that each vertex belongs to, int32 [V]."""
        return face_components(len(self.vertices), self.faces)

    @cached_property
    def surface_vertices(self) -> Floats:
        """The vertices that faces use, float64 [N, 3], metres."""
        return self.vertices[np.bincount(self.faces.ravel(), minlength=len(self.vertices)) > 0]

    @cached_property
    def centre(self) -> Floats:
        """Centre of the surface's bounding box, float64 [3], metres."""
        middle: Floats = (self.surface_vertices.min(axis=0) + self.surface_vertices.max(axis=0)) / 2
        return middle

    @cached_property
    def normals(self) -> Floats:
        """Outward normals of all faces, float64 [F, 3]; length twice the face's area, 0 if degenerate."""
        return face_normals(self.vertices, self.faces)

    @cached_property
    def vertex_normals(self) -> Floats:
        """Area-weighted mean normals of the faces at each vertex, float64 [V, 3], unit length; zero without faces."""
        return vertex_normals(self.vertices, self.faces)

    def barycentric(self, faces: NDArray[np.int32], points: Floats) -> Floats:
        """Barycentric weights [N, 3] of points [N, 3] in the planes of their triangles (Ericson 2005, section 3.4)."""
        a, b, c = np.moveaxis(self.vertices[self.faces[faces]], 1, 0)
        ab, ac, ap = b - a, c - a, points - a
        aa, bb, ab_ac = (np.einsum("ij,ij->i", x, y) for x, y in ((ab, ab), (ac, ac), (ab, ac)))
        p_ab, p_ac = np.einsum("ij,ij->i", ap, ab), np.einsum("ij,ij->i", ap, ac)
        area = aa * bb - ab_ac**2
        area[area == 0] = 1  # a degenerate triangle: any corner is as good
        v, w = (bb * p_ab - ab_ac * p_ac) / area, (aa * p_ac - ab_ac * p_ab) / area
        return np.stack([1 - v - w, v, w], axis=1)


@dataclass(frozen=True, eq=False, repr=False)
class SceneMesh(Mesh):
    """Surfaces of a scene, in the frame of bodies, with their labels. They need be neither closed nor of one piece, and
    whichever side of a triangle is seen counts as its outside.

    labels: uint8 [F, 3], at the corners of triangles; 255 without a class. Where they differ, a point has that of the
    corner with the largest barycentric weight: a border crosses triangles half way between their vertices. middle:
    float64 [3], metres, the point that views aim at; None: the centre of the bounding box.

    Raises BadMesh as `Mesh` does, but for other extents, 2 cm to 100 m, and not for the order of corners.
    """

    labels: NDArray[np.uint8]
    middle: Floats | None = None

    _kind = "scene"
    _range_m = (0.02, 100.0)
    _remedy = " (--units gives the unit of its files)"

    def _check_orientation(self) -> None:
        """Any order of corners will do."""

    def corners(self, _: Mesh) -> NDArray[np.uint8]:
        """Labels at the corners of all triangles, uint8 [F, 3]."""
        return self.labels

    def labels_at(self, _: Mesh, faces: NDArray[np.int32], points: Floats) -> NDArray[np.uint8]:
        """Labels of `points` [N, 3], metres, in the triangles `faces` [N], uint8 [N]."""
        nearest: NDArray[np.uint8] = self.labels[faces, self.barycentric(faces, points).argmax(axis=1)]
        return nearest

    @cached_property
    def centre(self) -> Floats:
        """Point that views aim at, float64 [3], metres."""
        return super().centre if self.middle is None else self.middle


def face_normals(vertices: Floats, faces: NDArray[np.integer[Any]]) -> Floats:
    """Normals of triangles, float64 [F, 3], by the right-hand rule; length twice the triangle's area."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    return np.cross(b - a, c - a)


def vertex_normals(vertices: Floats, faces: NDArray[np.integer[Any]]) -> Floats:
    """Unit normals of vertices, float64 [V, 3], of the faces at each weighted by area; zero without faces."""
    across = face_normals(vertices, faces)
    sums = [np.bincount(faces.ravel(), np.repeat(across[:, axis], 3), len(vertices)) for axis in range(3)]
    normals = np.stack(sums, axis=1)
    units: Floats = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-15)
    return units


def signed_volumes(corners: Floats) -> Floats:
    """Signed volumes [F], m3, of the tetrahedra between the origin and triangles [F, 3, 3]."""
    volumes: Floats = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    return volumes
