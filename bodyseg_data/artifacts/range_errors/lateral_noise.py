"""Lateral noise: pixels that show the surface a little beside them, so that silhouettes are ragged."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from bodyseg_data.artifacts.artifact import Artifact, RangeImage, Scene
from bodyseg_data.artifacts.noise import drawn_normals
from bodyseg_data.artifacts.range_errors.gaussian import loops
from bodyseg_data.artifacts.surface import grazing, widened
from bodyseg_data.core.errors import bounded, check_fields
from bodyseg_data.core.kernels import use_compiled
from bodyseg_data.core.randomness import Draws

REACH: Final = 3
"""Rows and columns around the body, pixels, in which background may show it."""


@dataclass(frozen=True)
class LateralNoise(Artifact):
    """Each pixel shows range and label of the pixel beside it that Gaussian offsets of sigma pixels, by row and by
    column, lead to:

        sigma = constant_px + grazing_px * theta / (pi/2 - theta)

    at an angle of incidence theta; of background, `constant_px`. The form and the defaults, for Kinect v1, are those of
    Nguyen, Izadi and Lovell, "Modeling Kinect sensor noise for improved 3D reconstruction and tracking", 3DIMPVT 2012,
    equation 5. Background at most `REACH` rows and columns from the body may show the body.
    """

    name = "lateral_noise"
    kind = "noise"
    purposes = ("lateral noise",)

    constant_px: float = bounded(0.8, 0, 20)
    grazing_px: float = bounded(0.035, 0, 20)

    def __post_init__(self) -> None:
        check_fields(self)

    def apply(self, image: RangeImage, scene: Scene, draws: Draws) -> None:
        """As `Artifact.apply`."""
        clean = scene.sample.range
        if not len(scene.pixels):
            return
        near = widened(clean > 0, REACH)
        pixels = np.flatnonzero(near)
        normals = drawn_normals(draws, "lateral noise", 2 * len(pixels))
        if use_compiled():
            flat, terms = (
                np.ascontiguousarray(clean).reshape(-1),
                (np.float32(self.constant_px), np.float32(self.grazing_px)),
            )
            given = flat, clean.shape[1], pixels, scene.incidence, terms, normals
            loops().beside(
                image.range.reshape(-1), image.labels.reshape(-1), *given, np.empty((2, len(pixels)), np.uint16)
            )
            return
        rows, columns = np.divmod(pixels, clean.shape[1])
        sigma = np.full(clean.shape, self.constant_px, np.float32)
        sigma.reshape(-1)[scene.pixels] += np.float32(self.grazing_px) * grazing(scene.incidence)
        offsets = normals.reshape(2, -1) * sigma[near]
        down, along = np.rint(offsets).astype(np.int64)
        source = (
            np.clip(rows + down, 0, clean.shape[0] - 1),
            np.clip(columns + along, 0, clean.shape[1] - 1),
        )
        image.range[near], image.labels[near] = image.range[source], image.labels[source]
