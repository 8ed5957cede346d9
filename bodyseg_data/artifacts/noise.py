"""Measurement noise: additive Gaussian on the foreground, one standard deviation an image (paper, section 3.2).

Normals are made of 32 random bits each, by the inverse of their distribution function (docs/explanation/noise.md).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts.artifact import Artifact, RangeImage, Scene
from bodyseg_data.artifacts.constants import FIRST_SEGMENT, OFFSET_MASK, SEGMENT_SHIFT, SEGMENTS
from bodyseg_data.core import Draws, bounded


@dataclass(frozen=True)
class Noise(Artifact):
    """Gaussian noise; each image's standard deviation is drawn uniformly from `low_mm` to `high_mm`, millimetres."""

    name = "noise"
    kind = "noise"
    purposes = ("sigma", "noise")
    drawn: ClassVar[Mapping[str, str]] = {"sigma_mm": "noise {:.0f} mm"}

    low_mm: float = bounded(0.0, 0, 1000)
    high_mm: float = bounded(100.0, 0, 1000, not_below="low_mm")

    def draw(self, draws: Draws) -> dict[str, float]:
        """As `Artifact.draw`: "sigma_mm", the standard deviation, millimetres."""
        return {"sigma_mm": self.low_mm + (self.high_mm - self.low_mm) * draws.chance("sigma")}

    def apply(self, image: RangeImage, scene: Scene, draws: Draws) -> None:
        ranges, pixels = image.range.reshape(-1), scene.pixels
        before = ranges[pixels]
        sigma = steps_of(image.drawn["sigma_mm"], scene.step_m)
        noisy = add_noise(before, sigma, draws.pixels("noise", len(pixels), np.uint32))
        ranges[pixels] = np.where(before > 0, noisy, 0)


def normals(draws: NDArray[np.uint32]) -> NDArray[np.float32]:
    """One standard normal for each 32 random bits, float32 [N].

    The highest bit is the sign. The others, a whole number m, stand for the quantile (m + 0.5) / 2**32, so normals
    reach from -6.34 to 6.34 and their mean is 0. Every step is exact or rounds to nearest in float32, so that every
    form and machine gives the same bits.
    """
    bits = ((draws & np.uint32(0x7FFFFFFF)).astype(np.float32) + np.float32(0.5)).view(np.int32)
    offset = (bits & OFFSET_MASK).astype(np.float32)
    segment = (bits >> SEGMENT_SHIFT) - FIRST_SEGMENT
    constant, linear, bend = (row.take(segment) for row in SEGMENTS)
    size = constant + offset * (linear + offset * bend)
    signed: NDArray[np.float32] = np.where(draws >> np.uint32(31), size, -size)
    return signed


def steps_of(sigma_mm: float, step_m: float) -> np.float32:
    """Millimetres as steps of a stored range; step_m: one step, metres."""
    return np.float32(sigma_mm / 1000 / step_m)


def add_noise(foreground: NDArray[np.uint16], sigma: np.float32, draws: NDArray[np.uint32]) -> NDArray[np.uint16]:
    """Noisy copy of the foreground's ranges, uint16 [N] in and out, in steps.

    sigma: the standard deviation in steps. draws: uint32 [N], random bits.

    Rounds to the nearest step and stays within 1 .. 65535: no foreground pixel becomes background (0) or wraps around.
    """
    return as_range(foreground.astype(np.float32) + normals(draws) * sigma)


def as_range(steps: NDArray[np.floating]) -> NDArray[np.uint16]:
    """Steps as stored ranges of measured pixels: the nearest whole number from 1 to 65535."""
    found: NDArray[np.uint16] = np.clip(np.rint(steps), 1, 65535).astype(np.uint16)
    return found
