"""Corruptions of rising strength, and labelled images with them: altered stored samples, or bodies rendered anew.

A sweep changes one thing and leaves all else clean, so two predictions at different strengths differ because of it
alone. Its first strength is clean. docs/results/stability.md describes every sweep. Images are made on demand; labelled
bodies and their renderers are kept.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts import SHAPES, Artifact, MissingData, MixedPixels, Noise, PhaseShift, lit_pixels, shown_with
from bodyseg_data.bodies import Body, BodyRef, open_source
from bodyseg_data.core import BadConfig, Draws, ProgressCallback, check_choice, reported, silent
from bodyseg_data.labels import BACKGROUND, LANDMARKS
from bodyseg_data.loading import CameraImage, Remnants
from bodyseg_data.meshes import Partition
from bodyseg_data.packing import Sampler, draw_things, in_front
from bodyseg_data.rendering import Renderer, Surface, open_renderer
from bodyseg_data.rigs import Camera, PlacedCamera, Rig, axes_at, load_rig
from bodyseg_data.samples import Sample, View, box_of, metres, steps
from bodyseg_model.evaluation import TrueSurface
from bodyseg_model.recordings import other_sensors
from bodyseg_model.segmentation import view_body

if TYPE_CHECKING:  # with which PyTorch comes: `SWEEPS` is in the help of a command
    from bodyseg_data.loading import RangeImages

Origin = Literal["stored", "rendered"]

DEPTHS_M: Final = (0.5, 4.5)
"""Ends of the interval that the sweep `depth_steps` divides into equal steps, metres."""

_SHARES: Final = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)
_FOCALS_PX: Final = tuple(sorted({sensor.camera.focal_px for sensor in other_sensors()}, reverse=True))
_KNOWN_FOCAL_PX: Final = round(load_rig().camera.focal_px, 1)


@dataclass(frozen=True)
class SweepPoint:
    """One sweep at one strength; the clean condition that sweeps begin with is shared by all of one `Origin`."""

    sweep: str
    strength: float = 0.0

    @property
    def name(self) -> str:
        """Words for progress and messages, such as "noise 10"."""
        return self.sweep if self in CLEAN.values() else f"{self.sweep} {self.strength:g}"


CLEAN: Final[dict[Origin, SweepPoint]] = {"stored": SweepPoint("clean"), "rendered": SweepPoint("clean, rendered")}


@dataclass(frozen=True)
class Sweep:
    """One corruption. strengths: in rising severity; the first is clean.

    origin: "stored" if stored samples are corrupted, "rendered" if bodies are rendered anew. counts: in mCE and mRR.
    """

    title: str
    axis: str
    strengths: tuple[float, ...]
    origin: Origin = "stored"
    counts: bool = True

    def conditions(self, name: str) -> list[SweepPoint]:
        """The conditions of the sweep, which has this name in `SWEEPS`: one for each strength."""
        return [CLEAN[self.origin], *(SweepPoint(name, strength) for strength in self.strengths[1:])]


SWEEPS: Final = {
    "noise": Sweep("Noise", "sigma, mm", (0, 10, 20, 40, 60, 80, 100)),
    "missing": Sweep("Pixels missing at random", "share of the body", (0.0, 0.1, 0.3, 0.5, 0.7, 0.9)),
    "patches": Sweep("Patches missing (dark cloth)", "share of the body", _SHARES),
    "stripes": Sweep("Stripes missing (motion)", "share of the body", _SHARES),
    "depth_steps": Sweep(f"Coarse depth, {DEPTHS_M[0]:g} to {DEPTHS_M[1]:g} m", "bits", (16, 12, 11, 10, 9, 8)),
    "crop_below": Sweep("Cut off from below", "share of the height", _SHARES),
    "crop_above": Sweep("Cut off from above", "share of the height", _SHARES),
    "crop_side": Sweep("Cut off from the left", "share of the width", _SHARES),
    "occlusion": Sweep("Projector shadow", "baseline, m", (0.0, 0.25, 0.5, 0.75, 1.0, 1.5), "rendered"),
    "nearer": Sweep("Nearer", "distance, m", (2.5, 2.25, 2.0, 1.75, 1.5), "rendered"),
    "farther": Sweep("Farther", "distance, m", (2.5, 3.0, 3.5, 4.0), "rendered"),
    "tilt": Sweep("Camera looks down", "degrees", (0, 5, 10, 15, 20, 30), "rendered"),
    "rig": Sweep("Other cameras, as they are", "focal length, px", (_KNOWN_FOCAL_PX, *_FOCALS_PX), "rendered"),
    "rig_resampled": Sweep(
        "Other cameras, resampled", "focal length, px", (_KNOWN_FOCAL_PX, *_FOCALS_PX), "rendered", counts=False
    ),
    "hidden": Sweep("Hidden by things", "share of the body", _SHARES, "rendered", counts=False),
    "hidden_shown": Sweep(
        "Hidden by things, which are in the image", "share of the body", _SHARES, "rendered", counts=False
    ),
    "hard": Sweep("Hard poses", "0: the set's, 1: hard", (0, 1), counts=False),
    "turned": Sweep("Frame turned clockwise", "degrees", (0, 90, 180, 270), counts=False),
    "desk": Sweep(
        "At a desk, 1 m away", "0: the set's, 1: from the chest up, 2: shoulders up", (0, 1, 2), "rendered", False
    ),
    "kick": Sweep("A kick towards the camera", "0: the set's, 1: a kick", (0, 1), "rendered", counts=False),
    "fist": Sweep("A fist above the head", "0: the set's, 1: a fist", (0, 1), "rendered", counts=False),
    "mixed": Sweep("Mixed pixels before a wall", "share of edges", (0.0, 0.1, 0.25, 0.5, 1.0), counts=False),
    "remnants": Sweep("Remnants of a wall beside the body", "width, m", (0.0, 0.05, 0.1, 0.2, 0.4), counts=False),
    "speed": Sweep("Moving limbs, shifted fringes", "hands and feet, m/s", (0.0, 0.5, 1.0, 2.0, 4.0), counts=False),
    "clothes": Sweep("Dark clothes, shifted fringes", "reflectance", (0.8, 0.2, 0.1, 0.05, 0.03, 0.02), counts=False),
    "ambient": Sweep("Other light, shifted fringes", "share of the projector's", (0.0, 1.0, 4.0, 16.0), counts=False),
}
"""Name -> sweep. Those do not count that are a remedy, no fault of a sensor, or causes of what others count."""

_POSED: Final = ("desk", "kick", "fist")
"""The sweeps whose people are in the pose of that name (`MadeBodies.in_pose`), seen from the front."""

_DESK_M: Final = 1.0
_BORDERS: Final = {1: "Substernale", 2: "Rt. Axilla, Post."}
_AHEAD_DEG: Final = 85, 3  # middle, and divisor: 18 azimuths over half a circle become 18 from -29 to 28 degrees


def chosen(names: tuple[str, ...], hard: bool) -> dict[str, Sweep]:
    """The sweeps of the given names, or all if none is given. hard: True if a set of hard poses is given.

    Raises BadConfig for an unknown name, "hard" without such a set, or a set without "hard".
    """
    for name in names:
        check_choice("a sweep", name, SWEEPS)
    if "hard" in names and not hard:
        raise BadConfig("the sweep 'hard' needs a set of hard poses: give --hard")
    if hard and names and "hard" not in names:
        raise BadConfig(f"--hard is the set of the sweep 'hard', which is not among {', '.join(names)}")
    return {name: sweep for name, sweep in SWEEPS.items() if name in names or (not names and (hard or name != "hard"))}


def of_rig(sweeps: Mapping[str, Sweep], rig: Rig) -> dict[str, Sweep]:
    """Sweeps with strengths of a rig: distances in proportion to its stand-off; its own focal length, then others."""
    near, focal_px = rig.stand_off_m / load_rig().stand_off_m, round(rig.camera.focal_px, 1)
    others = sorted({*_FOCALS_PX} - {focal_px}, key=lambda each: max(each / focal_px, focal_px / each))
    own = {name: tuple(round(near * each, 4) for each in SWEEPS[name].strengths) for name in ("nearer", "farther")}
    own |= dict.fromkeys(("rig", "rig_resampled"), (focal_px, *others))
    return {name: replace(sweep, strengths=own.get(name, sweep.strengths)) for name, sweep in sweeps.items()}


def corrupted(sample: Sample, condition: SweepPoint, rig: Rig, seed: int) -> NDArray[np.uint16]:
    """The range image of a stored sample under a condition of a "stored" sweep, uint16 [H, W], in the rig's steps.

    Pixels that the corruption removes are 0; those that it adds have no label. Draws depend on seed and sample alone,
    so a greater strength removes the pixels of a smaller one, and more. An unchanged image is not copied.
    """
    if condition == CLEAN["stored"]:
        return sample.range
    if condition.sweep in _ARTIFACTS:
        return shown_with(_ARTIFACTS[condition.sweep](condition.strength, rig), sample, rig, seed).range
    if condition.sweep in SHAPES:
        draws = Draws(seed, 0, sample.key).generator(condition.sweep)
        return sample.range * ~SHAPES[condition.sweep](sample.range, condition.strength, draws)
    if condition.sweep == "depth_steps":
        return _depth_steps(sample, condition.strength, rig.range_step_m)
    if condition.sweep == "remnants":
        return _with_remnants(sample, condition.strength, rig, seed)
    return _CROPS[condition.sweep](sample, condition.strength)


def _with_remnants(sample: Sample, widest_m: float, rig: Rig, seed: int) -> NDArray[np.uint16]:
    """Ranges with remnants of a wall, up to so wide, beside the body."""
    pinhole = rig.range_step_m, rig.camera.focal_px, rig.camera.centre_px
    image = CameraImage(sample.key, sample.range.copy(), sample.labels, {}, *pinhole, sample)
    return Remnants(1.0, widest_m=widest_m)(image, Draws(seed, 0, sample.key).generator("remnants")).range


def _depth_steps(sample: Sample, bits: float, step_m: float) -> NDArray[np.uint16]:
    """Ranges rounded to one of 2**bits depths, the first and last at the ends of `DEPTHS_M`."""
    low, high = (depth / step_m for depth in DEPTHS_M)
    last = 2.0**bits - 1
    step = (high - low) / last
    depths = low + step * np.clip(np.rint((sample.range - low) / step), 0, last)
    return np.where(sample.range > 0, np.rint(depths), 0).astype(np.uint16)


def _crop(image: NDArray[np.uint16], share: float, from_end: bool = False) -> NDArray[np.uint16]:
    """Remove a share of the rows that the body covers, from the top or the bottom of the body."""
    rows, _ = box_of(image) or np.s_[0:0, 0:0]
    removed = round(share * (rows.stop - rows.start))
    cropped = image.copy()
    cropped[slice(rows.stop - removed, None) if from_end else slice(rows.start + removed)] = 0
    return cropped


_WALL_M: Final = 1.5  # behind the rig's stand-off
_REFLECTANCE: Final = 0.5  # reflectance of clothes that are not dark


def _fringes(speed_m_s: float = 0.0, reflectance: float = _REFLECTANCE, ambient: float = 0.0) -> PhaseShift:
    """The paper's sensor with one speed, one reflectance of clothes and one ambient light in every image."""
    return PhaseShift(
        dimmest=ambient, brightest=ambient, slowest_m_s=speed_m_s, fastest_m_s=speed_m_s,
        darkest=reflectance, lightest=reflectance, patterned=0.0,
    )  # fmt: skip


_ARTIFACTS: Final[dict[str, Callable[[float, Rig], Artifact]]] = {
    "noise": lambda sigma_mm, _: Noise(sigma_mm, sigma_mm),
    "missing": lambda share, _: MissingData((share,)),
    "mixed": lambda share, rig: MixedPixels(share, rig.stand_off_m + _WALL_M),
    "speed": lambda speed_m_s, _: _fringes(speed_m_s),
    "clothes": lambda reflectance, _: _fringes(reflectance=reflectance),
    "ambient": lambda share, _: _fringes(ambient=share),
}
"""The sweeps of one artifact: name -> the artifact at a strength."""

_CROPS: Final[dict[str, Callable[[Sample, float], NDArray[np.uint16]]]] = {
    "crop_below": lambda sample, share: _crop(sample.range, share, from_end=True),
    "crop_above": lambda sample, share: _crop(sample.range, share),
    "crop_side": lambda sample, share: np.ascontiguousarray(_crop(sample.range.T, share).T),
}


_HIDDEN_WITHIN: Final = 0.05  # largest difference from the share that things are to hide
_HIDDEN_ATTEMPTS: Final = 64

RENDERABLE: Final = ("open", "hard")
"""Sources whose bodies can be rendered anew, because they are generated and not read from files."""


@dataclass(frozen=True)
class LabelledImage:
    """Input of a network and the true labels.

    range_m: float32 [H, W], metres, 0 where nothing was measured. pixels: int64 [N], where predictions are compared,
    row * W + column. truth: uint8 [N], the part at each of `pixels`; 255 on things, which do not count. surface: what
    is truly there; places: int64 [N], the pixels of its image that see what `pixels` see.
    """

    range_m: NDArray[np.float32] = field(repr=False)
    pixels: NDArray[np.intp] = field(repr=False)
    truth: NDArray[np.uint8] = field(repr=False)
    surface: TrueSurface = field(repr=False)
    places: NDArray[np.intp] = field(repr=False)


def labelled_image(
    image: NDArray[np.uint16], step_m: float, surface: TrueSurface, labels: NDArray[np.uint8] | None = None
) -> LabelledImage:
    """Pair a range image in steps of `step_m` metres with its pixels' labels, uint8 [H, W], or the surface's."""
    pixels, known = np.flatnonzero(image), surface.labels if labels is None else labels
    return LabelledImage(metres(image, step_m), pixels, known.ravel()[pixels], surface, pixels)


class Scenes:
    """Makes images under any condition of the first `count` samples in the permutation of `images`' seed.

    images: variant "none" of a test split. hard: the same of a set of hard poses, or None. progress: called with bodies
    built and bodies in all; building one takes seconds.
    """

    def __init__(
        self, images: RangeImages, count: int, hard: RangeImages | None = None, progress: ProgressCallback = silent
    ) -> None:
        self.images, self.hard = images, hard
        self.rig, self.seed = images.manifest.rig, images.seed
        self._count, self._progress = min(count, len(images)), progress
        self._posed: dict[str, list[_PosedBody]] = {}

    def __len__(self) -> int:
        return self._count

    def check(self, condition: SweepPoint) -> None:
        """Raise BadConfig for a condition whose images cannot be made from these samples."""
        source = self.images.manifest.source
        if _is_rendered(condition) and source not in RENDERABLE:
            others = ", ".join(name for name, sweep in SWEEPS.items() if sweep.origin == "stored")
            raise BadConfig(
                f"sweeps that render bodies anew need a set of {' or '.join(RENDERABLE)}, found a set of {source!r}: "
                f"choose others with --sweeps, of {others}"
            )
        artifact = _ARTIFACTS.get(condition.sweep, lambda *_: None)(condition.strength, self.rig)
        with reported(f"the sweep {condition.sweep!r} is to be left out with --sweeps", BadConfig):
            if isinstance(artifact, PhaseShift):
                artifact.optics(self.rig, 0.0)
            if condition.sweep == "farther":
                self.rig.check_reach(condition.strength)
            (low, high), away = DEPTHS_M, self.rig.stand_off_m
            if condition.sweep == "depth_steps" and not low < away < high:  # all of a body would be at one end
                raise BadConfig(f"its depths of {low:g} to {high:g} m must hold the rig's stand-off, found {away:g} m")

    def labelled_images(self, condition: SweepPoint) -> list[LabelledImage]:
        """Make the images of a condition, always in the same order. Raises BadConfig as `check`."""
        self.check(condition)
        if _is_rendered(condition):
            return [body.image(self.rig, condition) for body in self._bodies(condition.sweep)]
        if condition.sweep == "hard" and self.hard is not None:
            return [
                labelled_image(sample.range, self.hard.step_m, _surface(sample, self.hard.manifest.rig_of(sample)))
                for sample in _first(self.hard, self._count)
            ]
        step_m, rig_of = self.rig.range_step_m, self.images.manifest.rig_of
        if condition.sweep == "turned":
            return [turned(image, condition.strength) for image in self.labelled_images(CLEAN["stored"])]
        return [
            labelled_image(corrupted(sample, condition, rig, self.seed), step_m, _surface(sample, rig))
            for sample, rig in zip(self._samples, map(rig_of, self._samples), strict=True)
        ]

    @cached_property
    def _samples(self) -> list[Sample]:
        return _first(self.images, self._count)

    def _bodies(self, sweep: str) -> list[_PosedBody]:
        """The samples' bodies; for a sweep of `_POSED` the same people in its pose, each built once."""
        kept = sweep if sweep in _POSED else ""
        if kept in self._posed:
            return self._posed[kept]
        source: Any = open_source(self.images.manifest.source)
        refs = {body.mesh: body for body in source.bodies()}
        built: dict[str, _PosedBody] = {}
        posed = self._posed[kept] = []
        for sample in self._samples:
            ref, azimuth = refs[sample.info.mesh], sample.info.azimuth_deg
            name = ref.subject if kept else ref.mesh
            if name not in built:
                body: Body = source.in_pose(ref, sweep) if kept else source.build(ref)
                parts = body.partition("unfolded" if kept else "exact")
                built[name] = _PosedBody(ref, body, parts, open_renderer("raster", body.mesh), 0)
            ahead = (azimuth - _AHEAD_DEG[0]) // _AHEAD_DEG[1]
            posed.append(replace(built[name], azimuth_deg=ahead if kept else azimuth))
            self._progress(len(posed), self._count)
        return posed


@dataclass(frozen=True)
class _PosedBody:
    """A labelled body and the azimuth that it is seen from, degrees."""

    ref: BodyRef
    body: Body
    parts: Partition
    renderer: Renderer
    azimuth_deg: int

    def image(self, rig: Rig, condition: SweepPoint) -> LabelledImage:
        sweep, strength = condition.sweep, condition.strength
        if sweep == "occlusion":
            return self._lit(with_baseline(rig, strength))
        if sweep in ("nearer", "farther"):
            return self._rendered(rig, rig.camera, strength)
        if sweep == "tilt":
            return self._rendered(rig, rig.camera, rig.stand_off_m, strength)
        if sweep in ("rig", "rig_resampled"):
            camera = mounted(sensor(strength), rig)
            made = self._rendered(rig, camera, rig.stand_off_m)
            return made if sweep == "rig" else resampled(made, camera, rig)
        if sweep == "desk":
            return self._at_desk(rig, _BORDERS[int(strength)])
        if sweep in ("hidden", "hidden_shown"):
            return self._behind_things(rig, strength, shown=sweep == "hidden_shown")
        return self._rendered(rig, rig.camera, rig.stand_off_m)

    def _behind_things(self, rig: Rig, share: float, shown: bool) -> LabelledImage:
        """Image of a body of which things hide a share, within 5 %. shown: leave the things' ranges in the image."""
        placed = looking_down(rig.camera, self.body.mesh.centre, self.azimuth_deg, rig.stand_off_m, 0.0)
        seen = self.renderer.render(placed)
        things = draw_things(
            "before",
            f"{self.ref.mesh} {self.azimuth_deg} {share:g}",
            self.body.mesh,
            View(round(100 * rig.stand_off_m), self.azimuth_deg),
            placed,
            seen,
            rig.range_step_m,
            (share - _HIDDEN_WITHIN, share + _HIDDEN_WITHIN),
            _HIDDEN_ATTEMPTS,
        ).render(placed)
        before, surface = in_front(things, seen), TrueSurface(seen.range, self._labels(seen, placed), placed.camera)
        labels = np.where(before, np.uint8(BACKGROUND), surface.labels)
        ranges = np.where(before, things.range if shown else np.float32(0), seen.range)
        return labelled_image(steps(ranges, rig.range_step_m, self.ref.mesh), rig.range_step_m, surface, labels)

    def _at_desk(self, rig: Rig, landmark: str) -> LabelledImage:
        """Image of the other camera of the longest focal length, level and near, resampled, that ends at a landmark."""
        camera = sensor(_FOCALS_PX[0])
        border = self.body.mesh.vertices[self.body.landmarks[LANDMARKS.index(landmark)]]
        above = _DESK_M * (camera.rows - camera.centre_px[1]) / camera.focal_px
        placed = looking_down(mounted(camera, rig), np.add(border, (0, above, 0)), self.azimuth_deg, _DESK_M, 0.0)
        return resampled(self._seen_by(placed, rig), placed.camera, rig)

    def _rendered(self, rig: Rig, camera: Camera, distance_m: float, tilt_deg: float = 0.0) -> LabelledImage:
        """Image of a camera in the rig's steps, without shadows of a projector."""
        placed = looking_down(camera, self.body.mesh.centre, self.azimuth_deg, distance_m, tilt_deg)
        return self._seen_by(placed, rig)

    def _seen_by(self, placed: PlacedCamera, rig: Rig) -> LabelledImage:
        seen = self.renderer.render(placed)
        image = steps(seen.range, rig.range_step_m, self.ref.mesh)
        surface = TrueSurface(seen.range, self._labels(seen, placed), placed.camera)
        return labelled_image(image, rig.range_step_m, surface)

    def _labels(self, seen: Surface, camera: PlacedCamera) -> NDArray[np.uint8]:
        """Label image of what a camera sees of the body, uint8 [H, W], BACKGROUND beside it."""
        labels, (rows, columns) = np.full(seen.face.shape, BACKGROUND, np.uint8), np.nonzero(seen.face >= 0)
        points = camera.points(seen.range, rows, columns)
        labels[rows, columns] = self.parts.labels_at(self.body.mesh, seen.face[rows, columns], points)
        return labels

    def _lit(self, rig: Rig) -> LabelledImage:
        """Image of a rig, with the shadows of its projector."""
        sampler = Sampler(self.renderer, rig, self.body.mesh, self.parts, "open", self.ref)
        sample = sampler.take(View(round(100 * rig.stand_off_m), self.azimuth_deg))
        return labelled_image(sample.range * lit_pixels(rig, sample), rig.range_step_m, _surface(sample, rig))


def with_baseline(rig: Rig, baseline_m: float) -> Rig:
    """The rig with its projector level with the camera, to its left, and aimed at the stand-off as the paper's is.

    A second projector is left out: the sweep is over the baseline of one.
    """
    ahead: dict[str, Any] = {"aims_at_m": (0.0, 0.0, rig.stand_off_m), "up": Camera.up}
    projector = replace(rig.projector, position_m=(-baseline_m, 0.0, 0.0), **ahead)
    camera = replace(rig.camera, position_m=(0.0, 0.0, 0.0), **ahead)
    return replace(rig, camera=camera, projector=projector, second_projector=None)


def looking_down(
    camera: Camera, centre: NDArray[np.float64], azimuth_deg: int, distance_m: float, tilt_deg: float
) -> PlacedCamera:
    """A camera, with its roll, whose axis points at a body's centre from `distance_m` away and `tilt_deg` above."""
    axes = axes_at(azimuth_deg, -tilt_deg, camera.roll_deg)
    return PlacedCamera(camera, axes, centre - distance_m * axes[2])


def sensor(focal_px: float) -> Camera:
    """The camera in `cameras.other_sensors` that has this focal length, pixels."""
    return next(other.camera for other in other_sensors() if other.camera.focal_px == focal_px)


def mounted(camera: Camera, rig: Rig) -> Camera:
    """The upright camera of another sensor, turned as the rig's camera is, to the nearest right angle."""
    return camera.turned(-round(rig.camera.roll_deg / 90))


def resampled(image: LabelledImage, camera: Camera, rig: Rig) -> LabelledImage:
    """The image of `camera` as the rig's camera would see the body, resampled as `Segmenter` does."""
    view = view_body(image.range_m, image.pixels, camera, rig)
    return replace(image, range_m=view.range_m, pixels=view.view_pixels)


def turned(image: LabelledImage, degrees: float) -> LabelledImage:
    """The image of a camera turned anticlockwise by quarters: its content is turned clockwise."""
    quarters = -round(degrees / 90)
    range_m = np.ascontiguousarray(np.rot90(image.range_m, quarters))
    places = np.rot90(np.arange(image.range_m.size).reshape(image.range_m.shape), quarters).ravel()
    pixels = np.flatnonzero(range_m)
    at = places[pixels]
    return LabelledImage(range_m, pixels, image.surface.labels.ravel()[at], image.surface, at)


def _first(images: RangeImages, count: int) -> list[Sample]:
    return [images.clean(int(index)) for index in images.order(0)[:count]]


def _surface(sample: Sample, rig: Rig) -> TrueSurface:
    return TrueSurface(metres(sample.range, rig.range_step_m), sample.labels, rig.camera)


def _is_rendered(condition: SweepPoint) -> bool:
    if condition in CLEAN.values():
        return condition == CLEAN["rendered"]
    return SWEEPS[condition.sweep].origin == "rendered"
