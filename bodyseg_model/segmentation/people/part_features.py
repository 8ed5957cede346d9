"""Features of a network's answer to a surface that tell a person from a thing.

A network that was trained on people is unsure of things, and gives them few and scattered parts.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.parts import PART_COUNT
from bodyseg_data.core.rig import Camera
from bodyseg_model.segmentation.people.surface_shape import CELL_M, FEW, Floats, pixel_m, share_of

PART_FEATURES: Final = (
    "mean confidence",
    "share above 0.5",
    "share above 0.7",
    "share above 0.9",
    "entropy of parts",
    "parts above 1 %",
    "borders",
    "greatest part",
    "log confident area",
)
"""Features of a network's answer in the 33 parts, in their order."""


def part_features(
    pixels: NDArray[np.intp],
    labels: NDArray[np.uint8],
    confidence: NDArray[np.float32],
    range_m: NDArray[np.float32],
    camera: Camera,
) -> Floats:
    """Describe a network's answer to a surface: `PART_FEATURES`, float64 [9].

    labels, confidence: uint8 and float32 [N], of each of `pixels`, the parts 0 to 32 whatever their confidence. The
    rest as for `surface_shape`. At most about 8 000 of the pixels are read, evenly spaced.
    """
    few = np.arange(0, len(pixels), max(1, len(pixels) // FEW))
    z, sure = range_m.ravel()[pixels[few]].astype(np.float64), confidence[few]
    shares = np.bincount(labels[few], minlength=PART_COUNT)[:PART_COUNT] / len(few)
    held = shares[shares > 0]
    after = np.minimum(few + 1, len(pixels) - 1)
    beside = pixels[after] == pixels[few] + 1
    borders = share_of((labels[after] != labels[few])[beside], 0.0)
    area = (z / camera.focal_px) ** 2 * (len(pixels) / len(few))
    return np.array(
        [
            float(sure.mean(dtype=np.float64)),
            *(share_of(sure > least, 0.0) for least in (0.5, 0.7, 0.9)),
            -(held * np.log(held)).sum(),
            float((shares > 0.01).sum()),
            borders * CELL_M / pixel_m(pixels, range_m, camera),
            shares.max(),
            np.log((area * sure).sum() + 1e-6),
        ]
    )
