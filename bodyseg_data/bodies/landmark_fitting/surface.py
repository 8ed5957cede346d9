"""Points of a surface with their normals and mean geodesic distances, as landmark fitting matches them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.meshes.mesh import Mesh

FEATURE: Final = "proposing landmarks"

_CELL_M: Final = 0.01  # finer details change no distance across a body, and doubled vertices and cracks close
_SOURCES: Final = 24


@dataclass(frozen=True)
class SurfacePoints:
    """Points of a surface. positions: float64 [N, 3], metres; normals: [N, 3], outwards; mean_geodesic: [N]."""

    positions: NDArray[np.float64]
    normals: NDArray[np.float64]
    mean_geodesic: NDArray[np.float64]

    def thinned(self, count: int) -> SurfacePoints:
        """Return every n-th point, at least `count` of them if there are as many."""
        step = max(1, len(self.positions) // count)
        return SurfacePoints(self.positions[::step], self.normals[::step], self.mean_geodesic[::step])

    def first(self, count: int) -> SurfacePoints:
        """Return the first `count` points."""
        return SurfacePoints(self.positions[:count], self.normals[:count], self.mean_geodesic[:count])


def sample_surface(mesh: Mesh, count: int) -> SurfacePoints:
    """Sample `count` points evenly by area, the same ones for the same mesh."""
    double_areas = np.linalg.norm(mesh.normals, axis=1)
    filled = np.cumsum(double_areas)
    faces = np.searchsorted(filled, (np.arange(count) + 0.5) / count * filled[-1])
    # Positions within the triangles: a sequence that fills the square evenly (Roberts 2018), folded into a triangle.
    u, v = (np.arange(count)[:, None] * (0.7548776662466927, 0.5698402909980532) % 1).T
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces[faces]], 1, 0)
    positions = a + u[:, None] * (b - a) + v[:, None] * (c - a)
    normals = mesh.normals[faces] / double_areas[faces, None]
    return SurfacePoints(positions, normals, mean_geodesic(mesh)[mesh.faces[faces, 0]])


def mean_geodesic(mesh: Mesh) -> NDArray[np.float64]:
    """Mean geodesic distance of every vertex to points all over the body, divided by its mean, float64 [V].

    About 0.8 on the trunk and 1.7 at hands and feet, in any posture (Hilaga et al., Topology matching for fully
    automatic similarity estimation of 3D shapes, SIGGRAPH 2001). Distances run along the edges between cells of a
    centimetre; pieces other than the largest take the value of its nearest point.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components, dijkstra
    from scipy.spatial import KDTree

    cells = np.floor(mesh.vertices / _CELL_M).astype(np.int64)
    cell = np.unique(cells, axis=0, return_inverse=True)[1].reshape(-1)
    positions = np.stack([np.bincount(cell, axis) for axis in mesh.vertices.T], axis=1) / np.bincount(cell)[:, None]
    ends = cell[mesh.faces[:, [0, 1, 1, 2, 2, 0]]].reshape(-1, 2)
    ends = np.unique(np.sort(ends[ends[:, 0] != ends[:, 1]], axis=1), axis=0)
    lengths = np.linalg.norm(positions[ends[:, 0]] - positions[ends[:, 1]], axis=1)
    graph = coo_array((lengths, ends.T), shape=(len(positions), len(positions))).tocsr()
    piece = connected_components(graph, directed=False)[1]
    area = np.bincount(cell[mesh.faces[:, 0]], np.linalg.norm(mesh.normals, axis=1), len(positions))
    main = np.flatnonzero(piece == np.bincount(piece, area).argmax())
    away = np.zeros(len(positions))
    away[main] = dijkstra(graph, directed=False, indices=main[farthest(positions[main], _SOURCES)]).mean(axis=0)[main]
    away /= np.average(away[main], weights=area[main])
    nearest: NDArray[np.int64] = main[KDTree(positions[main]).query(positions)[1]]
    return away[nearest[cell]]


def farthest(points: NDArray[np.float64], count: int) -> NDArray[np.int64]:
    """Return indices of at most `count` of `points` [N, 3], each farthest from those before it (Gonzalez 1985)."""
    chosen = np.zeros(min(count, len(points)), np.int64)
    away = np.full(len(points), np.inf)
    x, y, z = np.ascontiguousarray(points.T)  # a sum along rows of three would take most of the time
    for number in range(1, len(chosen)):
        last = chosen[number - 1]
        away = np.minimum(away, (x - x[last]) ** 2 + (y - y[last]) ** 2 + (z - z[last]) ** 2)
        chosen[number] = away.argmax()
    return chosen
