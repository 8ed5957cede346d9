"""The samples that transforms receive and return: range, labels, and the camera that sees them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts.artifact import RangeImage
from bodyseg_data.artifacts.surface import box_of
from bodyseg_data.core.parts import BACKGROUND
from bodyseg_data.core.rigs.camera import Camera
from bodyseg_data.core.sample import Sample, SampleInfo
from bodyseg_data.loading.image_set import metres

Box = tuple[int, int, int, int]
"""First row, end of the rows, first column, end of the columns."""


@dataclass(frozen=True, repr=False)
class CameraImage(RangeImage):
    """A range image with artifacts, and the pinhole camera whose image it is; `dataclasses.replace` makes altered ones.

    range: uint16 [H, W], steps of `step_m` along the optical axis, 0 where nothing was measured. labels: uint8 [H, W],
    parts 0 to 32, 255 where there is none. step_m: one step, metres. focal_px: focal length in pixels. centre_px:
    position (x, y) of the optical axis in image coordinates, in which pixel (row, column) covers x from column to
    column + 1. sample: the stored one, for `info`; its arrays may have been used for this image.
    """

    step_m: float
    focal_px: float
    centre_px: tuple[float, float]
    sample: Sample

    @property
    def info(self) -> SampleInfo:
        """Origin of the sample, and the view it was rendered from: as stored, whatever transforms do."""
        return self.sample.info

    @property
    def metres(self) -> NDArray[np.float32]:
        """Ranges in metres, float32 [H, W], 0 where nothing was measured; see `image_set.metres`."""
        return metres(self.range, self.step_m)

    @property
    def body_box(self) -> Box | None:
        """The smallest box that holds all labelled pixels; None if there are none."""
        return ends_of(self.labels != BACKGROUND)


def with_camera(image: RangeImage, camera: Camera, step_m: float, sample: Sample) -> CameraImage:
    """A range image of a stored sample with the camera of its rig."""
    return CameraImage(
        image.key, image.range, image.labels, image.drawn, step_m, camera.focal_px, camera.centre_px, sample
    )


def ends_of(mask: NDArray[Any]) -> Box | None:
    """The smallest box that holds all of an image [H, W] that is not 0; None if nothing is."""
    box = box_of(mask)
    return None if box is None else (box[0].start, box[0].stop, box[1].start, box[1].stop)
