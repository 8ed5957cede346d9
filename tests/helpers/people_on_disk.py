"""A plain person in one piece with all 33 landmarks, written the way the owners of the sources write theirs."""

from __future__ import annotations

import gzip
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from spheres import icosphere

from bodyseg_data.labels import LANDMARKS
from bodyseg_data.meshes import Mesh
from bodyseg_data.meshes.landmarks import LANDMARKS_FORMAT

Floats = NDArray[np.float64]

_MIDDLE: Final = {  # metres, body frame; x of the left one of a pair
    "Sellion": (0, 1.60, 0.1),
    "Nuchale": (0, 1.58, -0.1),
    "Supramenton": (0, 1.52, 0.1),
    "Suprasternale": (0, 1.40, 0.1),
    "Substernale": (0, 1.20, 0.1),
    "Cervicale": (0, 1.45, -0.1),
    "10th Rib Midspine": (0, 1.20, -0.1),
}
_LEFT: Final = {
    "Thelion/Bustpoint": (0.1, 1.30, 0.1),
    "ASIS": (0.12, 1.00, 0.1),
    "PSIS": (0.05, 1.00, -0.1),
    "Axilla, Post.": (0.15, 1.30, -0.1),
    "Acromion": (0.2, 1.42, 0),
    "Olecranon": (0.3, 1.12, 0),
    "Radial Styloid": (0.3, 0.92, 0.05),
    "Dactylion": (0.3, 0.75, 0),
    "Trochanterion": (0.25, 0.87, 0),
    "Femoral Lateral Epicn": (0.2, 0.50, 0.05),
    "Knee Crease": (0.1, 0.45, -0.1),
    "Lateral Malleolus": (0.1, 0.10, 0),
    "Digit II": (0.05, 0.05, 0.1),
}


def person(name: str = "person", height_m: float = 1.7) -> Mesh:
    """An upright egg, 642 vertices."""
    points, faces = icosphere(3, 1.0)
    vertices = points * (0.25, 0.85, 0.15) + (0, 0.85, 0)
    return Mesh(name, np.round(vertices * height_m / 1.7, 5), faces)


PERSON: Final = person()


def _landmark_vertices() -> tuple[int, ...]:
    places = {**_MIDDLE}
    for name, (x, y, z) in _LEFT.items():
        places |= {f"Lt. {name}": (x, y, z), f"Rt. {name}": (-x, y, z)}
    taken: list[int] = []
    for name in LANDMARKS:
        distance = np.linalg.norm(PERSON.vertices - places[name], axis=1)
        distance[taken] = np.inf
        taken.append(int(distance.argmin()))
    return tuple(taken)


VERTICES: Final = _landmark_vertices()
"""The vertex of each landmark on every `person`."""


def turn(left: str, up: str) -> Floats:
    """The rotation whose rows are these directions ("x", "-z", ...) and the front."""
    axes = {
        sign + name: factor * np.eye(3)["xyz".index(name)]
        for sign, factor in (("", 1.0), ("-", -1.0))
        for name in "xyz"
    }
    return np.stack([axes[left], axes[up], np.cross(axes[left], axes[up])])


def ply(vertices: Floats, faces: NDArray[np.int32]) -> bytes:
    """A binary file, as scanners write them."""
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\nproperty double x\nproperty double y\n"
        f"property double z\nelement face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = np.zeros(len(faces), [("n", "u1"), ("corners", "<i4", 3)])
    rows["n"], rows["corners"] = 3, faces
    return header.encode() + vertices.astype("<f8").tobytes() + rows.tobytes()


def obj(vertices: Floats, faces: NDArray[np.int32]) -> bytes:
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
    return "\n".join([*lines, *(f"f {a} {b} {c}" for a, b, c in (faces + 1).tolist()), ""]).encode()


def off(vertices: Floats, faces: NDArray[np.int32]) -> bytes:
    lines = ["OFF", f"{len(vertices)} {len(faces)} 0", *(f"{x!r} {y!r} {z!r}" for x, y, z in vertices.tolist())]
    return "\n".join([*lines, *(f"3 {a} {b} {c}" for a, b, c in faces.tolist()), ""]).encode()


def write_mesh(path: Path, vertices: Floats = PERSON.vertices, faces: NDArray[np.int32] = PERSON.faces) -> Path:
    """Write a mesh in the form that the file's name asks for."""
    name = path.name.lower()
    form = {".ply": ply, ".obj": obj, ".off": off}[Path(name.removesuffix(".gz")).suffix]
    data = form(vertices, faces)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(gzip.compress(data) if name.endswith(".gz") else data)
    return path


def write_by_vertex(path: Path, vertices: tuple[int, ...] = VERTICES) -> Path:
    tree = {
        "format": LANDMARKS_FORMAT,
        "topology": "persons",
        "vertex_count": len(PERSON.vertices),
        "face_count": len(PERSON.faces),
        "landmarks": dict(zip(LANDMARKS, vertices, strict=True)),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(tree))
    return path


def write_by_point(path: Path, points_m: Floats) -> Path:
    points = dict(zip(LANDMARKS, points_m.tolist(), strict=True))
    path.write_text(json.dumps({"format": LANDMARKS_FORMAT, "units": "m", "points": points}))
    return path


def write_lnd(
    path: Path, points_m: Floats, renamed: Mapping[str, str | None] | None = None, unit: float = 1000
) -> Path:
    """A .lnd file; `renamed` gives names as they are misspelt, None for a row left out."""
    names = {name: name for name in LANDMARKS} | dict(renamed or {})
    rows = [
        f" {number:3d}    0    0   0  " + "  ".join(f"{unit * value:9.4f}" for value in point) + f"  {names[name]}  "
        for number, (name, point) in enumerate(zip(LANDMARKS, points_m, strict=True), 1)
        if names[name] is not None
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(["STUDY_NAME = test", "AUX =", *rows, "END =", ""]))
    return path
