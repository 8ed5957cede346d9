"""Ways to test a shadow map, which `bench occlusion` measures beside the default."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts import ShadowTest, framed
from bodyseg_data.artifacts.occlusion import Floats, four_texels
from bodyseg_data.rigs import load_rig
from bodyseg_data.samples import FARTHEST_STEPS, SHADOW_THRESHOLDS

Images = tuple[NDArray[np.uint16], NDArray[np.uint16], NDArray[np.bool_]]
"""Camera range, projector range, facing bit, as `ShadowTest.lit` takes them."""

Rule = Callable[[NDArray[np.uint16], Floats, Floats, Floats], NDArray[np.bool_]]
"""Projector range, x, y, range of points -> whether light gets there, as `ShadowTest.reached`."""

Stored = Literal["whole", "occluder", "coarse"]
"""All texels; those that can shade a pixel; those, rounded as far as no pixel's result changes."""

STEP_M: Final = load_rig().range_step_m
"""One step of the images that are measured, metres: all are of the default rig, or of that with another baseline."""

_GAP_STEPS, _EDGE_STEPS = SHADOW_THRESHOLDS.in_steps(STEP_M)
_TORN: Final = np.int32(_EDGE_STEPS)  # a larger difference between neighbours is no slope


@dataclass(frozen=True)
class Method:
    """One way to make the mask.

    bias_mm: how far behind what the projector sees a point may be. facing_bit: whether surfaces that face away count as
    dark without a look at the map. texels: how many texels a point reads, 1 or 4, and 5 for slopes' neighbours. stored:
    what of the projector's image a sample must hold. compares: whether the rule only compares single texels with a
    point's range.
    """

    family: str
    bias_mm: float
    rule: Rule = field(compare=False)
    texels: int = 4
    stored: Stored = "coarse"
    compares: bool = False
    projector_scale: int = 1
    facing_bit: bool = True

    def lit(self, test: ShadowTest, images: Images) -> NDArray[np.bool_]:
        """The mask, bool [H, W]; NumPy alone."""
        camera_range, projector_range, facing = images
        tested = camera_range > 0
        if self.facing_bit:
            tested &= facing
        lit = np.zeros(camera_range.shape, np.bool_)
        pixels, x, y, away = test.project(camera_range, np.flatnonzero(tested))
        lit.ravel()[pixels] = self.rule(projector_range, x, y, away)
        return lit


def nearest(bias_mm: float) -> Rule:
    """The texel that the point falls into must not be nearer than the point by more than the bias."""
    bias = _steps(bias_mm)

    def rule(projector_range: NDArray[np.uint16], x: Floats, y: Floats, away: Floats) -> NDArray[np.bool_]:
        image, start = framed(projector_range), nearest_texel(projector_range, x, y)
        lit: NDArray[np.bool_] = image.ravel().take(start) >= np.minimum(away - np.float32(1), FARTHEST_STEPS) - bias
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


def votes(bias_mm: float) -> Rule:
    """The four texels that let the light through must have half the bilinear weight (percentage-closer filtering)."""
    bias = _steps(bias_mm)

    def rule(projector_range: NDArray[np.uint16], x: Floats, y: Floats, away: Floats) -> NDArray[np.bool_]:
        texels, along, below = four_texels(projector_range, x, y)
        limit = np.minimum(away - np.float32(1), FARTHEST_STEPS) - bias
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
    lit: NDArray[np.bool_] = np.minimum(away - 1, FARTHEST_STEPS) - (upper + below * (lower - upper)) <= _GAP_STEPS
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
    return np.float32(round(length_mm / 1000 / STEP_M))


def _compare(family: str, bias_mm: float, rule: Callable[[float], Rule]) -> Method:
    """A method whose rule only compares texels with a point's range."""
    return Method(family, bias_mm, rule(bias_mm), 1 if rule is nearest else 4, compares=True)


DEFAULT: Final = Method(
    "interpolated, votes at edges",
    SHADOW_THRESHOLDS.surface_gap_m * 1000,
    ShadowTest(load_rig()).reached,
)
NEAREST: Final = _compare("nearest texel", 20.0, nearest)
"""The default's closest baseline."""

METHODS: Final = (
    DEFAULT,
    replace(DEFAULT, projector_scale=2),
    replace(DEFAULT, projector_scale=3),
    replace(DEFAULT, facing_bit=False),
    NEAREST,
    replace(NEAREST, projector_scale=2),
    replace(_compare("nearest texel", 10.0, nearest), facing_bit=False),
    _compare("votes of four texels", 20.0, votes),
    replace(_compare("votes of four texels", 30.0, votes), projector_scale=2),
    _compare("farthest of four texels", 10.0, farthest),
    Method("plane through the texel", 10.0, plane(10.0), 5, stored="whole"),
    Method("interpolated range everywhere", DEFAULT.bias_mm, interpolated, stored="occluder"),
)
"""All that is measured: the default, what no other beats in error and time, and one of each other kind."""
