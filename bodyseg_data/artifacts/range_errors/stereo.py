"""Errors of triangulation: noise and rounding of the disparity, from which stereo and structured light get the range.

disparity = focal length * baseline / range, pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts.artifact import Artifact, RangeImage, Scene
from bodyseg_data.artifacts.noise import as_range
from bodyseg_data.artifacts.range_errors.gaussian import add_gaussian, clean_metres, loops
from bodyseg_data.core.errors import BadConfig, bounded, check_fields
from bodyseg_data.core.kernels import use_compiled
from bodyseg_data.core.randomness import Draws
from bodyseg_data.core.rig import Rig


@dataclass(frozen=True)
class StereoNoise(Artifact):
    """Gaussian noise of the disparity: sigma in range is range**2 * subpixel / (focal length * baseline).

    The limit of stereo (Grunnet-Jepsen, Sweetser and Woodfill, "Best-known-methods for tuning Intel RealSense D400
    depth cameras for best performance", 2018).

    subpixel_px: sigma of the disparity, pixels. focal_px, baseline_m: of the sensor; None for those of the rig.
    """

    name = "stereo_noise"
    kind = "noise"
    purposes = ("stereo noise",)
    alters_labels = False

    subpixel_px: float = bounded(0.08, 0, 10)
    focal_px: float | None = bounded(None, 0, 1e6, above=True)
    baseline_m: float | None = bounded(None, 0, 100, above=True)

    def __post_init__(self) -> None:
        check_fields(self)

    def apply(self, image: RangeImage, scene: Scene, draws: Draws) -> None:
        """As `Artifact.apply`. Raises BadConfig for a rig whose camera and projector are at one point."""
        scale = focal_baseline(scene.rig, self.focal_px, self.baseline_m)
        ranges = clean_metres(scene)
        add_gaussian(image, scene, draws, "stereo noise", ranges * ranges * np.float32(self.subpixel_px / scale))


@dataclass(frozen=True)
class DisparityRounding(Artifact):
    """Disparities rounded to whole steps: ranges have gaps that grow with the square of the range.

    step_px: pixels; Kinect v1 and other PrimeSense sensors have eighths (Konolige and Mihelich, "Technical description
    of Kinect calibration", ROS, 2012). focal_px, baseline_m: of the sensor; None for those of the rig. A range whose
    disparity rounds to 0 is lost.
    """

    name = "disparity_rounding"
    kind = "noise"

    step_px: float = bounded(0.125, 0, 100, above=True)
    focal_px: float | None = bounded(None, 0, 1e6, above=True)
    baseline_m: float | None = bounded(None, 0, 100, above=True)

    def __post_init__(self) -> None:
        check_fields(self)

    def apply(self, image: RangeImage, scene: Scene, draws: Draws) -> None:
        """As `Artifact.apply`. Raises BadConfig for a rig whose camera and projector are at one point."""
        scale = focal_baseline(scene.rig, self.focal_px, self.baseline_m) / self.step_px / scene.step_m
        ranges = image.range.reshape(-1)
        if use_compiled():
            loops().round_disparities(ranges, scale)
            return
        pixels = np.flatnonzero(ranges)
        disparity: NDArray[np.float64] = np.rint(scale / ranges[pixels])
        ranges[pixels] = np.where(disparity > 0, as_range(scale / np.maximum(disparity, 1)), 0)


def focal_baseline(rig: Rig, focal_px: float | None, baseline_m: float | None) -> float:
    """Focal length times baseline, pixels times metres. Raises BadConfig if that is 0."""
    scale = (focal_px or rig.camera.focal_px) * (baseline_m or rig.baseline_m)
    if scale == 0:
        raise BadConfig(f"rig {rig.name} has no baseline: give the sensor's as 'baseline_m'")
    return scale
