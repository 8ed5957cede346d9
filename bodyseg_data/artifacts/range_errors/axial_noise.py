"""Axial noise: Gaussian along the optical axis, stronger far away and at grazing incidence."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts.artifact import Artifact, RangeImage, Scene
from bodyseg_data.artifacts.range_errors.gaussian import add_gaussian, clean_metres, loops
from bodyseg_data.artifacts.surface import grazing
from bodyseg_data.core.errors import BadConfig, check_fields
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

    constant_mm: float = 1.2
    quadratic_mm: float = 1.9
    from_m: float = 0.4
    grazing_mm: float = 0.1
    grazing_power: float = -0.5

    def __post_init__(self) -> None:
        check_fields(self)
        if not all(0 <= each <= 1000 for each in (self.constant_mm, self.quadratic_mm, self.grazing_mm)):
            raise BadConfig(f"axial noise must have terms from 0 to 1000 mm, found {self}")
        if not -100 <= self.from_m <= 100:
            raise BadConfig(f"axial noise must grow from a range within 100 m, found {self.from_m} m")
        if self.grazing_power not in POWERS:
            powers = ", ".join(f"{power:g}" for power in POWERS)
            raise BadConfig(f"axial noise must have a grazing power of {powers}, found {self.grazing_power}")

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
