"""The open body fitted to a mesh: its landmarks on the mesh, and points of the mesh carried back to the open body."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from bodyseg_data.bodies.landmark_fitting.fit import Fit, fitted_points
from bodyseg_data.bodies.landmark_fitting.surface import FEATURE, SurfacePoints
from bodyseg_data.bodies.landmark_fitting.template import FittingBody
from bodyseg_data.core.errors import BadMesh
from bodyseg_data.core.parts import PART_COUNT
from bodyseg_data.meshes.landmarks.by_vertex import LandmarkSet
from bodyseg_data.meshes.mesh import Mesh

POOR_M: Final = 0.045
"""Gap of a fit above which it is poor, metres: of bare bodies 3 to 4 cm with every limb in place, 4 to 6 without."""

_GAP_SHARE: Final = 0.99
_NORMAL_REACH_M: Final = 0.06  # a surface turned by a right angle counts as 1.4 times this away from a landmark


@dataclass(frozen=True)
class Proposal:
    """Landmarks for a person to check. distance_m: float64 [33], from the fitted body's landmark to the vertex.

    gap_m: the fit's, see `FittedBody`.
    """

    landmarks: LandmarkSet
    distance_m: NDArray[np.float64]
    gap_m: float = 0.0

    @property
    def poor(self) -> bool:
        """True if the fitted body is so far from the surface in places that limbs may be in the wrong place."""
        return self.gap_m > POOR_M


@dataclass(frozen=True)
class FittedBody:
    """The open body fitted to `mesh`. gap_m: the distance to the mesh that 99 % of the fitted body's points keep."""

    mesh: Mesh
    body: FittingBody
    fit: Fit
    gap_m: float

    def proposal(self, vertices: NDArray[np.int64]) -> Proposal:
        """Return the landmarks of the mesh, those of the open body being at its `vertices` [33].

        Raises BadMesh for a mesh whose largest piece has fewer than 33 vertices.
        """
        positions, normals = fitted_points(self.body, self.fit, self.body.whole.at(vertices))
        found, distance = _on_surface(self.mesh, largest_piece(self.mesh), positions, normals)
        topology = f"meshes numbered like {self.mesh.name}; proposed, to be checked"
        counts = len(self.mesh.vertices), len(self.mesh.faces)
        landmarks = LandmarkSet("proposed", topology, *counts, tuple(found.tolist()))
        return Proposal(landmarks, distance, self.gap_m)

    def carried(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return where `points` [N, 3] on the mesh lie on the open body at rest, float64 [N, 3], body frame, metres.

        Each goes to the nearest vertex of the fitted body that faces the same way.
        """
        from scipy.spatial import KDTree

        among = self.body.skin
        own, normals = fitted_points(self.body, self.fit, self.body.whole.at(among))
        used = np.unique(self.mesh.faces)
        facing = self.mesh.vertex_normals[used[KDTree(self.mesh.vertices[used]).query(points)[1]]]
        tree = KDTree(np.concatenate([own, _NORMAL_REACH_M * normals], axis=1))
        nearest = among[tree.query(np.concatenate([points, _NORMAL_REACH_M * facing], axis=1))[1]]
        rest: NDArray[np.float64] = self.body.mesh.vertices[nearest]
        return rest

    def upright(self, offsets: NDArray[np.float64], vertices: NDArray[np.int64]) -> NDArray[np.float64]:
        """Turn `offsets` [N, 3] at `vertices` [N] of the fitted body as they are on the body at rest, in its frame."""
        skin = self.body.whole.at(vertices)
        with torch.inference_mode():
            motions = self.body.bone_motions(self.fit.turns(self.body)[None], self.fit.shape[None])
            blend = (skin.weights @ motions.flatten(2)).reshape(-1, 3, 4)[..., :3].numpy()
        left, _, right = np.linalg.svd(blend)  # the rotation nearest to a blend of rotations, which itself shrinks
        turned: NDArray[np.float64] = np.einsum("nij,ni->nj", left @ right, offsets)
        return turned


def gap_m(target: SurfacePoints, own: SurfacePoints) -> float:
    """Return the distance to the points of `target` that 99 % of the points of the fitted body keep, metres."""
    from scipy.spatial import KDTree

    return float(np.quantile(KDTree(target.positions).query(own.positions)[0], _GAP_SHARE))


def largest_piece(mesh: Mesh) -> NDArray[np.int64]:
    """Return the vertices of the piece with the largest area. Raises BadMesh for fewer than 33, MissingLibrary."""
    piece = mesh.pieces(FEATURE)
    area = np.bincount(piece[mesh.faces[:, 0]], np.linalg.norm(mesh.normals, axis=1))
    used = np.unique(mesh.faces).astype(np.int64)
    largest: NDArray[np.int64] = used[piece[used] == area.argmax()]
    if len(largest) < PART_COUNT:
        raise BadMesh(
            f"mesh {mesh.name}: a body needs {PART_COUNT} vertices for its landmarks, found {len(largest)} in its "
            "largest piece"
        )
    return largest


def _on_surface(
    mesh: Mesh, among: NDArray[np.int64], positions: NDArray[np.float64], normals: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return for each of 33 positions and normals [33, 3] a different vertex of `among`, and its distance, metres."""
    from scipy.spatial import KDTree

    facing = mesh.vertex_normals[among]
    tree = KDTree(np.concatenate([mesh.vertices[among], _NORMAL_REACH_M * facing], axis=1))
    # As many candidates as there are landmarks: one is always left.
    nearest = tree.query(np.concatenate([positions, _NORMAL_REACH_M * normals], axis=1), PART_COUNT)[1]
    chosen: list[int] = []
    for candidates in among[nearest].tolist():
        chosen.append(next(vertex for vertex in candidates if vertex not in chosen))
    vertices = np.array(chosen, np.int64)
    return vertices, np.linalg.norm(mesh.vertices[vertices] - positions, axis=1)
