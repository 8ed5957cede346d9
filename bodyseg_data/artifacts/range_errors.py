"""Errors of single ranges, as sensors make them: noise, mixed pixels and rounding.

Axial noise grows with range and angle of incidence, lateral noise makes silhouettes ragged, mixed (flying) pixels lie
between two surfaces, and sensors round what they write. Stereo and structured light measure disparities, in pixels:

    disparity = focal length * baseline / range
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts.artifact import Artifact, RangeImage, Scene, bounded, one_of
from bodyseg_data.artifacts.noise import as_range, drawn_bits, drawn_normals
from bodyseg_data.artifacts.surface import compiled_forms, grazing, widened
from bodyseg_data.core import BadConfig, Draws
from bodyseg_data.machine import if_ready
from bodyseg_data.rigs import Rig

POWERS: Final = (-0.5, 0.0, 0.5, 1.0, 1.5, 2.0)
"""Powers of the range that the grazing term may have: roots and products give the same bits on every machine."""

REACH: Final = 3
"""Rows and columns around the body, pixels, in which background may show it."""


@dataclass(frozen=True)
class AxialNoise(Artifact):
    """Gaussian noise whose sigma in millimetres is, at z metres and an angle of incidence theta,

        constant_mm + quadratic_mm * (z - from_m)**2 + grazing_mm * z**grazing_power * (theta / (pi/2 - theta))**2

    The form and the defaults, for Kinect v1, are those of Nguyen, Izadi and Lovell, "Modeling Kinect sensor noise for
    improved 3D reconstruction and tracking", 3DIMPVT 2012, equation 6. theta is at most 85 degrees (`angles`).
    """

    name = "axial_noise"
    kind = "noise"
    purposes = ("axial noise",)
    alters_labels = False

    constant_mm: float = bounded(1.2, 0, 1000)
    quadratic_mm: float = bounded(1.9, 0, 1000)
    from_m: float = bounded(0.4, -100, 100)
    grazing_mm: float = bounded(0.1, 0, 1000)
    grazing_power: float = one_of(-0.5, POWERS)

    def sigma_m(self, range_m: NDArray[np.float32], angle: NDArray[np.float32]) -> NDArray[np.float32]:
        """The standard deviation, metres, [N]; range_m: metres, [N]; angle: of incidence, radians, [N]."""
        with if_ready:
            terms = tuple(map(np.float32, (self.constant_mm, self.quadratic_mm, self.from_m, self.grazing_mm)))
            compiled = np.empty_like(range_m)
            compiled_forms().axial_sigma(range_m, angle, terms, round(2 * self.grazing_power), compiled)
            return compiled
        away = range_m - np.float32(self.from_m)
        root = np.sqrt(range_m)
        power = np.float32(1) / root if self.grazing_power < 0 else np.ones_like(root)
        for _ in range(round(2 * self.grazing_power)):
            power *= root
        sigma = np.float32(self.constant_mm) + np.float32(self.quadratic_mm) * (away * away)
        sigma += np.float32(self.grazing_mm) * power * grazing(angle) ** 2
        found: NDArray[np.float32] = sigma * np.float32(1e-3)
        return found

    def apply(self, image: RangeImage, scene: Scene, draws: Draws) -> None:
        add_gaussian(image, scene, draws, "axial noise", self.sigma_m(clean_metres(scene), scene.incidence))


@dataclass(frozen=True)
class LateralNoise(Artifact):
    """Each pixel shows range and label of the pixel beside it that Gaussian offsets of sigma pixels, by row and by
    column, lead to:

        sigma = constant_px + grazing_px * theta / (pi/2 - theta)

    at an angle of incidence theta; of background, `constant_px`. The form and the defaults, for Kinect v1, are those of
    Nguyen, Izadi and Lovell, "Modeling Kinect sensor noise for improved 3D reconstruction and tracking", 3DIMPVT 2012,
    equation 5. Background at most `REACH` rows and columns from the body may show the body.
    """

    name = "lateral_noise"
    kind = "noise"
    purposes = ("lateral noise",)

    constant_px: float = bounded(0.8, 0, 20)
    grazing_px: float = bounded(0.035, 0, 20)

    def apply(self, image: RangeImage, scene: Scene, draws: Draws) -> None:
        clean = scene.sample.range
        if not len(scene.pixels):
            return
        near = widened(clean > 0, REACH)
        pixels = np.flatnonzero(near)
        normals = drawn_normals(draws, "lateral noise", 2 * len(pixels))
        with if_ready:
            flat, terms = (
                np.ascontiguousarray(clean).reshape(-1),
                (np.float32(self.constant_px), np.float32(self.grazing_px)),
            )
            given = flat, clean.shape[1], pixels, scene.incidence, terms, normals
            compiled_forms().beside(
                image.range.reshape(-1), image.labels.reshape(-1), *given, np.empty((2, len(pixels)), np.uint16)
            )
            return
        rows, columns = np.divmod(pixels, clean.shape[1])
        sigma = np.full(clean.shape, self.constant_px, np.float32)
        sigma.reshape(-1)[scene.pixels] += np.float32(self.grazing_px) * grazing(scene.incidence)
        offsets = normals.reshape(2, -1) * sigma[near]
        down, along = np.rint(offsets).astype(np.int64)
        source = (
            np.clip(rows + down, 0, clean.shape[0] - 1),
            np.clip(columns + along, 0, clean.shape[1] - 1),
        )
        image.range[near], image.labels[near] = image.range[source], image.labels[source]


@dataclass(frozen=True)
class MixedPixels(Artifact):
    """Pixels beside a farther surface, each with probability `share`, get a range between both, uniform over the gap.

    A surface is farther if it is at least `jump_mm` behind, in a pixel above, below, left or right. background_m: range
    of what lies behind the body, metres, for the body's own silhouette; None if nothing is in reach of the sensor, so
    only edges before other parts of the body are mixed. Labels stay: the pixel sees the body, too.
    """

    name = "mixed_pixels"
    kind = "noise"
    purposes = ("mixed pixels",)
    alters_labels = False

    share: float = bounded(0.5, 0, 1)
    background_m: float | None = bounded(None, 0, 100, above=True)
    jump_mm: float = bounded(30.0, 0, 10_000, above=True)

    def apply(self, image: RangeImage, scene: Scene, draws: Draws) -> None:
        behind = 0 if self.background_m is None else round(self.background_m / scene.step_m)
        # The higher half of a draw chooses, the lower one is the position in the gap.
        bits = drawn_bits(draws, "mixed pixels", len(scene.pixels), np.uint32)
        with if_ready:
            flat, steps = image.range.reshape(-1), np.ascontiguousarray(scene.sample.range).reshape(-1)
            limits = self.share * 65536, behind, self.jump_mm, scene.step_m
            compiled_forms().mix(flat, steps, image.range.shape[1], scene.pixels, bits, *limits)
            return
        clean = scene.sample.range.astype(np.int64)
        seen = np.pad(np.where(clean > 0, clean, behind), 1)
        neighbours = seen[:-2, 1:-1], seen[2:, 1:-1], seen[1:-1, :-2], seen[1:-1, 2:]
        farthest = np.maximum.reduce(neighbours).reshape(-1)[scene.pixels]
        gap = farthest - clean.reshape(-1)[scene.pixels]
        chosen = (bits >> np.uint32(16)) < self.share * 65536
        mixed = np.flatnonzero(chosen & (gap * scene.step_m * 1000 >= self.jump_mm))
        ranges, pixels = image.range.reshape(-1), scene.pixels[mixed]
        before = ranges[pixels]
        position = (bits[mixed] & np.uint32(0xFFFF)) / 65536
        ranges[pixels] = np.where(before > 0, as_range(before + gap[mixed] * position), 0)


@dataclass(frozen=True)
class RangeRounding(Artifact):
    """Ranges rounded to the nearest multiple of `step_mm`, at least one of them; most depth images hold millimetres."""

    name = "range_rounding"
    kind = "noise"
    alters_labels = False

    step_mm: float = bounded(1.0, 0, 1000, above=True)

    def apply(self, image: RangeImage, scene: Scene, draws: Draws) -> None:
        steps = self.step_mm / 1000 / scene.step_m
        ranges = image.range.reshape(-1)
        with if_ready:
            compiled_forms().round_ranges(ranges, steps)
            return
        pixels = np.flatnonzero(ranges)
        ranges[pixels] = as_range(np.maximum(np.rint(ranges[pixels] / steps), 1) * steps)


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

    def apply(self, image: RangeImage, scene: Scene, draws: Draws) -> None:
        """As `Artifact.apply`. Raises BadConfig for a rig whose camera and projector are at one point."""
        scale = focal_baseline(scene.rig, self.focal_px, self.baseline_m) / self.step_px / scene.step_m
        ranges = image.range.reshape(-1)
        with if_ready:
            compiled_forms().round_disparities(ranges, scale)
            return
        pixels = np.flatnonzero(ranges)
        disparity: NDArray[np.float64] = np.rint(scale / ranges[pixels])
        ranges[pixels] = np.where(disparity > 0, as_range(scale / np.maximum(disparity, 1)), 0)


def clean_metres(scene: Scene) -> NDArray[np.float32]:
    """The clean range of each of the scene's pixels, metres, [N]."""
    steps = scene.sample.range.reshape(-1)[scene.pixels]
    return steps.astype(np.float32) * np.float32(scene.step_m)


def add_gaussian(image: RangeImage, scene: Scene, draws: Draws, purpose: str, sigma_m: NDArray[np.float32]) -> None:
    """Add Gaussian noise to the image's range in place, but for lost pixels.

    sigma_m: of each of the scene's pixels, metres, [N]. Rounds to the nearest step and stays within 1 .. 65535, as
    `noise.add_noise`.
    """
    ranges, pixels = image.range.reshape(-1), scene.pixels
    normals = drawn_normals(draws, purpose, len(pixels))
    with if_ready:
        compiled_forms().add_gaussian(ranges, pixels, normals, sigma_m, np.float32(scene.step_m))
        return
    before = ranges[pixels]
    steps = normals * (sigma_m / np.float32(scene.step_m))
    ranges[pixels] = np.where(before > 0, as_range(before.astype(np.float32) + steps), 0)


def focal_baseline(rig: Rig, focal_px: float | None, baseline_m: float | None) -> float:
    """Focal length times baseline, pixels times metres. Raises BadConfig if that is 0."""
    scale = (focal_px or rig.camera.focal_px) * (baseline_m or rig.baseline_m)
    if scale == 0:
        raise BadConfig(f"rig {rig.name} has no baseline: give the sensor's as 'baseline_m'")
    return scale
