"""Table 1 of the paper: five data sets from one set of clean samples, for any sensor.

A variant names kinds of artifacts, and takes those artifacts of a sensor model that are of these kinds: the five
variants of the paper are those of the sensor `paper`.

Draws are made for all pixels of the *clean* foreground, in reading order, whichever other artifacts are on. So the five
variants of a sample share their draws: where `all` keeps a pixel it has the value that `noise` has there, and its
silhouette is that of `occ` and `md` together.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts.artifact import Artifact, Kind, RangeImage, Scene, check_image
from bodyseg_data.artifacts.scratch import copy_unless_same
from bodyseg_data.artifacts.sensor_model import SensorModel, load_sensor_model
from bodyseg_data.core import BadConfig, BadSample, Draws, check_choice, check_epoch, check_fields, check_seed
from bodyseg_data.labels import BACKGROUND, PART_CLASSES, UNLABELLED, Classes
from bodyseg_data.machine import if_ready, loops
from bodyseg_data.rigs import Rig
from bodyseg_data.samples import Sample

_LOOPS: Final = "bodyseg_data.artifacts.fused_loops"

VariantName = Literal["none", "occ", "noise", "md", "all", "occ+noise", "occ+md", "noise+md"]

VARIANTS: Final[dict[VariantName, tuple[Kind, ...]]] = {
    "none": (),
    "occ": ("occlusion",),
    "noise": ("noise",),
    "md": ("missing_data",),
    "all": ("occlusion", "noise", "missing_data"),
}
"""Table 1: name -> the kinds of artifacts that its images have."""

PAIRS: Final[dict[VariantName, tuple[Kind, ...]]] = {
    "occ+noise": ("occlusion", "noise"),
    "occ+md": ("occlusion", "missing_data"),
    "noise+md": ("noise", "missing_data"),
}
"""`all` without one kind of artifact, to measure its worth. The paper has none of them."""

_PRESETS: Final = VARIANTS | PAIRS


def check_variant(name: str) -> VariantName:
    """`name` if a variant is called so. Raises BadConfig."""
    return check_choice("the variant", name, _PRESETS)


def kinds_of(variant: str) -> tuple[Kind, ...]:
    """The kinds of artifacts that a variant has. Raises BadConfig for an unknown name."""
    return _PRESETS[check_variant(variant)]


def sensor_for(variant: str, sensor: SensorModel, given: Sequence[Artifact]) -> SensorModel:
    """The sensor with other strengths for the artifacts given, or with them added.

    Raises BadConfig for one whose kind the variant does not have, so that no strength is set in vain; otherwise as
    `SensorModel.with_artifacts`.
    """
    found = sensor.with_artifacts(*given)
    for artifact in given:
        if artifact.kind not in kinds_of(variant):
            raise BadConfig(
                f"a strength of {artifact.name} is for a variant that has {artifact.kind}, found variant {variant!r}"
            )
    return found


@dataclass(frozen=True)
class Augmentation:
    """Makes one variant of clean samples of a rig. The same (seed, epoch, sample) gives the same bits anywhere.

    sensor: the artifacts; the variant takes those of its kinds. classes: of the samples' labels. Raises BadConfig for
    an unknown variant, a bad seed, or objects of other classes.
    """

    rig: Rig
    variant: VariantName
    seed: int = 0
    sensor: SensorModel = field(default_factory=load_sensor_model)
    classes: Classes = PART_CLASSES

    def __post_init__(self) -> None:
        check_variant(self.variant)
        check_seed(self.seed)
        check_fields(self)

    def __repr__(self) -> str:
        return f"Augmentation(rig {self.rig.name!r}, {self.variant!r}, seed={self.seed}, {self.sensor})"

    @cached_property
    def applied(self) -> tuple[Artifact, ...]:
        """The artifacts that images of the variant get, in the order in which they apply."""
        return tuple(artifact for artifact in self.sensor if artifact.kind in kinds_of(self.variant))

    @cached_property
    def needs_projector(self) -> bool:
        """True if samples must hold the projector's range."""
        return any(artifact.needs_projector for artifact in self.applied)

    def __call__(self, sample: Sample, epoch: int = 0) -> RangeImage:
        """Return the sample as the variant shows it, in new arrays. Raises as `into`."""
        return self.into(sample, epoch, np.empty(sample.range.shape, np.uint16), np.empty(sample.range.shape, np.uint8))

    def into(self, sample: Sample, epoch: int, image: NDArray[np.uint16], labels: NDArray[np.uint8]) -> RangeImage:
        """Write the sample as the variant shows it into given arrays, by the variant's artifacts in the sensor's order.

        image, labels: uint16 and uint8 [H, W], contiguous, with any content. They may be the sample's own arrays, which
        are then overwritten. In the paper's sensor, artifacts are in the order occlusion, noise, missing data.
        Raises BadSample for arrays that do not fit the sample, for a sample whose images do not fit each other and the
        rig, or for one that lacks the projector's range.
        """
        draws = Draws(self.seed, check_epoch(epoch), sample.key)
        shape = self.rig.camera.rows, self.rig.camera.columns
        check_image(f"{sample.key}: range", sample.range, np.uint16, shape)
        check_image(f"{sample.key}: labels", sample.labels, np.uint8, shape)
        check_image(f"{sample.key}: the image", image, np.uint16, shape)
        check_image(f"{sample.key}: the image of labels", labels, np.uint8, shape)
        if not (image.flags.carray and labels.flags.carray):
            raise BadSample(f"{sample.key}: images must be contiguous arrays that can be written to")
        drawn: dict[str, float] = {}
        for artifact in self.applied:
            with BadConfig.named(f"{sample.key}: artifact {artifact.name!r}"):
                own = artifact.draw(replace(draws, purposes=artifact.purposes))
                for name in own.keys() - artifact.drawn.keys():  # it might be another artifact's
                    raise BadConfig(f"artifact {artifact.name!r} must list what it draws in 'drawn', found {name!r}")
                drawn |= own
        made = RangeImage(sample.key, image, labels, drawn)
        covered, clean = 0, sample
        # Artifacts see the clean sample, even if the result is written into its arrays.
        with if_ready:
            if self._covered:
                clean = _apart(sample, made) if self._covered < len(self.applied) else sample
                loops(_LOOPS).apply_covered(self.applied[: self._covered], made, Scene(sample, self.rig), draws)
                covered = self._covered
        if not covered:
            clean = _apart(sample, made) if self.applied else sample
            copy_unless_same(sample.range, image)
            copy_unless_same(sample.labels, labels)
        if covered < len(self.applied):
            scene = Scene(clean, self.rig, self.classes)
            for artifact in self.applied[covered:]:
                named = f"{sample.key}: artifact {artifact.name!r}"
                with BadConfig.named(named):
                    artifact.apply(made, scene, replace(draws, purposes=artifact.purposes))
                changed, count = labels[labels != clean.labels], len(self.classes)
                if (strange := changed[(changed >= count) & (changed < UNLABELLED)]).size:
                    raise BadConfig(f"{named} must give labels 0 to {count - 1}, 254 or 255, found {strange.min()}")
            lost = (image == 0).view(np.uint8)  # such pixels show nothing, so there is nothing to classify
            lost *= BACKGROUND  # 255: all bits
            labels |= lost
        return made

    @property
    def keeps_outline(self) -> bool:
        """True if pixels outside the clean foreground are known to stay background; only compiled loops know it."""
        with if_ready:
            return self._covered == len(self.applied)
        return False

    @cached_property
    def _covered(self) -> int:
        """The number of artifacts, from the first on, that are applied in one compiled call."""
        return loops(_LOOPS).covered(self.applied) if self.applied else 0


def shown_with(artifact: Artifact, sample: Sample, rig: Rig, seed: int, epoch: int = 0) -> RangeImage:
    """A clean sample with one artifact alone, in arrays of its own; draws are those of a variant that has it."""
    return Augmentation(rig, "all", seed, SensorModel("one", (artifact,)))(sample, epoch)


def _apart(sample: Sample, image: RangeImage) -> Sample:
    """The sample, or a copy of it if an image lies in its arrays."""
    if not any(np.may_share_memory(a, b) for a, b in ((sample.range, image.range), (sample.labels, image.labels))):
        return sample
    return replace(sample, range=sample.range.copy(), labels=sample.labels.copy())
