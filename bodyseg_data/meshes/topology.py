"""Arrays of triangle meshes: their checks, edges and connected components."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadMesh
from bodyseg_data.core.system.libraries import missing_library


@dataclass(frozen=True)
class Edges:
    """The edges of a triangle mesh, each once. ends: int64 [E, 2], the lower vertex first. faces: int64 [E], number of
    faces at the edge. of_side: int64 [F, 3], index of the edge from corner k to k + 1 of each face.
    """

    ends: NDArray[np.int64]
    faces: NDArray[np.int64]
    of_side: NDArray[np.int64]

    def lengths(self, vertices: NDArray[np.float64]) -> NDArray[np.float64]:
        """Lengths of all edges, float64 [E], metres. vertices: [V, 3]."""
        length: NDArray[np.float64] = np.linalg.norm(vertices[self.ends[:, 0]] - vertices[self.ends[:, 1]], axis=1)
        return length

    def two_sides(self) -> NDArray[np.int64]:
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


def face_components(count: int, faces: NDArray[np.integer[Any]], feature: str) -> NDArray[np.int32]:
    """Connected piece of the surface `faces` [F, 3] that each of `count` vertices belongs to; see `components`.

    Two edges of a triangle connect its three vertices.
    """
    return components(count, faces[:, [0, 1, 1, 2]].reshape(-1, 2), feature)


def components(count: int, pairs: NDArray[np.integer[Any]], feature: str) -> NDArray[np.int32]:
    """Connected component of each node of a graph, int32 [count]. pairs: [N, 2], its edges, as indices of nodes.

    feature: the feature that the message names. Raises MissingLibrary without scipy.
    """
    try:
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components
    except ImportError as error:
        raise missing_library(feature, error) from error
    links = coo_array((np.ones(len(pairs), np.bool_), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    component: NDArray[np.int32] = connected_components(links, directed=False)[1]
    return component
