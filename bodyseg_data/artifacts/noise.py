"""Measurement noise: additive Gaussian on the foreground, one standard deviation an image (paper, section 3.2).

Normals are made of 32 random bits each, by the inverse of their distribution function (docs/explanation/noise.md).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from statistics import NormalDist
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts.artifact import Artifact, RangeImage, Scene
from bodyseg_data.core.errors import BadConfig, check_fields
from bodyseg_data.core.kernels import use_compiled
from bodyseg_data.core.randomness import Draws


@dataclass(frozen=True)
class Noise(Artifact):
    """Gaussian noise of one standard deviation an image, drawn uniformly from [low_mm, high_mm], millimetres."""

    name = "noise"
    kind = "noise"
    purposes = ("sigma", "noise")
    drawn: ClassVar[Mapping[str, str]] = {"sigma_mm": "noise {:.0f} mm"}
    alters_labels = False

    low_mm: float = 0.0
    high_mm: float = 100.0

    def __post_init__(self) -> None:
        check_fields(self)
        if not 0 <= self.low_mm <= self.high_mm <= 1000:
            raise BadConfig(
                f"noise must satisfy 0 <= low <= high <= 1000 mm, found low {self.low_mm} and high {self.high_mm}"
            )

    def sigma_mm(self, chance: float) -> float:
        """The standard deviation of one image, millimetres; chance: uniform from 0 to below 1."""
        return self.low_mm + (self.high_mm - self.low_mm) * chance

    def draw(self, draws: Draws) -> dict[str, float]:
        """As `Artifact.draw`: "sigma_mm", the standard deviation."""
        return {"sigma_mm": self.sigma_mm(draws.chance("sigma"))}

    def apply(self, image: RangeImage, scene: Scene, draws: Draws) -> None:
        """As `Artifact.apply`."""
        ranges, pixels = image.range.reshape(-1), scene.pixels
        before = ranges[pixels]
        sigma = steps_of(image.drawn["sigma_mm"], scene.step_m)
        noisy = add_noise(before, sigma, draws.pixels("noise", len(pixels), np.uint32))
        ranges[pixels] = np.where(before > 0, noisy, 0)


# A segment is a float's exponent and the highest four bits of its mantissa, the rest is the offset in the segment. The
# lowest segment begins at 0.5, the last one is 2**31 alone.
SEGMENT_SHIFT: Final = 19
OFFSET_MASK: Final = (1 << SEGMENT_SHIFT) - 1
FIRST_SEGMENT: Final = (127 - 1) << 4
_OCTAVES: Final = 32


def _segments() -> NDArray[np.float32]:
    """Quadratics that meet the inverse distribution function at the three Chebyshev points of every segment.

    float32 [3, segments]: the factors of 1, offset and offset**2.
    """
    points = 0.5 - 0.5 * np.sqrt([0.75, 0.0, 0.75]) * (1, 0, -1)  # cosines of 30, 90 and 150 degrees
    starts = np.ldexp(1 + np.arange(16) / 16, np.arange(-1, _OCTAVES - 1)[:, None]).ravel()
    widths = np.repeat(np.ldexp(1 / 16, np.arange(-1, _OCTAVES - 1)), 16)
    inverse = NormalDist().inv_cdf
    a, b, c = ([-inverse(x) for x in (starts + point * widths) / 2**32] for point in points)
    slope = np.subtract(b, a) / (points[1] - points[0])
    bend = (np.subtract(c, b) / (points[2] - points[1]) - slope) / (points[2] - points[0])
    constant = a - slope * points[0] + bend * points[0] * points[1]
    linear = slope - bend * (points[0] + points[1])
    scale = 2.0**-SEGMENT_SHIFT
    table = np.stack([constant, linear * scale, bend * scale**2])
    return np.ascontiguousarray(np.pad(table, ((0, 0), (0, 1))), np.float32)


SEGMENTS: Final = _segments()


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


def drawn_bits(draws: Draws, purpose: str, count: int, kind: type[np.uint16] | type[np.uint32]) -> NDArray[Any]:
    """One draw a pixel of a purpose, [count]; see `Draws.pixels`."""
    if use_compiled():
        loops = import_module("bodyseg_data.artifacts.loops.philox")
        found: NDArray[Any] = loops.bits_of(draws.stream(purpose), count, kind)
        return found
    return draws.pixels(purpose, count, kind)


def drawn_normals(draws: Draws, purpose: str, count: int) -> NDArray[np.float32]:
    """One standard normal for each 32 random bits of a purpose, float32 [N]; see `normals`."""
    if use_compiled():
        loops = import_module("bodyseg_data.artifacts.loops.normals")
        found: NDArray[np.float32] = loops.normals_of(draws.stream(purpose), count)
        return found
    return normals(draws.pixels(purpose, count, np.uint32))


def steps_of(sigma_mm: float, step_m: float) -> np.float32:
    """Millimetres as steps of a stored range; step_m: one step, metres."""
    return np.float32(sigma_mm / 1000 / step_m)


def add_noise(foreground: NDArray[np.uint16], sigma: np.float32, draws: NDArray[np.uint32]) -> NDArray[np.uint16]:
    """Noisy copy of the foreground's ranges, uint16 [N] in and out, in steps.

    sigma: the standard deviation in steps. draws: uint32 [N], random bits.

    Rounds to the nearest step and stays within 1 .. 65535: a foreground pixel neither becomes background (0) nor wraps
    around in 16 bits.
    """
    return as_range(foreground.astype(np.float32) + normals(draws) * sigma)


def as_range(steps: NDArray[np.floating]) -> NDArray[np.uint16]:
    """Steps as stored ranges of measured pixels: the nearest whole number from 1 to 65535."""
    found: NDArray[np.uint16] = np.clip(np.rint(steps), 1, 65535).astype(np.uint16)
    return found
