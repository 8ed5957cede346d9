"""Pixels lost for how the surface lies: seen at grazing incidence, or beside an edge."""

from __future__ import annotations

import math
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np

from bodyseg_data.artifacts.artifact import Artifact, RangeImage, Scene
from bodyseg_data.artifacts.noise import drawn_bits
from bodyseg_data.artifacts.surface import silhouettes, widened
from bodyseg_data.core.errors import bounded, check_fields
from bodyseg_data.core.kernels import use_compiled
from bodyseg_data.core.randomness import Draws


@dataclass(frozen=True)
class GrazingLoss(Artifact):
    """Pixels whose surface is seen at more than `from_deg` from its normal, lost each with probability `share`.

    from_deg: degrees, 0 facing the camera; the slopes of a range image end at 85 (`angles`).
    """

    name = "grazing_loss"
    kind = "missing_data"
    purposes = ("grazing loss",)

    from_deg: float = bounded(75.0, 0, 85, below=True)
    share: float = bounded(1.0, 0, 1)

    def __post_init__(self) -> None:
        check_fields(self)

    def apply(self, image: RangeImage, scene: Scene, draws: Draws) -> None:
        """As `Artifact.apply`."""
        bits = drawn_bits(draws, "grazing loss", len(scene.pixels), np.uint16)
        ranges, limit, steepest = image.range.reshape(-1), self.share * 65536, np.float32(math.radians(self.from_deg))
        if use_compiled():
            _loops().lose_steep(ranges, scene.pixels, bits, np.uint32(math.ceil(limit)), scene.incidence, steepest)
            return
        lost = (bits < limit) & (scene.incidence > steepest)
        ranges[scene.pixels[lost]] = 0


@dataclass(frozen=True)
class EdgeLoss(Artifact):
    """Pixels at most `width_px` from where a surface ends, on either side of it, lost each with probability `share`.

    width_px: rows and columns; 1 is the last pixel before the edge. A surface ends at background and where ranges of
    neighbours differ by more than `jump_mm`.
    """

    name = "edge_loss"
    kind = "missing_data"
    purposes = ("edge loss",)

    width_px: int = bounded(1, 1, 50)
    share: float = bounded(0.5, 0, 1)
    jump_mm: float = bounded(30.0, 0, 10_000, above=True)

    def __post_init__(self) -> None:
        check_fields(self)

    def apply(self, image: RangeImage, scene: Scene, draws: Draws) -> None:
        """As `Artifact.apply`."""
        clean = scene.sample.range
        edge = widened(silhouettes(clean, self.jump_mm / 1000 / scene.step_m), self.width_px - 1)
        bits = drawn_bits(draws, "edge loss", len(scene.pixels), np.uint16)
        ranges, limit, marked = image.range.reshape(-1), self.share * 65536, edge.reshape(-1)
        if use_compiled():
            _loops().lose_marked(ranges, scene.pixels, bits, np.uint32(math.ceil(limit)), marked)
            return
        lost = (bits < limit) & marked[scene.pixels]
        ranges[scene.pixels[lost]] = 0


def _loops() -> Any:
    """The compiled forms; they load numba, so not before they are used."""
    return import_module("bodyseg_data.artifacts.loops.lost_pixels")
