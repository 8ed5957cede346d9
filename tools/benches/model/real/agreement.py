"""Agreement: how often two frames that see one point of the person give it one label."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from benches.model.real.recording import Frame
from bodyseg_data.labels import BACKGROUND
from bodyseg_model.evaluation import GrossErrors, distances_to_parts
from bodyseg_model.evaluation.gross_errors import LIMITS_MM

MOST_DEG: Final = 45
"""Largest angle between the optical axes of two frames that are compared."""

MEET_M: Final = 0.006
"""Points of two frames that are nearer than this are one."""

_POINTS: Final = 1500  # of a frame that are looked up in each other one


def agreement(frames: Sequence[Frame], answers: Sequence[NDArray[np.uint8]]) -> dict[str, Any]:
    """Share of points with one label, of those that two frames up to `MOST_DEG` apart see; and of those whose label is
    within the limits of gross errors of them in the other frame.

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
    alike, compared, away_from = 0, 0, GrossErrors()
    for number, (points, labels) in enumerate(labelled):
        step = max(1, len(points) // _POINTS)
        for other in np.flatnonzero(angles[number] <= MOST_DEG):
            tree = trees[other]
            if other == number or tree is None or not len(points):
                continue
            away, nearest = tree.query(points[::step], distance_upper_bound=MEET_M)
            meet = np.isfinite(away)
            same = labels[::step][meet] == labelled[other][1][nearest[meet]]
            differing = points[::step][meet][~same], labels[::step][meet][~same]
            away_from.add(distances_to_parts(*differing, *labelled[other]), int(same.sum()))
            alike, compared = alike + int(same.sum()), compared + len(same)
    return {
        "same": _share(alike, compared),
        **{
            f"within_{mm}_mm": _share(away_from.pixels - beyond, away_from.pixels)
            for mm, beyond in zip(LIMITS_MM, away_from.beyond, strict=True)
        },
        "points": compared,
    }


def _share(part: float, whole: float) -> float | None:
    return round(float(part / whole), 4) if whole else None
