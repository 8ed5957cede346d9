"""The frozen triangle mesh of one body, checked once when it is made.

Body frame: x to the subject's left, y up, z to the front; metres.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.errors import BadMesh

HEIGHT_RANGE_M: Final = (0.5, 2.5)
"""A body's largest extent must lie in this range, which catches millimetres, centimetres and inches."""


@dataclass(frozen=True)
class Mesh:
    """A body's surface. vertices: float64 [V, 3], metres, body frame; faces: int32 [F, 3], outward by right hand.

    Raises BadMesh, naming the mesh, for: no vertices or faces, coordinates that are not finite, indices outside the
    vertices, a body not 0.5 to 2.5 m in its largest extent, faces that point inwards.
    """

    name: str
    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]

    def __post_init__(self) -> None:
        vertices: NDArray[np.float64] = np.asarray(self.vertices, np.float64)
        faces: NDArray[Any] = np.asarray(self.faces)
        self._check(vertices, faces)
        for field, array in (("vertices", vertices), ("faces", faces.astype(np.int32))):
            frozen = np.ascontiguousarray(array).copy()
            frozen.flags.writeable = False
            object.__setattr__(self, field, frozen)
        self._check_orientation()

    def _check(self, vertices: NDArray[np.float64], faces: NDArray[Any]) -> None:
        where = f"mesh {self.name}"
        if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
            raise BadMesh(f"{where}: vertices and faces must have three columns, found {vertices.shape}, {faces.shape}")
        if len(vertices) == 0 or len(faces) == 0:
            raise BadMesh(f"{where}: a body needs vertices and faces, found {len(vertices)} and {len(faces)}")
        if not np.issubdtype(faces.dtype, np.integer):
            raise BadMesh(f"{where}: faces must be whole numbers, found {faces.dtype}")
        bad = np.flatnonzero(~np.isfinite(vertices).all(axis=1))
        if len(bad):
            raise BadMesh(f"{where}: coordinates must be finite, found {vertices[bad[0]].tolist()} at vertex {bad[0]}")
        bad = np.flatnonzero((faces < 0).any(axis=1) | (faces >= len(vertices)).any(axis=1))
        if len(bad):
            raise BadMesh(
                f"{where}: faces must use vertices 0 to {len(vertices) - 1}, found {faces[bad[0]].tolist()} "
                f"at face {bad[0]}"
            )
        extent = float(np.ptp(vertices[np.unique(faces)], axis=0).max())
        low, high = HEIGHT_RANGE_M
        if not low <= extent <= high:
            raise BadMesh(f"{where}: a body must be {low} to {high} m at its largest, found {extent:.3g} m")

    def _check_orientation(self) -> None:
        volume = self.signed_volume()
        if volume <= 0:
            raise BadMesh(
                f"mesh {self.name}: faces must point outwards, found a signed volume of {volume:.3g} m3 (inside out?)"
            )

    def signed_volume(self) -> float:
        """Volume enclosed, m3, by the divergence theorem about the centre; negative if faces point inwards."""
        corners = self.vertices[self.faces] - self.centre
        return float(np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6)

    @property
    def centre(self) -> NDArray[np.float64]:
        """Centre [3] of the bounding box of the surface."""
        used = self.vertices[np.unique(self.faces)]
        middle: NDArray[np.float64] = (used.min(axis=0) + used.max(axis=0)) / 2
        return middle

    def normals(self) -> NDArray[np.float64]:
        """Outward normals of all faces, [F, 3]; length twice the face's area, zero for a degenerate face."""
        corners = self.vertices[self.faces]
        return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])

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
