"""Ways to ask a shadow map, which `bench occlusion` measures beside the default."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from benches.data.occlusion.views import SCALES
from bodyseg_data.artifacts.occlusion import (
    Floats,
    ShadowTest,
    four_texels,
    framed,
    reached,
)
from bodyseg_data.core.sample import FARTHEST_STEPS, RANGE_STEP_M, SHADOW_THRESHOLDS

Images = tuple[NDArray[np.uint16], NDArray[np.uint16], NDArray[np.bool_]]
"""Camera range, projector range, facing bit, as `ShadowTest.lit` takes them."""

Rule = Callable[[NDArray[np.uint16], Floats, Floats, Floats], NDArray[np.bool_]]
"""Projector range, x, y, range of points -> whether light gets there, as `occlusion.reached`."""

Stored = Literal["whole", "occluder", "coarse"]
"""All texels; those that can shade a pixel; those, rounded as far as no pixel's answer changes."""

DEFAULT_BIAS_MM: Final = SHADOW_THRESHOLDS.surface_gap_m * 1000
STEPS_MM: Final = (1.0, 2.0, 4.0, 8.0)
_TORN: Final = np.int32(SHADOW_THRESHOLDS.edge_steps)  # a larger difference between neighbours is no slope


@dataclass(frozen=True)
class Method:
    """One way to make the mask.

    bias_mm: how far behind what the projector sees a point may be. slope: how many texels' slope is added to that.
    facing_bit: whether surfaces that face away count as dark without asking the map. step_mm: the precision to which
    the projector's range is rounded first. texels: how many texels a point reads, 1 or 4, and 5 for slopes' neighbours.
    stored: what of the projector's image a sample must hold. compares: whether the rule only compares single texels
    with a point's range.
    """

    family: str
    bias_mm: float
    rule: Rule = field(compare=False)
    texels: int = 4
    slope: float = 0.0
    stored: Stored = "coarse"
    compares: bool = False
    projector_scale: float = 1
    facing_bit: bool = True
    step_mm: float = 0.1
    note: str = ""

    @property
    def name(self) -> str:
        """Its family and what sets it apart from the family's others, but for what has a column of its own."""
        slope = f" + {self.slope:g} texels' slope" if self.slope else ""
        return f"{self.family}{slope}{self.note}"

    def lit(self, test: ShadowTest, images: Images) -> NDArray[np.bool_]:
        """The mask, bool [H, W]; NumPy alone."""
        camera_range, projector_range, facing = images
        asked = camera_range > 0
        if self.facing_bit:
            asked &= facing
        answer = np.zeros(camera_range.shape, np.bool_)
        pixels, x, y, away = test.project(camera_range, np.flatnonzero(asked))
        answer.ravel()[pixels] = self.rule(projector_range, x, y, away)
        return answer


DEFAULT: Final = Method("interpolated, votes at edges", DEFAULT_BIAS_MM, reached)

_PLAIN: Final[tuple[Stored, ...]] = ("whole", "occluder")
_EDGE_MM: Final = SHADOW_THRESHOLDS.edge_m * 1000
_OTHER_CONSTANTS: Final = ((4, 20), (6, 15), (6, 20), (6, 30), (8, 20), (8, 30), (10, 20), (10, 30), (15, 30))


def methods() -> list[Method]:
    """All that is measured; the first is the default."""
    every = [
        replace(method, projector_scale=scale, facing_bit=facing_bit)
        for facing_bit in (True, False)
        for scale in SCALES
        for method in _families()
    ]
    plain = [replace(DEFAULT, projector_scale=scale, stored=stored) for scale in (1, 2) for stored in _PLAIN]
    rounded = [
        replace(method, projector_scale=scale, step_mm=step_mm, stored="occluder")
        for method in (DEFAULT, compare("nearest texel", 20.0, nearest), compare("votes of four texels", 20.0, votes))
        for scale in (1, 2)
        for step_mm in STEPS_MM
    ]
    shifted = [
        replace(
            DEFAULT,
            bias_mm=float(gap_mm),
            rule=two_rules(gap_mm, edge_mm),
            projector_scale=scale,
            stored="occluder",
            note=f", edge from {edge_mm} mm",
        )
        for scale in (1, 2)
        for gap_mm, edge_mm in _OTHER_CONSTANTS
        if (gap_mm, edge_mm) != (DEFAULT_BIAS_MM, _EDGE_MM)
    ]
    return [DEFAULT, *(method for method in every if method != DEFAULT), *plain, *rounded, *shifted]


def _families() -> Iterator[Method]:
    """All that is tried at every size, with and without the facing bit."""
    yield DEFAULT
    yield Method("interpolated range everywhere", DEFAULT_BIAS_MM, interpolated, stored="occluder")
    for bias_mm in (5.0, 10.0, 20.0, 30.0):
        yield compare("nearest texel", bias_mm, nearest)
        yield compare("votes of four texels", bias_mm, votes)
    for bias_mm in (2.0, 5.0, 10.0):
        yield compare("farthest of four texels", bias_mm, farthest)
    for bias_mm in (2.0, 5.0, 10.0, 20.0):
        yield Method("plane through the texel", bias_mm, plane(bias_mm), 5, stored="whole")
    for bias_mm, slope in ((2.0, 0.5), (2.0, 1.0), (5.0, 1.0)):
        yield Method("nearest texel", bias_mm, nearest(bias_mm, slope), 5, slope, "whole")
        yield Method("votes of four texels", bias_mm, votes(bias_mm, slope), 5, slope, "whole")


def compare(family: str, bias_mm: float, rule: Callable[[float], Rule]) -> Method:
    """A method whose rule only compares texels with a point's range."""
    return Method(family, bias_mm, rule(bias_mm), 1 if rule is nearest else 4, compares=True)


def two_rules(gap_mm: float, edge_mm: float) -> Rule:
    """The default's rule with other constants."""
    return partial(reached, gap=_steps(gap_mm), edge=_steps(edge_mm))


def nearest(bias_mm: float, slope: float = 0.0) -> Rule:
    """The texel that the point falls into must not be nearer than the point by more than the bias."""
    bias = _steps(bias_mm)

    def rule(projector_range: NDArray[np.uint16], x: Floats, y: Floats, away: Floats) -> NDArray[np.bool_]:
        image, start = framed(projector_range), nearest_texel(projector_range, x, y)
        limit = np.minimum(away - np.float32(1), FARTHEST_STEPS) - bias
        if slope:
            across, down = slopes(image, start)
            limit -= np.float32(slope) * (np.abs(across) + np.abs(down))
        lit: NDArray[np.bool_] = image.ravel().take(start) >= limit
        return lit

    return rule


def plane(bias_mm: float) -> Rule:
    """The point must not be behind the plane through the texel that it falls into, sloped as the image is there."""
    bias = _steps(bias_mm)

    def rule(projector_range: NDArray[np.uint16], x: Floats, y: Floats, away: Floats) -> NDArray[np.bool_]:
        image, start = framed(projector_range), nearest_texel(projector_range, x, y)
        across, down = slopes(image, start)
        half = np.float32(0.5)
        x_off, y_off = x - np.floor(x + half), y - np.floor(y + half)
        limit = np.minimum(away - np.float32(1), FARTHEST_STEPS) - bias - across * x_off - down * y_off
        # Nothing is behind an empty texel, whatever the slope beside it.
        limit = np.minimum(limit, FARTHEST_STEPS)
        lit: NDArray[np.bool_] = image.ravel().take(start) >= limit
        return lit

    return rule


def farthest(bias_mm: float) -> Rule:
    """One of the four texels must let the light through."""
    bias = _steps(bias_mm)

    def rule(projector_range: NDArray[np.uint16], x: Floats, y: Floats, away: Floats) -> NDArray[np.bool_]:
        (a, b, c, d), _, _ = four_texels(projector_range, x, y)
        limit = np.minimum(away - np.float32(1), FARTHEST_STEPS) - bias
        lit: NDArray[np.bool_] = np.maximum(np.maximum(a, b), np.maximum(c, d)) >= limit
        return lit

    return rule


def votes(bias_mm: float, slope: float = 0.0) -> Rule:
    """The four texels that let the light through must have half the bilinear weight (percentage-closer filtering)."""
    bias = _steps(bias_mm)

    def rule(projector_range: NDArray[np.uint16], x: Floats, y: Floats, away: Floats) -> NDArray[np.bool_]:
        texels, along, below = four_texels(projector_range, x, y)
        limit = np.minimum(away - np.float32(1), FARTHEST_STEPS) - bias
        if slope:
            across, down = slopes(framed(projector_range), nearest_texel(projector_range, x, y))
            limit -= np.float32(slope) * (np.abs(across) + np.abs(down))
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
    lit: NDArray[np.bool_] = (
        np.minimum(away - 1, FARTHEST_STEPS) - (upper + below * (lower - upper)) <= SHADOW_THRESHOLDS.gap_steps
    )
    return lit


def nearest_texel(projector_range: NDArray[np.uint16], x: Floats, y: Floats) -> NDArray[np.intp]:
    """Flat indices [N] into the framed image of the texels that points fall into."""
    rows, columns = projector_range.shape
    row = np.minimum((y + np.float32(0.5)).astype(np.intp), rows - 1)
    column = np.minimum((x + np.float32(0.5)).astype(np.intp), columns - 1)
    start: NDArray[np.intp] = (row + 1) * (columns + 2) + column + 1
    return start


def slopes(image: NDArray[np.uint16], start: NDArray[np.intp]) -> tuple[Floats, Floats]:
    """Change of range from a texel to the next, across and down, float32 [N] each, in steps.

    Of the differences to both sides the smaller: at an edge, the other one is not of this surface. 0 where both are
    edges.
    """
    flat = image.ravel()
    middle = flat.take(start).astype(np.int32)
    found = []
    for shift in (1, image.shape[1]):
        after = flat.take(start + shift) - middle
        before = middle - flat.take(start - shift)
        change = np.where(np.abs(before) < np.abs(after), before, after)
        found.append(np.where(np.abs(change) < _TORN, change, 0).astype(np.float32))
    return found[0], found[1]


def _steps(length_mm: float) -> np.float32:
    return np.float32(round(length_mm / 1000 / RANGE_STEP_M))
