"""Closed surfaces made of grids of points: cloth and hair with two sides, and solids of rings."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.meshes.solids import Solid

_SETTLED_M: Final = 0.006  # above the floor, within which lies what would hang lower

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]


def shell(outside: Floats, thickness: Floats | float, around: bool) -> Solid:
    """Make a closed surface of a sheet and its other side.

    outside: float64 [K, J, 3], metres, rows of points. thickness: metres, broadcast to [K, J]; the other side lies that
    far against `grid_normals`. around: the last column is joined to the first. Normals point away from the sheet's
    inside, whichever way its rows and columns run.
    """
    inside = outside - np.broadcast_to(thickness, outside.shape[:2])[..., None] * grid_normals(outside, around)
    rows, columns = outside.shape[:2]
    points = np.concatenate([outside, inside[::-1]]).reshape(-1, 3)
    grid = np.arange(2 * rows * columns).reshape(2 * rows, columns)
    ring = np.concatenate([grid, grid[:1]])
    faces = [_quads(np.concatenate([ring, ring[:, :1]], axis=1) if around else ring)]
    if not around:
        back = grid[rows:][::-1]
        faces += [
            _quads(np.stack([back[:, 0], grid[:rows, 0]], axis=1)),
            _quads(np.stack([grid[:rows, -1], back[:, -1]], axis=1)),
        ]
    return Solid(points, np.concatenate(faces).astype(np.int32))


def ringed(rings: Floats) -> Solid:
    """Make a closed solid of rings [K, J, 3], metres, its ends closed by fans about the means of first and last ring.

    Normals point outwards whichever way the rings run.
    """
    rows, columns = rings.shape[:2]
    grid = np.arange(rows * columns).reshape(rows, columns)
    around = np.concatenate([grid, grid[:, :1]], axis=1)
    first, last = rows * columns, rows * columns + 1
    ends = [
        np.stack([np.full(columns, first), around[0, :-1], around[0, 1:]], axis=1),
        np.stack([np.full(columns, last), around[-1, 1:], around[-1, :-1]], axis=1),
    ]
    points = np.concatenate([rings.reshape(-1, 3), rings[0].mean(axis=0)[None], rings[-1].mean(axis=0)[None]])
    faces = np.concatenate([_quads(around), *ends]).astype(np.int32)
    solid = Solid(points, faces)
    return solid if solid.volume > 0 else Solid(points, faces[:, ::-1])


def hull_radius(points: Floats, ways: Floats) -> Floats:
    """Distance [J] from the origin, inside, to the convex hull of points [N, 2] along unit vectors [J, 2]."""
    from scipy.spatial import ConvexHull

    planes = ConvexHull(points).equations
    towards = ways @ planes[:, :2].T
    distance = np.where(towards > 1e-9, -planes[:, 2] / np.maximum(towards, 1e-9), np.inf)
    return np.asarray(np.maximum(distance.min(axis=1), 0), np.float64)


def settled(points: Floats, floor: float) -> Floats:
    """Points [..., 3] with those below the floor laid on it, in their order of height."""
    lowest = floor + _SETTLED_M
    under = np.maximum(lowest - points[..., 1], 0)
    lying = lowest - 0.7 * _SETTLED_M * (1 - np.exp(-under / 0.1))
    return np.concatenate([points[..., :1], np.where(under > 0, lying, points[..., 1])[..., None], points[..., 2:]], -1)


def grid_normals(points: Floats, around: bool) -> Floats:
    """Unit normals [K, J, 3] of a sheet of points [K, J, 3], along row step x column step."""
    down = np.gradient(points, axis=0)
    joined = np.concatenate([points[:, -1:], points, points[:, :1]], axis=1) if around else points
    across = np.gradient(joined, axis=1)
    normals = np.cross(down, across[:, 1:-1] if around else across)
    return np.asarray(normals / np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), 1e-9), np.float64)


def _quads(grid: Indices) -> Indices:
    """Two triangles for each mesh of a grid of indices [K, J], normals along row step x column step: [N, 3]."""
    a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
    return np.concatenate([np.stack([a, b, c], axis=2), np.stack([a, c, d], axis=2)]).reshape(-1, 3)
