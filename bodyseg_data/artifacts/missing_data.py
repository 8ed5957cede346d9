"""Missing data: foreground pixels lost at random, one rate an image (paper, section 3.2)."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts.artifact import Artifact, RangeImage, Scene
from bodyseg_data.core import BadConfig, Draws, bounded


@dataclass(frozen=True)
class MissingData(Artifact):
    """Pixels lost at random; the share of the foreground that is lost is drawn once an image.

    rates: shares to choose from, each as likely; so the paper's "randomly chosen between 0%, 5% and 50%" is read.
    between: (low, high) draws the share uniformly from that interval instead; it cannot be given together with `rates`.
    """

    name = "missing_data"
    kind = "missing_data"
    either = ("rates", "between")
    purposes = ("missing rate", "missing data")
    drawn: ClassVar[Mapping[str, str]] = {"missing_rate": "{:.0%} missing"}

    rates: tuple[float, ...] = bounded((0.0, 0.05, 0.5), 0, 1)
    between: tuple[float, float] | None = bounded(None, 0, 1)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.rates:
            raise BadConfig("missing data must have one rate at least, found none")
        if self.between is not None and self.between[0] > self.between[1]:
            raise BadConfig(f"missing data: between must be (low, high) with low <= high, found {self.between}")
        if self.between is not None and self.rates != MissingData.rates:  # the default is stored with `between`
            raise BadConfig(f"missing data takes rates or between, not both, found {self.rates} and {self.between}")

    def draw(self, draws: Draws) -> dict[str, float]:
        """As `Artifact.draw`: "missing_rate", the share of pixels lost."""
        chance = draws.chance("missing rate")
        if self.between is not None:
            low, high = self.between
            return {"missing_rate": low + (high - low) * chance}
        return {"missing_rate": self.rates[int(chance * len(self.rates))]}

    def apply(self, image: RangeImage, scene: Scene, draws: Draws) -> None:
        pixels = scene.pixels
        kept = kept_pixels(image.drawn["missing_rate"], draws.pixels("missing data", len(pixels), np.uint16))
        image.range.reshape(-1)[pixels[~kept]] = 0


def threshold(rate: float) -> int:
    """The number of the 65 536 values of 16 random bits that lose a pixel: the rate, to the nearest of them."""
    return round(rate * 65536)


def kept_pixels(rate: float, draws: NDArray[np.uint16]) -> NDArray[np.bool_]:
    """Mark the foreground pixels that survive, bool [N]; draws: uint16 [N], random bits.

    Each is lost independently with probability `rate`, to the nearest multiple of 2**-16.
    """
    return draws >= np.uint32(threshold(rate))
