"""Makes bodyseg_data/bodies/template.npz from Anny and the open landmarks: python tests/golden/make_template.py.

Sets that were packed before name the template that they were packed with: another surface, or other points, must get
another `NAME`, and `PACKING_VERSION` must go up.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import bodyseg_data
from bodyseg_data.bodies.anny_model import AnnyModel, standing
from bodyseg_data.bodies.anny_people import SUBJECT_A
from bodyseg_data.bodies.skeleton import Pose
from bodyseg_data.bodies.template import template_of
from bodyseg_data.meshes import Mesh, load_landmarks, partition

NAME = "anny 12 mm 1"
FILE = Path(bodyseg_data.__file__).parent / "bodies" / "template.npz"


def surface(model: AnnyModel) -> tuple[NDArray[np.float32], NDArray[np.uint16], NDArray[np.uint8], NDArray[np.str_]]:
    """Anny's vertices [V, 3] at rest, metres, its faces [F, 3], the bone of each vertex [V], and the bones' names."""
    person = model.posable(SUBJECT_A)
    vertices = standing(model._posed(SUBJECT_A, Pose()))
    return (
        vertices.astype(np.float32),
        person.faces.astype(np.uint16),
        person.owner.astype(np.uint8),
        np.array(person.bones),
    )


def parts(vertices: NDArray[np.float32], faces: NDArray[np.uint16], bones: NDArray[Any]) -> NDArray[np.uint8]:
    """The part of each point of the template, uint8 [P]: of the landmark nearest along its surface."""
    points = template_of(NAME, vertices.astype(np.float64), faces.astype(np.int32), np.empty(0, np.uint8), bones, ())
    found = partition(Mesh(NAME, points.points, points.faces), np.array(load_landmarks("open").vertices))
    return found.labels


if __name__ == "__main__":
    vertices, faces, bones, names = surface(AnnyModel())
    found = parts(vertices, faces, bones)
    np.savez_compressed(FILE, name=NAME, vertices=vertices, faces=faces, bones=bones, bone_names=names, parts=found)
    print(f"{FILE}: {len(found)} points, {FILE.stat().st_size} bytes")
