"""Labelled images of every condition: corrupted stored samples, or the same bodies rendered anew from the same azimuth.

Images are made on demand. Labelled bodies and their renderers are kept.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts.occlusion import lit_pixels
from bodyseg_data.bodies.source import BodyRef
from bodyseg_data.bodies.sources import open_source
from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.parts import BACKGROUND
from bodyseg_data.core.rig import Camera, PlacedCamera, Rig, axes_at
from bodyseg_data.core.sample import Sample, steps
from bodyseg_data.core.system.progress import ProgressCallback, silent
from bodyseg_data.core.views import View
from bodyseg_data.loading.image_set import metres
from bodyseg_data.loading.range_images import RangeImages
from bodyseg_data.meshes.mesh import Mesh
from bodyseg_data.meshes.partition.surface_parts import Partition
from bodyseg_data.packing.sampler import Sampler
from bodyseg_data.packing.things import draw_things, in_front
from bodyseg_data.rendering import open_renderer
from bodyseg_data.rendering.renderer import Renderer
from bodyseg_model.recordings.cameras import other_sensors
from bodyseg_model.segmentation.views import view_body
from bodyseg_model.stability.correspondence import RenderedBody
from bodyseg_model.stability.sweeps import CLEAN, SWEEPS, Condition, corrupted

_HIDDEN_WITHIN: Final = 0.05  # of the share that things are to hide
_HIDDEN_ATTEMPTS: Final = 64

RENDERABLE: Final = ("open", "hard")
"""Sources whose bodies can be rendered anew, because they are generated and not read from files."""


@dataclass(frozen=True)
class LabelledImage:
    """Input of a network and the true labels.

    range_m: float32 [H, W], metres, 0 where nothing was measured. pixels: int64 [N], where predictions are compared,
    row * W + column. truth: uint8 [N], the part at each of `pixels`; 255 on things, which do not count.
    """

    range_m: NDArray[np.float32] = field(repr=False)
    pixels: NDArray[np.intp] = field(repr=False)
    truth: NDArray[np.uint8] = field(repr=False)


def labelled_image(image: NDArray[np.uint16], step_m: float, labels: NDArray[np.uint8]) -> LabelledImage:
    """Pair a range image in steps of `step_m` metres with its labels, uint8 [H, W]; measured pixels are compared."""
    pixels = np.flatnonzero(image)
    return LabelledImage(metres(image, step_m), pixels, labels.ravel()[pixels])


class Scenes:
    """Makes images under any condition of the first `count` samples in the permutation of `images`' seed.

    images: variant "none" of a test split. hard: the same of a set of hard poses, or None. progress: called with bodies
    built and bodies in all; building one takes seconds.
    """

    def __init__(
        self,
        images: RangeImages,
        count: int,
        hard: RangeImages | None = None,
        progress: ProgressCallback = silent,
    ) -> None:
        self.images, self.hard = images, hard
        self.rig, self.seed = images.manifest.rig, images.seed
        self._count, self._progress = min(count, len(images)), progress

    def __len__(self) -> int:
        return self._count

    def __repr__(self) -> str:
        return f"Scenes({self.images!r}, {self._count})"

    def check(self, condition: Condition) -> None:
        """Raise BadConfig for a condition whose images cannot be made from these samples."""
        source = self.images.manifest.source
        if _is_rendered(condition) and source not in RENDERABLE:
            raise BadConfig(
                f"the sweep {condition.sweep!r} renders bodies anew, which needs a set of {' or '.join(RENDERABLE)}, "
                f"found a set of {source!r}: leave it out with --sweeps"
            )

    def labelled_images(self, condition: Condition) -> list[LabelledImage]:
        """Make the images of a condition, always in the same order. Raises BadConfig as `check`."""
        self.check(condition)
        if _is_rendered(condition):
            return [body.image(self.rig, condition) for body in self._bodies]
        if condition.sweep == "hard" and self.hard is not None:
            return [
                labelled_image(sample.range, self.hard.step_m, sample.labels)
                for sample in _first(self.hard, self._count)
            ]
        return [
            labelled_image(corrupted(sample, condition, self.rig, self.seed), self.rig.range_step_m, sample.labels)
            for sample in self._samples
        ]

    @cached_property
    def _samples(self) -> list[Sample]:
        return _first(self.images, self._count)

    @cached_property
    def _bodies(self) -> list[_PosedBody]:
        source = open_source(self.images.manifest.source)
        refs = {body.mesh: body for body in source.bodies()}
        built: dict[str, _PosedBody] = {}
        posed = []
        for sample in self._samples:
            name = sample.info.mesh
            if name not in built:
                body = source.build(refs[name])
                parts = body.partition()
                built[name] = _PosedBody(refs[name], body.mesh, parts, open_renderer("raster", body.mesh), 0)
            posed.append(replace(built[name], azimuth_deg=sample.info.azimuth_deg))
            self._progress(len(posed), self._count)
        return posed


@dataclass(frozen=True)
class _PosedBody:
    """A labelled body and the azimuth that it is seen from, degrees."""

    ref: BodyRef
    mesh: Mesh
    parts: Partition
    renderer: Renderer
    azimuth_deg: int

    def image(self, rig: Rig, condition: Condition) -> LabelledImage:
        sweep, strength = condition.sweep, condition.strength
        if sweep == "occlusion":
            return self._lit(with_baseline(rig, strength))
        if sweep in ("nearer", "farther"):
            return self._rendered(rig, rig.camera, strength)
        if sweep == "tilt":
            return self._rendered(rig, rig.camera, rig.stand_off_m, strength)
        if sweep in ("rig", "rig_resampled"):
            camera = sensor(strength)
            made = self._rendered(rig, camera, rig.stand_off_m)
            return made if sweep == "rig" else resampled(made, camera, rig)
        if sweep in ("hidden", "hidden_shown"):
            return self._behind_things(rig, strength, shown=sweep == "hidden_shown")
        return self._rendered(rig, rig.camera, rig.stand_off_m)

    def _behind_things(self, rig: Rig, share: float, shown: bool) -> LabelledImage:
        """Image of a body of which things hide a share, 5 % more or less. shown: leave their ranges in the image."""
        placed = looking_down(rig.camera, self.mesh.centre, self.azimuth_deg, rig.stand_off_m, 0.0)
        rendered = RenderedBody(self.mesh, placed, self.renderer.render(placed))
        things = draw_things(
            "before",
            f"{self.ref.mesh} {self.azimuth_deg} {share:g}",
            self.mesh,
            View(round(100 * rig.stand_off_m), self.azimuth_deg),
            placed,
            rendered.surface,
            rig.range_step_m,
            (share - _HIDDEN_WITHIN, share + _HIDDEN_WITHIN),
            _HIDDEN_ATTEMPTS,
        ).render(placed)
        before, labels = in_front(things, rendered.surface), rendered.labels(self.parts)
        labels[before] = BACKGROUND
        ranges = np.where(before, things.range if shown else np.float32(0), rendered.surface.range)
        return labelled_image(steps(ranges, rig.range_step_m, self.ref.mesh), rig.range_step_m, labels)

    def _rendered(self, rig: Rig, camera: Camera, distance_m: float, tilt_deg: float = 0.0) -> LabelledImage:
        """Image of a camera in the rig's steps, without shadows of a projector."""
        placed = looking_down(camera, self.mesh.centre, self.azimuth_deg, distance_m, tilt_deg)
        rendered = RenderedBody(self.mesh, placed, self.renderer.render(placed))
        image = steps(rendered.surface.range, rig.range_step_m, self.ref.mesh)
        return labelled_image(image, rig.range_step_m, rendered.labels(self.parts))

    def _lit(self, rig: Rig) -> LabelledImage:
        """Image of a rig, with the shadows of its projector."""
        sampler = Sampler(self.renderer, rig, self.mesh, self.parts, "open", self.ref)
        sample = sampler.take(View(round(100 * rig.stand_off_m), self.azimuth_deg))
        return labelled_image(sample.range * lit_pixels(rig, sample), rig.range_step_m, sample.labels)


def with_baseline(rig: Rig, baseline_m: float) -> Rig:
    """The rig with its projector level with the camera, to its left, and aimed at the stand-off as the paper's is.

    A second projector is left out: the sweep is over the baseline of one.
    """
    aim = (0.0, 0.0, rig.stand_off_m)
    projector = replace(rig.projector, position_m=(-baseline_m, 0.0, 0.0), aims_at_m=aim)
    camera = replace(rig.camera, position_m=(0.0, 0.0, 0.0), aims_at_m=aim)
    return replace(rig, camera=camera, projector=projector, second_projector=None)


def looking_down(
    camera: Camera, centre: NDArray[np.float64], azimuth_deg: int, distance_m: float, tilt_deg: float
) -> PlacedCamera:
    """A camera whose axis points at a body's centre from `distance_m` away and `tilt_deg` above the horizontal."""
    axes = axes_at(azimuth_deg, -tilt_deg)
    return PlacedCamera(camera, axes, centre - distance_m * axes[2])


def sensor(focal_px: float) -> Camera:
    """The camera in `cameras.other_sensors` that has this focal length, pixels."""
    return next(other.camera for other in other_sensors() if other.camera.focal_px == focal_px)


def resampled(image: LabelledImage, camera: Camera, rig: Rig) -> LabelledImage:
    """The image of `camera` as the rig's camera would see the body, resampled as `Segmenter` does."""
    view = view_body(image.range_m, image.pixels, camera, rig)
    return LabelledImage(view.range_m, view.view_pixels, image.truth)


def _first(images: RangeImages, count: int) -> list[Sample]:
    return [images.clean(int(index)) for index in images.order(0)[:count]]


def _is_rendered(condition: Condition) -> bool:
    if condition in CLEAN.values():
        return condition == CLEAN["rendered"]
    return SWEEPS[condition.sweep].origin == "rendered"
