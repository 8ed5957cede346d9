"""Other ways to ask a shadow map, which `bench occlusion` measures beside the default."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts.occlusion import (
    FARTHEST,
    GAP_STEPS,
    SURFACE_GAP_M,
    Floats,
    ShadowTest,
    four_texels,
    reached,
)
from bodyseg_data.sample import RANGE_STEP_M

Images = tuple[NDArray[np.uint16], NDArray[np.uint16], NDArray[np.bool_]]
"""Camera range, projector range, facing bit, as `ShadowTest.lit` takes them."""

Rule = Callable[[NDArray[np.uint16], Floats, Floats, Floats], NDArray[np.bool_]]
"""Projector range, x, y, range of points -> whether light gets there, as `occlusion.reached`."""

DEFAULT_BIAS_MM: Final = SURFACE_GAP_M * 1000


@dataclass(frozen=True)
class Method:
    """One way to make the mask. bias_mm: how far behind what the projector sees a point may be.

    facing_bit: whether surfaces that face away count as dark without asking the map. projector_step_mm: the precision
    to which the projector's range is rounded first.
    """

    name: str
    bias_mm: float
    rule: Rule
    projector_scale: int = 1
    facing_bit: bool = True
    projector_step_mm: float = 0.1

    def lit(self, test: ShadowTest, images: Images) -> NDArray[np.bool_]:
        """The mask, bool [H, W]."""
        camera_range, projector_range, facing = images
        asked = camera_range > 0
        if self.facing_bit:
            asked &= facing
        answer = np.zeros(camera_range.shape, np.bool_)
        pixels, x, y, away = test.project(camera_range, np.flatnonzero(asked))
        answer.ravel()[pixels] = self.rule(projector_range, x, y, away)
        return answer

    def stored(self, projector_range: NDArray[np.uint16]) -> NDArray[np.uint16]:
        """The projector's range, uint16 [Hp, Wp], as whole numbers of this method's step."""
        whole = np.rint(projector_range / self._steps)
        stored: NDArray[np.uint16] = np.where(projector_range > 0, np.maximum(whole, 1), 0).astype(np.uint16)
        return stored

    def restored(self, stored: NDArray[np.uint16]) -> NDArray[np.uint16]:
        """What `stored` gives back, in steps of `RANGE_STEP_M`."""
        restored: NDArray[np.uint16] = np.rint(stored * self._steps).astype(np.uint16)
        return restored

    @property
    def _steps(self) -> float:
        return self.projector_step_mm / 1000 / RANGE_STEP_M


def methods() -> list[Method]:
    """All that is measured; the first is the default."""
    chosen = [
        Method("four texels: interpolated on a surface, votes at an edge", DEFAULT_BIAS_MM, reached, scale)
        for scale in (1, 2, 3)
    ]
    rounded = [
        Method("the default, projector range rounded", DEFAULT_BIAS_MM, reached, scale, projector_step_mm=step_mm)
        for scale, step_mm in ((1, 1.0), (1, 2.0), (1, 4.0), (2, 1.0))
    ]
    shifted = [
        Method(f"the default with its edge at {edge_mm:g} mm", gap_mm, two_rules(gap_mm, edge_mm))
        for gap_mm, edge_mm in ((4.0, 20.0), (8.0, 20.0), (6.0, 10.0), (6.0, 15.0), (6.0, 30.0))
    ]
    ablations = [
        Method("the default without the facing bit", DEFAULT_BIAS_MM, reached, facing_bit=False),
        Method("interpolated range everywhere", DEFAULT_BIAS_MM, interpolated),
    ]
    fixed = [
        Method(name, bias_mm, rule(bias_mm), scale, facing_bit)
        for name, rule, facing_bit in (
            ("nearest texel, no facing bit", nearest, False),
            ("nearest texel", nearest, True),
            ("four texels, the farthest", farthest, True),
            ("four texels, votes", votes, True),
        )
        for scale, biases_mm in ((1, (5.0, 10.0, 20.0, 30.0)), (2, (5.0, 10.0, 20.0)))
        for bias_mm in biases_mm
    ]
    return [*chosen, *rounded, *shifted, *ablations, *fixed]


def two_rules(gap_mm: float, edge_mm: float) -> Rule:
    """The default's rule with other constants."""
    gap, edge = (np.float32(round(length / 1000 / RANGE_STEP_M)) for length in (gap_mm, edge_mm))
    return partial(reached, gap=gap, edge=edge)


def nearest(bias_mm: float) -> Rule:
    """The texel that the point falls into must not be nearer than the point by more than the bias."""
    bias = np.float32(bias_mm / 1000 / RANGE_STEP_M)

    def rule(projector_range: NDArray[np.uint16], x: Floats, y: Floats, away: Floats) -> NDArray[np.bool_]:
        rows, columns = projector_range.shape
        row = np.minimum((y + np.float32(0.5)).astype(np.intp), rows - 1)
        column = np.minimum((x + np.float32(0.5)).astype(np.intp), columns - 1)
        texel = projector_range.ravel().take(row * columns + column)
        lit: NDArray[np.bool_] = (texel >= away - bias) | (texel == 0)
        return lit

    return rule


def farthest(bias_mm: float) -> Rule:
    """One of the four texels must let the light through."""
    bias = np.float32(bias_mm / 1000 / RANGE_STEP_M)

    def rule(projector_range: NDArray[np.uint16], x: Floats, y: Floats, away: Floats) -> NDArray[np.bool_]:
        (a, b, c, d), _, _ = four_texels(projector_range, x, y)
        limit = np.minimum(away - np.float32(1), FARTHEST) - bias
        lit: NDArray[np.bool_] = np.maximum(np.maximum(a, b), np.maximum(c, d)) >= limit
        return lit

    return rule


def votes(bias_mm: float) -> Rule:
    """The four texels that let the light through must have half the bilinear weight (percentage-closer filtering)."""
    bias = np.float32(bias_mm / 1000 / RANGE_STEP_M)

    def rule(projector_range: NDArray[np.uint16], x: Floats, y: Floats, away: Floats) -> NDArray[np.bool_]:
        texels, along, below = four_texels(projector_range, x, y)
        limit = np.minimum(away - np.float32(1), FARTHEST) - bias
        a, b, c, d = ((texel >= limit).astype(np.float32) for texel in texels)
        upper, lower = a + along * (b - a), c + along * (d - c)
        lit: NDArray[np.bool_] = upper + below * (lower - upper) >= np.float32(0.5)
        return lit

    return rule


def interpolated(projector_range: NDArray[np.uint16], x: Floats, y: Floats, away: Floats) -> NDArray[np.bool_]:
    """The point must not be behind the bilinearly interpolated range, edges or not."""
    texels, along, below = four_texels(projector_range, x, y)
    a, b, c, d = (texel.astype(np.float32) for texel in texels)
    upper, lower = a + along * (b - a), c + along * (d - c)
    lit: NDArray[np.bool_] = np.minimum(away - 1, FARTHEST) - (upper + below * (lower - upper)) <= GAP_STEPS
    return lit
