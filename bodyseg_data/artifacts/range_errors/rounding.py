"""Ranges rounded to whole steps, as sensors write them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodyseg_data.artifacts.artifact import Artifact, RangeImage, Scene
from bodyseg_data.artifacts.noise import as_range
from bodyseg_data.artifacts.range_errors.gaussian import loops
from bodyseg_data.core.errors import bounded, check_fields
from bodyseg_data.core.kernels import use_compiled
from bodyseg_data.core.randomness import Draws


@dataclass(frozen=True)
class RangeRounding(Artifact):
    """Ranges rounded to the nearest multiple of `step_mm`, at least one of them; most depth images hold millimetres."""

    name = "range_rounding"
    kind = "noise"
    alters_labels = False

    step_mm: float = bounded(1.0, 0, 1000, above=True)

    def __post_init__(self) -> None:
        check_fields(self)

    def apply(self, image: RangeImage, scene: Scene, draws: Draws) -> None:
        """As `Artifact.apply`."""
        steps = self.step_mm / 1000 / scene.step_m
        ranges = image.range.reshape(-1)
        if use_compiled():
            loops().round_ranges(ranges, steps)
            return
        pixels = np.flatnonzero(ranges)
        ranges[pixels] = as_range(np.maximum(np.rint(ranges[pixels] / steps), 1) * steps)
