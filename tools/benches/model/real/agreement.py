"""Agreement: how often two frames that see one point of the person give it one label."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from benches.model.real.recording import Frame
from bodyseg_data.core import ProgressCallback, silent
from bodyseg_data.labels import BACKGROUND
from bodyseg_model.evaluation import GrossErrors, distances_to_parts
from bodyseg_model.evaluation.gross_errors import LIMITS_MM

ANGLES_DEG: Final = (15, 30, 45)
"""Upper ends of the ranges of the angle between two frames' optical axes; beyond the last they are not compared."""

MEET_M: Final = 0.006
"""Points of two frames that are nearer than this are one."""

_POINTS: Final = 1500  # of a frame that are looked up in each other one


def agreement(
    frames: Sequence[Frame], answers: Sequence[NDArray[np.uint8]], progress: ProgressCallback = silent
) -> dict[str, Any]:
    """Share of points with one label, of those that two frames up to 45 degrees apart see, by angle and in all; and of
    those whose label is within the limits of gross errors of them in the other frame.

    answers: label images, uint8 [H, W]; pixels of `BACKGROUND` are not compared.
    """
    from scipy.spatial import KDTree

    labelled = []
    for frame, answer in zip(frames, answers, strict=True):
        labels = answer.ravel()[frame.pixels]
        labelled.append((frame.points(frame.pixels[labels != BACKGROUND]), labels[labels != BACKGROUND]))
    trees = [KDTree(points) if len(points) else None for points, _ in labelled]
    axes = np.stack([frame.placed.axes[2] for frame in frames])
    angles = np.degrees(np.arccos(np.clip(axes @ axes.T, -1, 1)))
    counts, away_from = np.zeros((len(ANGLES_DEG), 2), np.int64), GrossErrors()
    for number, (points, labels) in enumerate(labelled):
        step = max(1, len(points) // _POINTS)
        for other in np.flatnonzero(angles[number] <= ANGLES_DEG[-1]):
            tree = trees[other]
            if other == number or tree is None or not len(points):
                continue
            away, nearest = tree.query(points[::step], distance_upper_bound=MEET_M)
            meet = np.isfinite(away)
            same = labels[::step][meet] == labelled[other][1][nearest[meet]]
            differing = points[::step][meet][~same], labels[::step][meet][~same]
            away_from.add(distances_to_parts(*differing, *labelled[other]), int(same.sum()))
            counts[np.searchsorted(ANGLES_DEG, angles[number, other])] += same.sum(), len(same)
        progress(number + 1, len(labelled))
    names = [f"{low} to {high} degrees" for low, high in zip((0, *ANGLES_DEG), ANGLES_DEG, strict=False)]
    return {
        "same": _share(counts.sum(axis=0)),
        **{
            f"within_{mm}_mm": _share(np.array([away_from.pixels - beyond, away_from.pixels]))
            for mm, beyond in zip(LIMITS_MM, away_from.beyond, strict=True)
        },
        "points": int(counts[:, 1].sum()),
        "by_angle": {name: _share(row) for name, row in zip(names, counts, strict=True)},
    }


def _share(counts: NDArray[np.int64]) -> float | None:
    return round(float(counts[0] / counts[1]), 4) if counts[1] else None
