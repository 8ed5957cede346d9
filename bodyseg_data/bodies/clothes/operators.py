"""Sparse linear operators on a triangle mesh, used to compute cloth."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Faces = NDArray[np.int64]


class Smoother:
    """Smooths positions over a given length, for triangles of any size; vertices that are not free stay fixed.

    Solves (M + t^4 L M^-1 L) x = M x0, with L the cotangent Laplacian at rest: implicit fairing (Desbrun et al. 1999)
    of second order, which shrinks limbs far less than the first order.
    """

    def __init__(self, points: Floats, faces: Faces, free: NDArray[np.bool_], length_m: float) -> None:
        from scipy.sparse import diags
        from scipy.sparse.linalg import splu

        laplacian, mass = cotangent_laplacian(points, faces, np.zeros(len(points), np.int64))
        system = (diags(mass) + length_m**4 * laplacian @ diags(1 / mass) @ laplacian).tocsr()
        self._free, self._mass = free, mass[free, None]
        self._solver = splu(system[free][:, free].tocsc())
        self._held = system[free][:, ~free]

    def __call__(self, points: Floats) -> Floats:
        """Return positions [N, 3], smoothed."""
        smooth = points.copy()
        smooth[self._free] = self._solver.solve(self._mass * points[self._free] - self._held @ points[~self._free])
        return smooth


def diffused(values: Floats, points: Floats, faces: Faces, group: NDArray[np.int64], length_m: float) -> Floats:
    """Diffuse values [N] over a length within each group of vertices, by one step of heat: (M + t^2 L) x = M x0."""
    from scipy.sparse import diags
    from scipy.sparse.linalg import splu

    laplacian, mass = cotangent_laplacian(points, faces, group)
    return np.asarray(splu((diags(mass) + length_m**2 * laplacian).tocsc()).solve(mass * values), np.float64)


def cotangent_laplacian(points: Floats, faces: Faces, group: NDArray[np.int64]) -> tuple[Any, Floats]:
    """Return the sparse Laplacian [N, N], linking vertices of one group only, and the surface area [N] at each vertex.

    Weights of obtuse corners are lifted to a small positive one, so that no value leaves the range of its neighbours.
    """
    from scipy.sparse import csr_matrix, diags

    count = len(points)
    rows, columns, values = [], [], []
    mass = np.zeros(count)
    for corner in range(3):
        i, j, k = (faces[:, (corner + step) % 3] for step in range(3))
        u, v = points[j] - points[i], points[k] - points[i]
        area = np.linalg.norm(np.cross(u, v), axis=1)
        cotangent = np.clip(np.einsum("ij,ij->i", u, v) / np.maximum(area, 1e-12), 0.02, 20) / 2
        linked = np.where(group[j] == group[k], cotangent, 0.0)
        rows += [j, k]
        columns += [k, j]
        values += [linked, linked]
        mass += np.bincount(i, weights=area / 6, minlength=count)
    links = csr_matrix((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=(count,) * 2)
    return diags(np.asarray(links.sum(axis=1)).ravel()) - links, mass


def patch(faces: NDArray[np.int32], covered: NDArray[np.bool_]) -> tuple[NDArray[np.int64], Faces]:
    """Return the covered vertices and two rings around them [N], and their faces [F, 3] in that numbering."""
    wide = covered
    for _ in range(2):
        touched = faces[wide[faces].any(axis=1)]
        wide = np.zeros_like(covered)
        wide[touched] = True
    numbers = np.cumsum(wide) - 1
    return np.flatnonzero(wide), numbers[faces[wide[faces].all(axis=1)]]


def gathering(faces: Faces, count: int) -> Any:
    """Return the sparse matrix [N, F] that sums over the faces around each vertex."""
    from scipy.sparse import csr_matrix

    columns = np.repeat(np.arange(len(faces)), 3)
    return csr_matrix((np.ones(faces.size), (faces.ravel(), columns)), shape=(count, len(faces)))


def averaging(faces: Faces, group: NDArray[np.int64]) -> Any:
    """Return the sparse matrix [N, N] that averages each vertex and its neighbours in the same group."""
    from scipy.sparse import csr_matrix, diags, identity

    count = len(group)
    rows, columns = faces.ravel(), np.roll(faces, 1, axis=1).ravel()
    same = group[rows] == group[columns]
    links = csr_matrix((np.ones(same.sum()), (rows[same], columns[same])), shape=(count, count))
    links = ((links + links.T) > 0).astype(np.float64) + identity(count)
    return (diags(1 / np.asarray(links.sum(axis=1)).ravel()) @ links).tocsr()


def sliding(partner: NDArray[np.int64], share: Floats, vertices: NDArray[np.int64]) -> Any:
    """Return the sparse matrix [N, N] that moves each vertex of a patch its share ([V]) towards its partner ([V])."""
    from scipy.sparse import csr_matrix

    numbers = np.zeros(len(partner), np.int64)
    numbers[vertices] = np.arange(len(vertices))
    rows = np.arange(len(vertices))
    values = np.concatenate([1 - share[vertices], share[vertices]])
    columns = np.concatenate([rows, numbers[partner[vertices]]])
    return csr_matrix((values, (np.tile(rows, 2), columns)), shape=(len(vertices),) * 2)
