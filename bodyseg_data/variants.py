"""Table 1 of the paper: five data sets from one set of clean samples.

Draws are made for all pixels of the *clean* foreground, in reading order, whichever other artifacts are on. That is
what makes the five variants of a sample share their draws: where `all` keeps a pixel it has the value that `noise`
has there, and its silhouette is that of `occ` and `md` together.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts.missing_data import MissingData, kept_pixels
from bodyseg_data.artifacts.noise import Noise, add_noise
from bodyseg_data.artifacts.occlusion import ShadowTest
from bodyseg_data.errors import BadConfig
from bodyseg_data.parts import BACKGROUND
from bodyseg_data.randomness import check_seed, generator
from bodyseg_data.rig import Rig
from bodyseg_data.sample import Sample

VariantName = Literal["none", "occ", "noise", "md", "all"]


@dataclass(frozen=True)
class Variant:
    """One row of Table 1: which artifacts a data set models."""

    occlusion: bool
    noise: bool
    missing_data: bool


VARIANTS: Final[dict[VariantName, Variant]] = {
    "none": Variant(occlusion=False, noise=False, missing_data=False),
    "occ": Variant(occlusion=True, noise=False, missing_data=False),
    "noise": Variant(occlusion=False, noise=True, missing_data=False),
    "md": Variant(occlusion=False, noise=False, missing_data=True),
    "all": Variant(occlusion=True, noise=True, missing_data=True),
}


def check_variant(name: str) -> VariantName:
    """`name` if Table 1 has it. Raises BadConfig."""
    for known in VARIANTS:
        if name == known:
            return known
    raise BadConfig(f"the variant must be one of {', '.join(VARIANTS)}, found {name!r}")


@dataclass(frozen=True)
class Artifacts:
    """How strong the artifacts are. The defaults are the paper's."""

    noise: Noise = field(default_factory=Noise)
    missing_data: MissingData = field(default_factory=MissingData)


@dataclass(frozen=True)
class RangeImage:
    """A sample as a sensor would deliver it.

    range: uint16 [H, W], steps of 0.1 mm, 0 where nothing was measured; labels: uint8 [H, W], 255 there.
    sigma_mm, missing_rate: what was drawn for this image, None where the variant has no such artifact.
    """

    key: str
    range: NDArray[np.uint16]
    labels: NDArray[np.uint8]
    sigma_mm: float | None
    missing_rate: float | None


@dataclass(frozen=True)
class Augmentation:
    """Turns clean samples of `rig` into one variant. The same (seed, epoch, sample) gives the same bits anywhere."""

    rig: Rig
    variant: VariantName
    seed: int = 0
    artifacts: Artifacts = field(default_factory=Artifacts)

    def __post_init__(self) -> None:
        check_variant(self.variant)
        check_seed(self.seed)

    def __call__(self, sample: Sample, epoch: int = 0) -> RangeImage:
        """Apply the variant's artifacts in the paper's order: occlusion, then noise, then missing data."""
        variant = VARIANTS[self.variant]
        where = np.flatnonzero(sample.range)
        ranges = sample.range.ravel()[where]
        kept = np.ones(len(where), np.bool_)
        sigma_mm = missing_rate = None
        if variant.occlusion:
            test = _shadow_test(self.rig)
            kept &= test.lit(sample.range, sample.projector_range, sample.faces_projector).ravel()[where]
        if variant.noise:
            draws = generator(self.seed, epoch, sample.key, "noise")
            sigma_mm = self.artifacts.noise.draw_sigma_mm(draws)
            ranges = add_noise(ranges, sigma_mm, draws)
        if variant.missing_data:
            draws = generator(self.seed, epoch, sample.key, "missing data")
            missing_rate = self.artifacts.missing_data.draw_rate(draws)
            kept &= kept_pixels(len(where), missing_rate, draws)
        survivors = where[kept]
        image = np.zeros(sample.range.shape, np.uint16)
        labels = np.full(sample.labels.shape, BACKGROUND, np.uint8)
        image.ravel()[survivors] = ranges[kept]
        # A pixel that the variant removed shows nothing, so there is nothing to classify.
        labels.ravel()[survivors] = sample.labels.ravel()[survivors]
        return RangeImage(sample.key, image, labels, sigma_mm, missing_rate)


@lru_cache(maxsize=8)
def _shadow_test(rig: Rig) -> ShadowTest:
    """Built once a rig and process, not once a sample."""
    return ShadowTest(rig)
