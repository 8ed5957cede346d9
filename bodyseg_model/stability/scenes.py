"""The images of every setting: stored samples, altered; or the same bodies from the same side, drawn anew.

Scenes are drawn when they are asked for. What is kept is the bodies, labelled, and their renderers.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts.occlusion import shadow_test
from bodyseg_data.bodies.source import BodyRef
from bodyseg_data.bodies.sources import open_source
from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.parts import BACKGROUND
from bodyseg_data.core.rig import Camera, PlacedCamera, Rig, axes_at
from bodyseg_data.core.sample import Sample, steps
from bodyseg_data.core.views import View
from bodyseg_data.loading.range_images import RangeImages, metres
from bodyseg_data.meshes.mesh import Mesh
from bodyseg_data.meshes.partition.surface_parts import Partition, partition
from bodyseg_data.packing.sampler import Sampler, surface_points
from bodyseg_data.rendering import open_renderer
from bodyseg_data.rendering.renderer import Renderer
from bodyseg_model.segmentation.cameras import other_sensors
from bodyseg_model.segmentation.resampling import view_body
from bodyseg_model.stability.severities import CLEAN, SWEEPS, Setting, altered

MADE: Final = ("open", "hard")
"""Sources whose bodies can be drawn anew: they are made, not read from somebody's files."""


@dataclass(frozen=True)
class Picture:
    """What a network is shown, and the truth to compare its answer with.

    range_m: float32 [H, W], metres, 0 where nothing was measured. places: int64 [N], the pixels of it that count, row *
    W + column. truth: uint8 [N], their parts.
    """

    range_m: NDArray[np.float32]
    places: NDArray[np.intp]
    truth: NDArray[np.uint8]


def picture(image: NDArray[np.uint16], labels: NDArray[np.uint8]) -> Picture:
    """Of a range image in steps and its labels, uint8 [H, W]: all that was measured counts."""
    places = np.flatnonzero(image)
    return Picture(metres(image), places, labels.ravel()[places])


class Scenes:
    """The images of settings, of the first `count` bodies and views of a permutation that belongs to `images`' seed.

    images: clean ones of a test split. hard: the same of a set of hard poses, or None. progress: called with bodies
    built and bodies in all, which takes seconds each.
    """

    def __init__(
        self,
        images: RangeImages,
        count: int,
        hard: RangeImages | None = None,
        progress: Callable[[int, int], None] = lambda done, total: None,
    ) -> None:
        self.images, self.hard = images, hard
        self.rig, self.seed = images.manifest.rig, images.seed
        self._count, self._progress = min(count, len(images)), progress

    def __len__(self) -> int:
        return self._count

    def check(self, setting: Setting) -> None:
        """Raise BadConfig for a setting that these images cannot show."""
        source = self.images.manifest.source
        if _is_rendered(setting) and source not in MADE:
            raise BadConfig(
                f"the sweep {setting.sweep!r} draws bodies anew, which those of the sources {' and '.join(MADE)} can "
                f"be, found a set of {source!r}: leave it out with --sweeps"
            )

    def pictures(self, setting: Setting) -> list[Picture]:
        """The images of a setting, always in the same order. Raises BadConfig as `check`."""
        self.check(setting)
        if _is_rendered(setting):
            return [body.picture(self.rig, setting) for body in self._bodies]
        if setting.sweep == "hard" and self.hard is not None:
            return [picture(sample.range, sample.labels) for sample in _first(self.hard, self._count)]
        return [picture(altered(sample, setting, self.rig, self.seed), sample.labels) for sample in self._samples]

    @cached_property
    def _samples(self) -> list[Sample]:
        return _first(self.images, self._count)

    @cached_property
    def _bodies(self) -> list[_PosedBody]:
        source = open_source(self.images.manifest.source)
        known = {body.mesh: body for body in source.bodies()}
        built: dict[str, _PosedBody] = {}
        posed = []
        for sample in self._samples:
            name = sample.info.mesh
            if name not in built:
                body = source.build(known[name])
                parts = partition(body.mesh, body.landmarks)
                built[name] = _PosedBody(known[name], body.mesh, parts, open_renderer("raster", body.mesh), 0)
            posed.append(replace(built[name], azimuth_deg=sample.info.azimuth_deg))
            self._progress(len(posed), self._count)
        return posed


@dataclass(frozen=True)
class _PosedBody:
    """A labelled body and the side that it is seen from."""

    ref: BodyRef
    mesh: Mesh
    parts: Partition
    renderer: Renderer
    azimuth_deg: int

    def picture(self, rig: Rig, setting: Setting) -> Picture:
        sweep, strength = setting.sweep, setting.strength
        if sweep == "occlusion":
            return self._lit(with_baseline(rig, strength))
        if sweep in ("nearer", "farther"):
            return picture(*self._seen(rig.camera, strength))
        if sweep == "tilt":
            return picture(*self._seen(rig.camera, rig.stand_off_m, strength))
        if sweep in ("rig", "rig_made_over"):
            camera = sensor(strength)
            shown = self._seen(camera, rig.stand_off_m)
            return picture(*shown) if sweep == "rig" else made_over(*shown, camera, rig)
        return picture(*self._seen(rig.camera, rig.stand_off_m))

    def _seen(
        self, camera: Camera, distance_m: float, tilt_deg: float = 0.0
    ) -> tuple[NDArray[np.uint16], NDArray[np.uint8]]:
        """Range in steps and parts, as a camera sees them with no projector to think of."""
        placed = looking_down(camera, self.mesh.centre, self.azimuth_deg, distance_m, tilt_deg)
        seen = self.renderer.render(placed)
        rows, columns = np.nonzero(seen.face >= 0)
        labels = np.full(seen.face.shape, BACKGROUND, np.uint8)
        points = surface_points(seen, placed, rows, columns)
        labels[rows, columns] = self.parts.labels_at(self.mesh, seen.face[rows, columns], points)
        return steps(seen.range, self.ref.mesh), labels

    def _lit(self, rig: Rig) -> Picture:
        """What a rig measures: only where its projector's light gets to."""
        sampler = Sampler(self.renderer, rig, self.mesh, self.parts, "open", self.ref)
        sample = sampler.take(View(round(100 * rig.stand_off_m), self.azimuth_deg))
        lit = shadow_test(rig).lit(sample.range, sample.occluder_range(), sample.faces_projector)
        return picture(sample.range * lit, sample.labels)


def with_baseline(rig: Rig, baseline_m: float) -> Rig:
    """The rig with its projector level with the camera, on its left, and aimed at the stand-off as the paper's is."""
    aim = (0.0, 0.0, rig.stand_off_m)
    projector = replace(rig.projector, position_m=(-baseline_m, 0.0, 0.0), aims_at_m=aim)
    return replace(rig, camera=replace(rig.camera, position_m=(0.0, 0.0, 0.0), aims_at_m=aim), projector=projector)


def looking_down(
    camera: Camera, centre: NDArray[np.float64], azimuth_deg: int, distance_m: float, tilt_deg: float
) -> PlacedCamera:
    """A camera whose axis points at a body's middle from `distance_m` and `tilt_deg` above the horizontal."""
    right, down, forward = axes_at(azimuth_deg)
    tilt = math.radians(tilt_deg)
    ahead = math.cos(tilt) * forward + math.sin(tilt) * down
    axes = np.stack([right, math.cos(tilt) * down - math.sin(tilt) * forward, ahead])
    return PlacedCamera(camera, axes, centre - distance_m * ahead)


def sensor(focal_px: float) -> Camera:
    """The camera of this focal length among `cameras.other_sensors`."""
    return next(other.camera for other in other_sensors() if other.camera.focal_px == focal_px)


def made_over(image: NDArray[np.uint16], labels: NDArray[np.uint8], camera: Camera, rig: Rig) -> Picture:
    """The image as the camera that networks know would see it, as `segmenter` shows it to them."""
    pixels = np.flatnonzero(image)
    view = view_body(metres(image), pixels, camera, rig)
    return Picture(view.range_m, view.places, labels.ravel()[pixels])


def _first(images: RangeImages, count: int) -> list[Sample]:
    return [images.clean(int(place)) for place in images.order(0)[:count]]


def _is_rendered(setting: Setting) -> bool:
    if setting in CLEAN.values():
        return setting == CLEAN["rendered"]
    return SWEEPS[setting.sweep].origin == "rendered"
