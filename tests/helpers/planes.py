"""Clean samples whose ranges and angles are known exactly: tilted planes before a small camera with a projector."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from samples import body_info

from bodyseg_data.artifacts import Artifact, RangeImage, shown_with
from bodyseg_data.labels import BACKGROUND
from bodyseg_data.rigs import Camera, Rig
from bodyseg_data.samples import Sample

CAMERA = Camera(200, 160, 400.0, (80.0, 100.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
PROJECTOR = replace(CAMERA, position_m=(0.075, 0.0, 0.0), aims_at_m=(0.075, 0.0, 1.0))
RIG = Rig("small", 2.0, CAMERA, PROJECTOR)
INFO = body_info(distance_cm=200, mesh="A-1")


def sample_of(z: NDArray[np.float64], key: str = "k") -> Sample:
    """A sample with the given clean range, metres, 0 for background; labels are rows of one part each."""
    ranges = np.rint(z / 1e-4).astype(np.uint16)
    labels = np.where(ranges > 0, np.arange(z.shape[0])[:, None] // 10 % 33, BACKGROUND).astype(np.uint8)
    facing = np.ones(z.shape, np.bool_)
    return Sample(key, ranges, np.zeros_like(ranges), labels, facing, INFO)


def plane(range_m: float, tilt_deg: float = 0.0) -> Sample:
    """A plane through the axis at `range_m`, turned about the vertical so that the axis meets it at `tilt_deg`."""
    x = CAMERA.pixel_rays()[..., 0]
    z = range_m / (1 - x * math.tan(math.radians(tilt_deg)))
    z[:20] = z[-20:] = 0
    return sample_of(np.where((z > 0.3) & (z < 6), z, 0))


def shown(artifact: Artifact, sample: Sample, seed: int = 0) -> RangeImage:
    return shown_with(artifact, sample, RIG, seed)
