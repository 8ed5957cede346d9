"""Measurement noise: additive Gaussian on the foreground, one standard deviation an image (paper, section 3.2)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.errors import BadConfig
from bodyseg_data.sample import RANGE_STEP_M


@dataclass(frozen=True)
class Noise:
    """How strong the noise may be: sigma is drawn uniformly from [low_mm, high_mm] for every image."""

    low_mm: float = 0.0
    high_mm: float = 100.0

    def __post_init__(self) -> None:
        if not 0 <= self.low_mm <= self.high_mm <= 1000:
            raise BadConfig(
                f"noise must satisfy 0 <= low <= high <= 1000 mm, found low {self.low_mm} and high {self.high_mm}"
            )

    def draw_sigma_mm(self, generator: np.random.Generator) -> float:
        """The standard deviation of one image, millimetres."""
        return float(generator.uniform(self.low_mm, self.high_mm))


def add_noise(foreground: NDArray[np.uint16], sigma_mm: float, generator: np.random.Generator) -> NDArray[np.uint16]:
    """Noisy copy of the foreground's ranges, uint16 [N] in and out, steps of 0.1 mm.

    Rounds to the nearest step and stays within 1 .. 65535: a foreground pixel neither becomes background (0) nor wraps
    around in 16 bits. One normal is drawn a pixel, in the order given, whatever sigma is.
    """
    normals = generator.standard_normal(len(foreground), np.float32)
    noisy = foreground + normals * np.float32(sigma_mm / 1000 / RANGE_STEP_M)
    return np.clip(np.rint(noisy), 1, 65535).astype(np.uint16)
