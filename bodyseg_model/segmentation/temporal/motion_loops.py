"""Motion of a body from one frame back to the frame before, in its cells, compiled with numba.

Two steps: a rigid motion of the body (Gauss-Newton on distances of points to planes, Chen and Medioni 1992), and, after
the shifts of parts in `part_loops`, a smooth field of displacements (as Horn and Schunck 1981 have for brightness, here
with distances to planes).
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any, Final

import numpy as np

from bodyseg_data.core.kernels import compiled

_kernel = partial(compiled, feature="carrying labels through a video")

_ZERO: Final = np.float32(0)
_STILL: Final = 1.0  # weight of no further motion in a rigid step, against one for every cell
_STILL_TURN: Final = 0.002  # of a turn, square metres
_WIDTH: Final = 8  # columns of the table of a rigid step, of which 7 are used: whole vectors are added faster


@_kernel
def cell_at(x: Any, y: Any, z: Any, index: Any, lens: Any) -> Any:
    """Number of the cell that a point, metres, projects into; -1 for none."""
    if z <= 0:
        return -1
    u = math.floor((x / z * lens.focal + lens.x) / lens.side)
    v = math.floor((y / z * lens.focal + lens.y) / lens.side)
    if u < 0 or v < 0 or u >= lens.across or v >= lens.down:
        return -1
    return index[int(v) * lens.across + int(u)]


@_kernel
def move(motion: Any, point: Any) -> Any:
    """A point, float32 [3], metres, after a rigid motion, float64 [3, 4]: three float32."""
    x, y, z = point[0], point[1], point[2]
    return (
        np.float32(motion[0, 0] * x + motion[0, 1] * y + motion[0, 2] * z + motion[0, 3]),
        np.float32(motion[1, 0] * x + motion[1, 1] * y + motion[1, 2] * z + motion[1, 3]),
        np.float32(motion[2, 0] * x + motion[2, 1] * y + motion[2, 2] * z + motion[2, 3]),
    )


@_kernel
def moved(motion: Any, points: Any) -> Any:
    """Points [M, 3] after a rigid motion, float64 [3, 4], as float32 [M, 3]."""
    found = np.empty((len(points), 3), np.float32)
    for m in range(len(points)):
        found[m, 0], found[m, 1], found[m, 2] = move(motion, points[m])
    return found


@_kernel
def misfit(points: Any, motion: Any, old_index: Any, old_points: Any, lens: Any, gate: Any) -> Any:
    """Mean difference of range, metres, between moved points and the cells they meet; `gate` where they meet none."""
    total = 0.0
    for m in range(len(points)):
        x, y, z = move(motion, points[m])
        o = cell_at(x, y, z, old_index, lens)
        total += min(abs(old_points[o, 2] - z), gate) if o >= 0 else gate
    return total / max(len(points), 1)


@_kernel
def fit_rigid(
    points: Any, motion: Any, old_index: Any, old_points: Any, old_normals: Any, lens: Any, gate: Any, steps: Any
) -> None:
    """Improve `motion`, float64 [3, 4], in place, by Gauss-Newton steps on the distances of moved points to the planes
    of the cells they meet; distances beyond `gate`, metres, do not count (Tukey's weights).
    """
    table, row = np.empty((6, _WIDTH)), np.zeros(_WIDTH)
    for _ in range(steps):
        table[:] = 0
        places = moved(motion, points)
        mx, my, mz = 0.0, 0.0, 0.0
        for m in range(len(places)):
            mx, my, mz = mx + places[m, 0], my + places[m, 1], mz + places[m, 2]
        mx, my, mz = mx / len(places), my / len(places), mz / len(places)
        for m in range(len(places)):
            x, y, z = places[m, 0], places[m, 1], places[m, 2]
            o = cell_at(x, y, z, old_index, lens)
            if o < 0 or abs(old_points[o, 2] - z) > gate:
                continue
            nx, ny, nz = old_normals[o, 0], old_normals[o, 1], old_normals[o, 2]
            away = nx * (old_points[o, 0] - x) + ny * (old_points[o, 1] - y) + nz * (old_points[o, 2] - z)
            weight = max(1 - (away / gate) ** 2, 0.0) ** 2
            px, py, pz = x - mx, y - my, z - mz
            row[0], row[1], row[2] = py * nz - pz * ny, pz * nx - px * nz, px * ny - py * nx
            row[3], row[4], row[5], row[6] = nx, ny, nz, away
            for i in range(6):
                share = weight * row[i]
                for j in range(_WIDTH):
                    table[i, j] += share * row[j]
        for i in range(6):
            for j in range(i):
                table[i, j] = table[j, i]
            table[i, i] += _STILL_TURN if i < 3 else _STILL
        solve(table)
        turn = rotation(table[0, 6], table[1, 6], table[2, 6])
        turned = turn @ motion
        for i in range(3):
            middle = turn[i, 0] * mx + turn[i, 1] * my + turn[i, 2] * mz
            turned[i, 3] += (mx if i == 0 else my if i == 1 else mz) - middle + table[3 + i, 6]
        motion[:] = turned


@_kernel
def solve(table: Any) -> None:
    """Solve a positive definite system of n rows in place: column n, the right side, becomes the solution."""
    count = len(table)
    for i in range(count):
        for j in range(i + 1, count):
            share = table[j, i] / table[i, i]
            for k in range(i, count + 1):
                table[j, k] -= share * table[i, k]
    for i in range(count - 1, -1, -1):
        for j in range(i + 1, count):
            table[i, count] -= table[i, j] * table[j, count]
        table[i, count] /= table[i, i]


@_kernel
def rotation(x: Any, y: Any, z: Any) -> Any:
    """Matrix of a rotation vector, radians, float64 [3, 3] (Rodrigues)."""
    matrix, angle = np.eye(3), math.sqrt(x * x + y * y + z * z)
    if angle > 1e-12:
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        matrix += math.sin(angle) / angle * cross + (1 - math.cos(angle)) / (angle * angle) * (cross @ cross)
    return matrix


@_kernel
def relax(
    places: Any, neighbours: Any, labels: Any, shifts: Any, weights: Any, old_index: Any, old_points: Any,
    old_normals: Any, lens: Any, gate: Any, faith: Any, pull: Any, still: Any, rounds: Any, sweeps: Any,
) -> Any:  # fmt: skip
    """Smooth displacements of cells onto the old surface, float32 [M, 3], metres.

    places: [M, 3], cells after the rigid motion. Starts from the shifts of the cells' parts. Minimises `faith` times
    the squared distances to the planes of the cells met, plus the squared differences between neighbours, plus `pull`
    times the weights times the squared difference from the part's shift, plus `still` times the squared displacement;
    by Gauss-Seidel sweeps, back and forth, `sweeps` in each of `rounds`; cells are met anew in each round.
    """
    count = len(places)
    field, plane = np.empty((count, 3), np.float32), np.empty((count, 3), np.float32)
    goal, trust = np.empty(count, np.float32), np.empty(count, np.float32)
    for m in range(count):
        field[m] = shifts[labels[m]]
    for _ in range(rounds):
        for m in range(count):
            trust[m] = 0
            x, y, z = places[m, 0] + field[m, 0], places[m, 1] + field[m, 1], places[m, 2] + field[m, 2]
            o = cell_at(x, y, z, old_index, lens)
            if o < 0 or abs(old_points[o, 2] - z) > gate:
                continue
            nx, ny, nz = old_normals[o]
            away = nx * (old_points[o, 0] - x) + ny * (old_points[o, 1] - y) + nz * (old_points[o, 2] - z)
            plane[m] = old_normals[o]
            goal[m] = away + nx * field[m, 0] + ny * field[m, 1] + nz * field[m, 2]
            weight = max(1 - (away / gate) ** 2, _ZERO)
            trust[m] = faith * weight * weight if nx * nx + ny * ny + nz * nz > 0 else 0
        for sweep in range(sweeps):
            for k in range(count):
                m = k if sweep % 2 == 0 else count - 1 - k
                near, part = still, labels[m]
                own = pull * weights[part]
                x, y, z = own * shifts[part, 0], own * shifts[part, 1], own * shifts[part, 2]
                near += own
                for side in range(4):
                    if neighbours[m, side] >= 0:
                        o = np.uint64(neighbours[m, side])
                        near += 1
                        x, y, z = x + field[o, 0], y + field[o, 1], z + field[o, 2]
                x, y, z = x / near, y / near, z / near
                if trust[m] > 0:
                    nx, ny, nz = plane[m]
                    push = trust[m] * (goal[m] - (nx * x + ny * y + nz * z)) / (near + trust[m])
                    x, y, z = x + nx * push, y + ny * push, z + nz * push
                field[m, 0], field[m, 1], field[m, 2] = x, y, z
    return field
