"""Areas of the parts of a labelled mesh."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.labels import PART_COUNT
from bodyseg_data.meshes import Mesh


def part_areas(mesh: Mesh, labels: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Share of the mesh's area that each part covers, float64 [33], sum 1.

    labels: uint8 [V], 0 to 32. The area of a triangle is shared equally by its corners.
    """
    areas = np.linalg.norm(mesh.normals, axis=1)
    shares = np.repeat(areas / (3 * areas.sum()), 3)
    return np.asarray(np.bincount(labels[mesh.faces].ravel(), shares, PART_COUNT), np.float64)
