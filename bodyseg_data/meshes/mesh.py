"""The immutable triangle mesh of one body, checked once when it is constructed.

Body frame: x to the subject's left, y up, z to the front; metres.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadMesh
from bodyseg_data.meshes.topology import check_arrays, face_components, find_edges

HEIGHT_RANGE_M: Final = (0.5, 2.5)
"""A body's largest extent must lie in this range, which catches millimetres, centimetres and inches."""


_SLIGHT_VOLUME_M3: Final = 1e-5  # a hundredth of a litre: a flat piece, like an eyelid, may enclose as little as that


@dataclass(frozen=True)
class Mesh:
    """The surface of a body. vertices: float64 [V, 3], metres, body frame. faces: int32 [F, 3], vertex indices, ordered
    so that normals point outwards by the right-hand rule. Both arrays are copied and read-only.

    Raises BadMesh, naming the mesh, for: no vertices or faces, coordinates that are not finite, indices outside the
    vertices, a largest extent outside 0.5 to 2.5 m, faces that point inwards or disagree with their neighbours.
    """

    name: str
    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]

    def __repr__(self) -> str:
        return f"Mesh({self.name!r}, {len(self.vertices)} vertices, {len(self.faces)} faces)"

    def __post_init__(self) -> None:
        vertices: NDArray[np.float64] = np.asarray(self.vertices, np.float64)
        faces: NDArray[Any] = np.asarray(self.faces)
        check_arrays(f"mesh {self.name}", vertices, faces)
        self._check_extent(vertices, faces)
        for field, array in (("vertices", vertices), ("faces", faces.astype(np.int32))):
            frozen = np.ascontiguousarray(array).copy()
            frozen.flags.writeable = False
            object.__setattr__(self, field, frozen)
        self._check_orientation()

    def _check_extent(self, vertices: NDArray[np.float64], faces: NDArray[Any]) -> None:
        extent = float(np.ptp(vertices[np.unique(faces)], axis=0).max())
        low, high = HEIGHT_RANGE_M
        if not low <= extent <= high:
            raise BadMesh(f"mesh {self.name}: a body must be {low} to {high} m at its largest, found {extent:.3g} m")

    def _check_orientation(self) -> None:
        """Raise BadMesh unless neighbours agree and the whole and each closed piece enclose a positive volume.

        Open pieces are not judged one by one: the cavity of a mouth, cut off, would seem inside out.
        """
        clash = self._clashing_edge()
        if clash is not None:
            raise BadMesh(
                f"mesh {self.name}: neighbouring faces must agree on their outside, found faces that clash at the edge "
                f"of vertices {clash[0]} and {clash[1]}"
            )
        whole, lowest = self.signed_volume(), self._lowest_closed_volume()
        if whole <= 0 or lowest < -_SLIGHT_VOLUME_M3:
            raise BadMesh(
                f"mesh {self.name}: faces must point outwards, found a signed volume of {min(whole, lowest):.3g} m3 "
                "(inside out?)"
            )

    def _clashing_edge(self) -> tuple[int, int] | None:
        """The vertices of an edge that exactly two faces share and traverse in the same direction; None without one."""
        edges = find_edges(self.faces)
        forwards = np.where(self.faces < np.roll(self.faces, -1, axis=1), 1, -1)
        balance = np.bincount(edges.of_side.ravel(), weights=forwards.ravel())
        proper = edges.ends[:, 0] != edges.ends[:, 1]  # not from a vertex to itself
        bad = np.flatnonzero((edges.faces == 2) & (balance != 0) & proper)
        return None if not len(bad) else (int(edges.ends[bad[0], 0]), int(edges.ends[bad[0], 1]))

    def signed_volume(self) -> float:
        """Enclosed volume, m3, measured about the mean vertex; negative if faces point inwards."""
        return float(signed_volumes(self.vertices[self.faces] - self.surface_vertices.mean(axis=0)).sum())

    def _lowest_closed_volume(self) -> float:
        """Smallest signed volume, m3, of all closed connected pieces; infinite if no piece is closed."""
        edges = find_edges(self.faces)
        piece = self.pieces("checking a mesh")
        closed = np.ones(piece.max() + 1, np.bool_)
        closed[piece[edges.ends[edges.faces == 1, 0]]] = False
        faces = self.faces[closed[piece[self.faces[:, 0]]]]
        if not len(faces):
            return np.inf
        numbers, piece_of_face = np.unique(piece[faces[:, 0]], return_inverse=True)
        # Measured about one vertex of each piece: far from the piece, rounding would exceed its volume.
        origin = self.vertices[np.unique(piece, return_index=True)[1][numbers]]
        corners = self.vertices[faces] - origin[piece_of_face][:, None]
        return float(np.bincount(piece_of_face, weights=signed_volumes(corners)).min())

    def pieces(self, feature: str) -> NDArray[np.int32]:
        """Index of the connected piece of the surface that each vertex belongs to, int32 [V].

        feature: the feature that the message names. Raises MissingLibrary without scipy.
        """
        return face_components(len(self.vertices), self.faces, feature)

    @cached_property
    def surface_vertices(self) -> NDArray[np.float64]:
        """The vertices that faces use, float64 [N, 3], metres."""
        return self.vertices[np.unique(self.faces)]

    @cached_property
    def centre(self) -> NDArray[np.float64]:
        """Centre of the surface's bounding box, float64 [3], metres."""
        middle: NDArray[np.float64] = (self.surface_vertices.min(axis=0) + self.surface_vertices.max(axis=0)) / 2
        return middle

    @cached_property
    def normals(self) -> NDArray[np.float64]:
        """Outward normals of all faces, float64 [F, 3]; length twice the face's area, 0 if degenerate."""
        corners = self.vertices[self.faces]
        return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])

    @cached_property
    def vertex_normals(self) -> NDArray[np.float64]:
        """Area-weighted mean normals of the faces at each vertex, float64 [V, 3], unit length; zero without faces."""
        normals = np.zeros_like(self.vertices)
        for corner in range(3):
            np.add.at(normals, self.faces[:, corner], self.normals)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        np.divide(normals, length, out=normals, where=length > 0)
        return normals

    def barycentric(self, faces: NDArray[np.int32], points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Barycentric weights [N, 3] of points [N, 3] in the planes of their triangles (Ericson 2005, section 3.4)."""
        a, b, c = np.moveaxis(self.vertices[self.faces[faces]], 1, 0)
        ab, ac, ap = b - a, c - a, points - a
        aa, bb, ab_ac = (np.einsum("ij,ij->i", x, y) for x, y in ((ab, ab), (ac, ac), (ab, ac)))
        p_ab, p_ac = np.einsum("ij,ij->i", ap, ab), np.einsum("ij,ij->i", ap, ac)
        area = aa * bb - ab_ac**2
        area[area == 0] = 1  # a degenerate triangle: any corner is as good
        v, w = (bb * p_ab - ab_ac * p_ac) / area, (aa * p_ac - ab_ac * p_ab) / area
        return np.stack([1 - v - w, v, w], axis=1)


def signed_volumes(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Signed volumes [F], m3, of the tetrahedra between the origin and triangles [F, 3, 3]."""
    volumes: NDArray[np.float64] = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    return volumes
