"""Exact shadow rays, by Embree."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.rendering.embree import EmbreeRenderer


def lit(
    renderer: EmbreeRenderer, points: NDArray[np.float64], source: NDArray[np.float64], gap_m: float = 1e-4
) -> NDArray[np.bool_]:
    """True for each of `points` [N, 3] that a light at `source` [3] reaches past the renderer's mesh, bool [N].

    A point is lit if no triangle crosses the segment from the source to `gap_m` metres before the point; without the
    gap, the triangle that contains the point would occlude it.
    """
    if not len(points):
        return np.zeros(0, np.bool_)
    directions = points - source
    origins = np.broadcast_to((source - renderer._origin).astype(np.float32), directions.shape)
    fraction = 1 - gap_m / np.linalg.norm(directions, axis=1)
    occluded = renderer._scene.run(
        np.ascontiguousarray(origins),
        directions.astype(np.float32),
        dists=fraction.astype(np.float32),
        query="OCCLUDED",
    )
    free: NDArray[np.bool_] = occluded < 0  # Embree's binding gives 0 for blocked, -1 for free
    return free
