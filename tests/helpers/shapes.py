"""Small meshes with known geometry, so that tests have exact answers and need no body model."""

from __future__ import annotations

import re
from functools import cache
from typing import Any

import numpy as np
from spheres import icosphere

from bodyseg_data.labels import PART_COUNT
from bodyseg_data.meshes import Mesh


def mean_by_place(numbers: Any) -> float:
    """Mean of many numbers, weighted by their places, which tells whether any of them is another one."""
    flat = np.ravel(numbers)
    return float(np.average(flat, weights=1 + np.arange(len(flat)) % 7))


def numbers_in(records: Any) -> list[float]:
    """The numbers with a decimal point in what is printed of records."""
    return [float(number) for number in re.findall(r"\d+\.\d+", repr(records))]


def ball(
    radius_m: float = 0.5,
    centre: tuple[float, float, float] = (0.0, 0.9, 0.0),
    subdivisions: int = 4,
    name: str = "ball",
) -> Mesh:
    """A finely triangulated sphere standing where a body would."""
    vertices, faces = icosphere(subdivisions, radius_m)
    return Mesh(name, vertices + centre, faces)


@cache
def figure(name: str = "figure", subdivisions: int = 3) -> Mesh:
    """A plain upright figure of five separate closed parts, 1.7 m tall: trunk, head, an arm held in front, two legs."""
    parts = [
        (0.16, 0.30, 0.11, (0.0, 1.15, 0.0)),
        (0.09, 0.12, 0.10, (0.0, 1.58, 0.02)),
        (0.30, 0.05, 0.05, (0.10, 1.20, 0.28)),
        (0.07, 0.42, 0.08, (-0.12, 0.43, 0.0)),
        (0.07, 0.42, 0.08, (0.12, 0.43, 0.0)),
    ]
    vertices, faces, count = [], [], 0
    for a, b, c, centre in parts:
        points, triangles = icosphere(subdivisions, 1.0)
        vertices.append(points * (a, b, c) + centre)
        faces.append(triangles + count)
        count += len(points)
    return Mesh(name, np.concatenate(vertices), np.concatenate(faces))


def evenly_drawn(mesh: Mesh, seed: int = 0) -> Any:
    """33 different vertices of the surface."""
    return np.random.default_rng(seed).choice(np.unique(mesh.faces), PART_COUNT, replace=False).astype(np.int64)


def box_mesh(steps: int = 12, side: float = 1.0, depth: float = 0.1) -> Mesh:
    """A flat box, `side` square and `depth` thick, every face a square grid; its front is the plane z = depth."""
    points: dict[tuple[float, float, float], int] = {}
    faces: list[list[int]] = []

    def index(point: Any) -> int:
        key = tuple(round(float(value), 9) for value in point)
        return points.setdefault((key[0], key[1], key[2]), len(points))

    size = np.array([side, side, depth])
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        nu, nv = (1 if extent == 2 else steps for extent in (u, v))
        for outer in (0, 1):
            for i in range(nu):
                for j in range(nv):
                    corners = []
                    for du, dv in ((0, 0), (1, 0), (1, 1), (0, 1)):
                        point = np.zeros(3)
                        point[axis], point[u], point[v] = outer, (i + du) / nu, (j + dv) / nv
                        corners.append(index(point * size))
                    a, b, c, d = corners if outer else corners[::-1]
                    faces += [[a, b, c], [a, c, d]]
    return Mesh("box", np.array(list(points)), np.array(faces))
