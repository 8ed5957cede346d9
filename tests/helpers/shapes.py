"""Small meshes with known geometry, so that tests have exact answers and need no body model."""

from __future__ import annotations

import numpy as np
import trimesh

from bodyseg_data.meshes.mesh import Mesh


def ball(
    radius_m: float = 0.5,
    centre: tuple[float, float, float] = (0.0, 0.9, 0.0),
    subdivisions: int = 4,
    name: str = "ball",
) -> Mesh:
    """A finely triangulated sphere standing where a body would."""
    shape = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius_m)
    return Mesh(name, np.asarray(shape.vertices) + centre, np.asarray(shape.faces))


def figure(name: str = "figure") -> Mesh:
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
        shape = trimesh.creation.icosphere(subdivisions=3, radius=1.0)
        vertices.append(np.asarray(shape.vertices) * (a, b, c) + centre)
        faces.append(np.asarray(shape.faces) + count)
        count += len(shape.vertices)
    return Mesh(name, np.concatenate(vertices), np.concatenate(faces))
