"""A figure of known pixels as transforms receive it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from samples import GOOD, body_info

from bodyseg_data.labels import BACKGROUND
from bodyseg_data.loading import CameraImage

STORED = replace(GOOD, info=body_info(distance_cm=250))


def camera_image(
    rows: int = 60, columns: int = 40, seed: int = 0, centre: tuple[float, float] | None = None
) -> CameraImage:
    """A box of random ranges near 2.5 m and random parts, off the middle, with some pixels lost."""
    random = np.random.default_rng(seed)
    ranges, labels = np.zeros((rows, columns), np.uint16), np.full((rows, columns), BACKGROUND, np.uint8)
    box = (slice(rows // 4, rows // 4 + rows // 2), slice(columns // 5, columns // 5 + columns // 2))
    size = (rows // 2, columns // 2)
    ranges[box] = random.integers(24_000, 26_000, size) * (random.random(size) < 0.95)
    labels[box] = np.where(ranges[box] > 0, random.integers(0, 33, size), BACKGROUND)
    middle = (columns / 2, rows / 2) if centre is None else centre
    return CameraImage("open-A-posture-00-d250-a000", ranges, labels, {}, 1e-4, 500.0, middle, STORED)
