"""Table 1 of the paper: five data sets from one set of clean samples.

Draws are made for all pixels of the *clean* foreground, in reading order, whichever other artifacts are on. That is
what makes the five variants of a sample share their draws: where `all` keeps a pixel it has the value that `noise`
has there, and its silhouette is that of `occ` and `md` together.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from importlib import import_module
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts.losses import Losses
from bodyseg_data.artifacts.missing_data import MissingData, kept_pixels
from bodyseg_data.artifacts.noise import Noise, add_noise
from bodyseg_data.artifacts.occlusion import ShadowTest
from bodyseg_data.artifacts.scratch import copy_unless_same
from bodyseg_data.core.errors import BadConfig, BadSample
from bodyseg_data.core.kernels import use_compiled
from bodyseg_data.core.parts import BACKGROUND
from bodyseg_data.core.randomness import Stream, chance, check_epoch, check_seed, generator, pixel_draws, stream
from bodyseg_data.core.rig import Rig
from bodyseg_data.core.sample import Sample

VariantName = Literal["none", "occ", "noise", "md", "all", "occ+noise", "occ+md", "noise+md"]


@dataclass(frozen=True)
class Variant:
    """Which artifacts a data set models: a row of Table 1, or two of them."""

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
"""Table 1."""

PAIRS: Final[dict[VariantName, Variant]] = {
    "occ+noise": Variant(occlusion=True, noise=True, missing_data=False),
    "occ+md": Variant(occlusion=True, noise=False, missing_data=True),
    "noise+md": Variant(occlusion=False, noise=True, missing_data=True),
}
"""`all` without one artifact, to see what that one is worth. The paper has none of them."""

_KNOWN: Final = VARIANTS | PAIRS


def check_variant(name: str) -> VariantName:
    """`name` if it is known. Raises BadConfig."""
    for known in _KNOWN:
        if name == known:
            return known
    raise BadConfig(f"the variant must be one of {', '.join(_KNOWN)}, found {name!r}")


def artifacts_of(name: str) -> Variant:
    """Which artifacts a variant has. Raises BadConfig for an unknown name."""
    return _KNOWN[check_variant(name)]


@dataclass(frozen=True)
class Artifacts:
    """How strong the artifacts are. The defaults are the paper's.

    losses: pixels lost together where a variant has missing data; the paper has none.
    """

    noise: Noise = field(default_factory=Noise)
    missing_data: MissingData = field(default_factory=MissingData)
    losses: Losses | None = None


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
        for name, kind in (("rig", Rig), ("artifacts", Artifacts)):
            if not isinstance(getattr(self, name), kind):
                found = type(getattr(self, name)).__name__
                raise BadConfig(f"{name} must be of class {kind.__name__}, found {found}")

    def __call__(self, sample: Sample, epoch: int = 0) -> RangeImage:
        """The sample as the variant shows it, in arrays of its own. Raises as `into`."""
        return self.into(sample, epoch, np.empty(sample.range.shape, np.uint16), np.empty(sample.range.shape, np.uint8))

    def into(self, sample: Sample, epoch: int, image: NDArray[np.uint16], labels: NDArray[np.uint8]) -> RangeImage:
        """As calling, but into arrays that are there: uint16 and uint8 [H, W], contiguous, whatever they hold.

        They may be the sample's own, which is then gone.

        Applies the variant's artifacts in the paper's order: occlusion, then noise, then missing data. Raises BadSample
        for arrays that do not fit the sample, or a sample whose images fit neither each other nor the rig, or that
        lacks the projector's range.
        """
        epoch = check_epoch(epoch)
        _check_sample(sample)
        _check_fit(sample, "the image", image, np.uint16)
        _check_fit(sample, "the image of labels", labels, np.uint8)
        variant = artifacts_of(self.variant)
        sigma_mm = missing_rate = None
        if variant.noise:
            sigma_mm = self.artifacts.noise.sigma_mm(chance(self.seed, epoch, sample.key, "sigma"))
        if variant.missing_data:
            missing_rate = self.artifacts.missing_data.rate(chance(self.seed, epoch, sample.key, "missing rate"))
        made = RangeImage(sample.key, image, labels, sigma_mm, missing_rate)
        lost = None
        if variant.missing_data and self.artifacts.losses is not None:
            draws = generator(self.seed, epoch, sample.key, "losses")
            lost = self.artifacts.losses.lost(sample.range, self.rig.camera, draws)
        test = _shadow_test(self.rig) if variant.occlusion else None
        if self.variant == "none":
            copy_unless_same(sample.range, image)
            copy_unless_same(sample.labels, labels)
        elif use_compiled():
            _loops().apply_artifacts(sample, test, self._streams(sample, epoch), made)
        else:
            self._apply_plainly(sample, test, epoch, made)
        if lost is not None:
            made.range[lost] = 0
            made.labels[lost] = BACKGROUND
        return made

    def prepare(self) -> None:
        """Load, or make, whatever compiled code is needed, so that workers forked from this process have it too."""
        if self.variant != "none" and use_compiled():
            _loops().compile_all()

    def _apply_plainly(self, sample: Sample, test: ShadowTest | None, epoch: int, made: RangeImage) -> None:
        """What the compiled loops do, in NumPy."""
        where = np.flatnonzero(sample.range != 0)
        ranges = sample.range.ravel()[where]
        kept = np.ones(len(where), np.bool_)
        if test is not None:
            kept &= test.lit(sample.range, sample.occluder_range(), sample.faces_projector).ravel()[where]
        noise, missing_data = self._streams(sample, epoch)
        if made.sigma_mm is not None:
            ranges = add_noise(ranges, made.sigma_mm, pixel_draws(noise, len(where), np.uint32))
        if made.missing_rate is not None:
            kept &= kept_pixels(made.missing_rate, pixel_draws(missing_data, len(where), np.uint16))
        survivors = where[kept]
        survivors_labels = sample.labels.ravel()[survivors]
        made.range.fill(0)
        made.labels.fill(BACKGROUND)
        made.range.ravel()[survivors] = ranges[kept]
        # A pixel that the variant removed shows nothing, so there is nothing to classify.
        made.labels.ravel()[survivors] = survivors_labels

    def _streams(self, sample: Sample, epoch: int) -> tuple[Stream, Stream]:
        """The random words of noise and of missing data."""
        noise, missing_data = (stream(self.seed, epoch, sample.key, purpose) for purpose in ("noise", "missing data"))
        return noise, missing_data


def _check_sample(sample: Sample) -> None:
    """Raise BadSample unless there is a label for every range: compiled loops look at no length."""
    ranges, labels = sample.range, sample.labels
    if ranges.dtype != np.uint16 or labels.dtype != np.uint8 or ranges.shape != labels.shape:
        raise BadSample(
            f"{sample.key}: range and labels must be uint16 and uint8 of one shape, "
            f"found {ranges.dtype} {ranges.shape} and {labels.dtype} {labels.shape}"
        )


def _check_fit(sample: Sample, what: str, array: NDArray[Any], kind: type[np.generic]) -> None:
    if array.dtype != kind or array.shape != sample.range.shape or not array.flags.carray:
        raise BadSample(
            f"{sample.key}: {what} must be a contiguous array of {kind.__name__} {sample.range.shape} "
            f"that can be written to, found {array.dtype} {array.shape}"
        )


def _loops() -> Any:
    """The compiled loops; they load numba, so not before they are used."""
    return import_module("bodyseg_data.artifacts.compiled")


@lru_cache(maxsize=8)
def _shadow_test(rig: Rig) -> ShadowTest:
    """Built once a rig and process, not once a sample."""
    return ShadowTest(rig)
