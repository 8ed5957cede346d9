"""Horizontal flip: the mirror image, with the left and right of the body exchanged."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bodyseg_data.core.labels.lookup import looked_up
from bodyseg_data.core.parts import MIRRORED_LABELS
from bodyseg_data.core.randomness import unit
from bodyseg_data.core.system.reused_memory import SCRATCH
from bodyseg_data.loading.transforms.camera_image import CameraImage
from bodyseg_data.loading.transforms.checks import check_number
from bodyseg_data.loading.transforms.transform import Transform


@dataclass(frozen=True)
class Flip(Transform):
    """The image mirrored, left and right columns exchanged, and so the labels of left and right parts (`Part.mirror`).

    share: of the samples that are mirrored, 0 to 1; each is drawn. The body seen is then the mirror image of the one
    rendered. Shadows of the projector lie on the other side, as of a rig whose projector stands there. Raises BadConfig
    for a share out of range.
    """

    name = "flip"
    share: float = 0.5

    def __post_init__(self) -> None:
        check_number(self.name, "share", self.share, 0, 1)

    def __call__(self, image: CameraImage, random: np.random.Generator) -> CameraImage:
        """See `Transform`."""
        if unit(random) >= self.share:
            return image
        ranges, (x, y) = SCRATCH.empty(image.range.shape, np.uint16), image.centre_px
        ranges[...] = image.range[:, ::-1]
        return replace(
            image,
            range=ranges,
            labels=looked_up(image.labels[:, ::-1], MIRRORED_LABELS),
            centre_px=(image.range.shape[1] - x, y),
        )
