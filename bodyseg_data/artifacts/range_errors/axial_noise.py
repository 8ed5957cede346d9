"""Axial noise: Gaussian along the optical axis, stronger far away and at grazing incidence."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts.artifact import Artifact, RangeImage, Scene
from bodyseg_data.artifacts.range_errors.gaussian import add_gaussian, clean_metres, loops
from bodyseg_data.artifacts.surface import grazing
from bodyseg_data.core.errors import bounded, check_fields, one_of
from bodyseg_data.core.kernels import use_compiled
from bodyseg_data.core.randomness import Draws

POWERS: Final = (-0.5, 0.0, 0.5, 1.0, 1.5, 2.0)
"""Powers of the range that the grazing term may have: roots and products give the same bits on every machine."""


@dataclass(frozen=True)
class AxialNoise(Artifact):
    """Gaussian noise whose sigma in millimetres is, at z metres and an angle of incidence theta,

        constant_mm + quadratic_mm * (z - from_m)**2 + grazing_mm * z**grazing_power * (theta / (pi/2 - theta))**2

    The form and the defaults, for Kinect v1, are those of Nguyen, Izadi and Lovell, "Modeling Kinect sensor noise for
    improved 3D reconstruction and tracking", 3DIMPVT 2012, equation 6. theta is at most 85 degrees (`angles`).
    """

    name = "axial_noise"
    kind = "noise"
    purposes = ("axial noise",)
    alters_labels = False

    constant_mm: float = bounded(1.2, 0, 1000)
    quadratic_mm: float = bounded(1.9, 0, 1000)
    from_m: float = bounded(0.4, -100, 100)
    grazing_mm: float = bounded(0.1, 0, 1000)
    grazing_power: float = one_of(-0.5, POWERS)

    def __post_init__(self) -> None:
        check_fields(self)

    def sigma_m(self, range_m: NDArray[np.float32], angle: NDArray[np.float32]) -> NDArray[np.float32]:
        """The standard deviation, metres, [N]; range_m: metres, [N]; angle: of incidence, radians, [N]."""
        if use_compiled():
            terms = tuple(map(np.float32, (self.constant_mm, self.quadratic_mm, self.from_m, self.grazing_mm)))
            compiled = np.empty_like(range_m)
            loops().axial_sigma(range_m, angle, terms, round(2 * self.grazing_power), compiled)
            return compiled
        away = range_m - np.float32(self.from_m)
        root = np.sqrt(range_m)
        power = np.float32(1) / root if self.grazing_power < 0 else np.ones_like(root)
        for _ in range(round(2 * self.grazing_power)):
            power *= root
        sigma = np.float32(self.constant_mm) + np.float32(self.quadratic_mm) * (away * away)
        sigma += np.float32(self.grazing_mm) * power * grazing(angle) ** 2
        found: NDArray[np.float32] = sigma * np.float32(1e-3)
        return found

    def apply(self, image: RangeImage, scene: Scene, draws: Draws) -> None:
        """As `Artifact.apply`."""
        add_gaussian(image, scene, draws, "axial noise", self.sigma_m(clean_metres(scene), scene.incidence))
