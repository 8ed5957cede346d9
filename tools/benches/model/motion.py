"""`bench motion`: consistency of labels while a body moves, with new artifacts in every frame: the scores TC and VC.

TC is the mIoU of a prediction and the next one warped onto it (Liu et al., "Efficient semantic video segmentation with
per-frame inference", 2020); VC is the share of points whose label stays the same through a window of frames (Miao et
al., "VSPW: a large-scale dataset for video scene parsing in the wild", 2021). These authors follow points by optical
flow, or compare pixels without following them; here points of the skin are followed exactly, by the meshes: bodies of
one subject share their triangles, so a point of the surface is a triangle and barycentric weights in it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from benches.charts.stability_tables import FORMAT
from benches.measuring import counter
from bodyseg_data.artifacts import Augmentation, RangeImage, VariantName
from bodyseg_data.bodies import FRAMES_PER_SECOND, Body, BodyRef, BodySource, open_source
from bodyseg_data.core import BadConfig, ProgressCallback, silent
from bodyseg_data.labels import BACKGROUND
from bodyseg_data.loading import RangeImages
from bodyseg_data.machine import torch_threads
from bodyseg_data.meshes import Mesh, Partition
from bodyseg_data.packing.sampler import faces_towards, sample_key
from bodyseg_data.rendering import Surface, open_renderer
from bodyseg_data.rigs import PlacedCamera, Rig, load_rig
from bodyseg_data.samples import Sample, SampleInfo, View, metres, steps
from bodyseg_model.evaluation import ConfusionMatrix, over_seeds
from bodyseg_model.networks import Network, device_of, predict
from bodyseg_model.segmentation import CarriedLabels
from bodyseg_model.stability import Group, group, load_runs

NEAR_M: Final = 0.005
"""A point counts as seen by the pixel it projects into if the surface at the pixel's centre is at most this far from
it, metres. A pixel is about 3.4 mm wide at 2.55 m."""

NOT_SEEN: Final = -1


@dataclass(frozen=True)
class RenderedBody:
    """A body in front of a camera, and its rendered surface."""

    mesh: Mesh
    camera: PlacedCamera
    surface: Surface

    @cached_property
    def pixels(self) -> NDArray[np.intp]:
        """The pixels that see the body, int [N], row * columns + column, ascending."""
        return np.flatnonzero(self.surface.face >= 0)

    @cached_property
    def faces(self) -> NDArray[np.int32]:
        """The triangle that each of `pixels` sees, int32 [N]."""
        return self.surface.face.take(self.pixels)

    @cached_property
    def points(self) -> NDArray[np.float64]:
        """The surface points at the centres of `pixels`, [N, 3], metres, body frame."""
        return self.camera.points(self.surface.range, *np.divmod(self.pixels, self.surface.face.shape[1]))

    def labels(self, parts: Partition) -> NDArray[np.uint8]:
        """Label image of the body, uint8 [H, W], BACKGROUND where the camera does not see it."""
        labels = np.full(self.surface.face.shape, BACKGROUND, np.uint8)
        labels.ravel()[self.pixels] = parts.labels_at(self.mesh, self.faces, self.points)
        return labels


def follow(first: RenderedBody, later: RenderedBody) -> NDArray[np.intp]:
    """For each of `first.pixels` the pixel of `later` that sees the same point of the skin, int [N], or NOT_SEEN.

    A point projects into one pixel of `later`. It is seen there if it lies in the frame, its triangle faces the camera,
    and the pixel sees the same triangle, one that shares a corner with it, or a point within `NEAR_M`. Triangles are
    compared because at a grazing angle one pixel spans more than `NEAR_M`.

    Raises BadConfig for bodies that do not share their triangles.
    """
    if not np.array_equal(first.mesh.faces, later.mesh.faces):
        raise BadConfig(
            f"only bodies that share their triangles can be followed, found {first.mesh.name} and {later.mesh.name}"
        )
    weights = first.mesh.barycentric(first.faces, first.points)
    points = np.einsum("nc,ncx->nx", weights, later.mesh.vertices[later.mesh.faces[first.faces]])
    image, range_m = later.camera.project(points)
    rows, columns = later.surface.face.shape
    inside = (range_m > 0) & (image >= 0).all(axis=1) & (image < (columns, rows)).all(axis=1)
    inside &= faces_towards(later.mesh, first.faces, points, later.camera.position)
    found = np.full(len(points), NOT_SEEN, np.intp)
    index_of = np.full(rows * columns, NOT_SEEN, np.intp)  # of a pixel in later.pixels
    index_of[later.pixels] = np.arange(len(later.pixels))
    candidates = np.flatnonzero(inside)
    column, row = image[candidates].astype(np.intp).T
    index = index_of[row * columns + column]
    candidates, index = candidates[index >= 0], index[index >= 0]
    near = np.linalg.norm(later.points[index] - points[candidates], axis=1) <= NEAR_M
    near |= _touch(later.mesh, first.faces[candidates], later.faces[index])
    found[candidates[near]] = later.pixels[index[near]]
    return found


def _touch(mesh: Mesh, one: NDArray[np.int32], other: NDArray[np.int32]) -> NDArray[np.bool_]:
    """True for pairs of triangles that share a corner, bool [N]; equal triangles do."""
    touch: NDArray[np.bool_] = (mesh.faces[one][:, :, None] == mesh.faces[other][:, None, :]).any(axis=(1, 2))
    return touch


DISTANCE_CM: Final = 255
AZIMUTHS_DEG: Final = (0, 50, 90, 140)
"""Camera azimuths that shots take in turn, degrees: front, both three-quarter views, side."""


@dataclass(frozen=True)
class Shot:
    """Consecutive bodies of one motion, and the view that the camera has of them."""

    bodies: tuple[BodyRef, ...]
    view: View


@dataclass(frozen=True)
class ShotFrame:
    """One frame of a shot: a sample as it would be stored, and the rendered body in it."""

    sample: Sample = field(repr=False)
    body: RenderedBody


def choose_shots(source: BodySource, count: int, frames: int) -> list[Shot]:
    """Choose `count` shots of `frames` bodies each from the motions of a source's test split, taken in turn.

    A motion is all bodies of one subject and pose, in the source's order; its shots start at even intervals along it.
    Raises BadConfig if no motion has that many bodies.
    """
    motions: dict[tuple[str, str], list[BodyRef]] = {}
    for body in source.bodies():
        if body.split == "test":
            motions.setdefault((body.subject, body.pose), []).append(body)
    long = [motion for motion in motions.values() if len(motion) >= frames]
    if not long:
        longest = max(map(len, motions.values()), default=0)
        raise BadConfig(
            f"the source {source.name!r} needs a motion of {frames} frames to test on, found at most {longest}"
        )
    shots = []
    for number in range(count):
        motion, turn = long[number % len(long)], number // len(long)
        shares = len(range(number % len(long), count, len(long)))
        start = (2 * turn + 1) * (len(motion) - frames + 1) // (2 * shares)
        view = View(DISTANCE_CM, AZIMUTHS_DEG[number % len(AZIMUTHS_DEG)])
        shots.append(Shot(tuple(motion[start : start + frames]), view))
    return shots


def render_shot(source: BodySource, shot: Shot, rig: Rig) -> Iterator[ShotFrame]:
    """Render the frames of a shot. The camera looks at the mean of the bodies' centres throughout.

    Raises as `BodySource.build`, `partition` and `steps`.
    """
    built = [source.build(body) for body in shot.bodies]
    centre = np.mean([body.mesh.centre for body in built], axis=0)
    camera, _ = rig.placed(centre, shot.view)
    projectors = [single.placed(centre, shot.view)[1] for single in rig.by_projector()]
    for ref, body in zip(shot.bodies, built, strict=True):
        key = sample_key(source.name, ref, shot.view)
        yield _frame(ref, body, shot.view, key, camera, projectors, source.name, rig.range_step_m)


def _frame(
    ref: BodyRef,
    body: Body,
    view: View,
    key: str,
    camera: PlacedCamera,
    projectors: Sequence[PlacedCamera],
    source: str,
    step_m: float,
) -> ShotFrame:
    """Make a sample as `Sampler.take` does, but with camera and projectors given and all that the projector sees."""
    renderer = open_renderer("raster", body.mesh)
    rendered = RenderedBody(body.mesh, camera, renderer.render(camera))
    lit = [renderer.render(projector).range for projector in projectors]
    renderer.close()
    labels = rendered.labels(body.partition())
    facing = []
    for projector in projectors:
        facing.append(np.zeros(labels.shape, np.bool_))
        towards = faces_towards(body.mesh, rendered.faces, rendered.points, projector.position)
        facing[-1].ravel()[rendered.pixels] = towards
    described = {"source": source, "subset": ref.subset, "subject": ref.subject, "mesh": ref.mesh, "pose": ref.pose}
    info = SampleInfo(ref.split, {**described, **asdict(view), "things": "", "hidden_pct": 0})
    camera_range, projector_range = (steps(seen, step_m, key) for seen in (rendered.surface.range, np.concatenate(lit)))
    second = facing[1] if len(facing) == 2 else None
    sample = Sample(key, camera_range, projector_range, labels, facing[0], info, faces_second=second)
    return ShotFrame(sample, rendered)


SHOTS: Final = 4
FRAMES: Final = 16
WINDOW: Final = 8
WITH_AND_WITHOUT: Final[tuple[VariantName, ...]] = ("all", "none")
"""Variants by default: new artifacts in every frame, and none for comparison."""

CARRIED: Final = ", carried"
"""What follows a variant's name where labels of earlier frames are carried along."""

Labels = NDArray[np.uint8]


@dataclass(frozen=True)
class Tracks:
    """Pixels, as flat indices, in which points of the skin are seen in successive frames.

    pairs: for every frame but the last, int [2, P], pixels in this frame and in the next. windows: for every frame that
    starts a window, int [window, P], points seen in all frames of the window.
    """

    pairs: list[NDArray[np.intp]]
    windows: list[NDArray[np.intp]]

    def measured(self, images: NDArray[np.bool_]) -> Tracks:
        """Keep the points whose pixel was measured in all their frames. images: bool [frames, H, W]."""
        flat = images.reshape(len(images), -1)
        pairs, windows = (
            [pixels[:, _along(flat, start, pixels).all(axis=0)] for start, pixels in enumerate(tracks)]
            for tracks in (self.pairs, self.windows)
        )
        return Tracks(pairs, windows)

    def points(self) -> int:
        """Number of points seen throughout a window, summed over windows."""
        return sum(pixels.shape[1] for pixels in self.windows)


def find_tracks(bodies: Sequence[RenderedBody], window: int) -> Tracks:
    """Follow the points that each frame sees through the window that starts there. Raises BadConfig as `follow`.

    Every frame of a window is compared with its first directly, so that errors do not add up.
    """
    tracks = Tracks([], [])
    for start, first in enumerate(bodies[:-1]):
        whole = start + window <= len(bodies)
        later = bodies[start + 1 : start + window] if whole else bodies[start + 1 : start + 2]
        found = np.stack([first.pixels, *(follow(first, body) for body in later)])
        tracks.pairs.append(found[:2, found[1] != NOT_SEEN])
        if whole:
            tracks.windows.append(found[:, (found != NOT_SEEN).all(axis=0)])
    return tracks


class TemporalConsistency:
    """Counts over shots. agreement: predictions against the next frame's; truth: predictions against the true labels.

    points: int64 [2, 3], of points in windows. Columns: all, those whose label is constant, those whose label is
    constant and right. Rows: all points, points whose true label is constant.
    """

    def __init__(self) -> None:
        self.agreement, self.truth = ConfusionMatrix(), ConfusionMatrix()
        self.points: NDArray[np.int64] = np.zeros((2, 3), np.int64)

    def add(self, predicted: Labels, truth: Labels, tracks: Tracks) -> None:
        """Count one shot. predicted, truth: label images, uint8 [frames, H, W]; pixels whose truth is 255 do not count.

        Every pixel of `tracks` must have labels.
        """
        self.truth.add(truth, predicted)
        flat, true = predicted.reshape(len(predicted), -1), truth.reshape(len(truth), -1)
        for start, pixels in enumerate(tracks.pairs):
            self.agreement.add(*_along(flat, start, pixels))
        for start, pixels in enumerate(tracks.windows):
            labels, expected = _along(flat, start, pixels), _along(true, start, pixels)
            constant, truth_stays = (labels == labels[0]).all(axis=0), (expected == expected[0]).all(axis=0)
            columns = np.stack([np.ones_like(constant), constant, constant & (labels == expected).all(axis=0)])
            self.points += [columns.sum(axis=1), (columns & truth_stays).sum(axis=1)]

    def to_json(self) -> dict[str, Any]:
        """Scores; a share of nothing is null."""
        (every, constant, right), (stays, stays_constant, stays_right) = self.points.tolist()
        return {
            "tc": _share(self.agreement.mean_iou()),
            "vc": _share(constant, every),
            "vc_right": _share(right, every),
            "vc_where_truth_stays": _share(stays_constant, stays),
            "vc_right_where_truth_stays": _share(stays_right, stays),
            "accuracy": _share(self.truth.average_per_class_accuracy()),
            "pixel_accuracy": _share(self.truth.pixel_accuracy()),
        }


def _along(flat: NDArray[Any], start: int, pixels: NDArray[np.intp]) -> NDArray[Any]:
    """Values of flat images [frames, H * W] at pixels [n, P] of the frames from `start` on, [n, P]."""
    return np.stack([image.take(row) for image, row in zip(flat[start:], pixels, strict=False)])


def bench_motion(data: str, runs: Sequence[Path], progress: ProgressCallback = silent) -> dict[str, Any]:
    """Measure `temporal` for networks of the set `data`, whose rig films the bodies, and its means over their seeds.

    runs: folders of trainings, or .safetensors files; seeds of one training make a group. Computes on one thread of the
    processor. Raises BadConfig as `load_runs` and `temporal`, and as `RangeImages`.
    """
    trained = load_runs(runs)
    rig = RangeImages(data, "none", "test").manifest.rig
    with torch_threads(1):
        found = temporal({each.name: each.trained.network for each in trained}, rig=rig, progress=progress)
    return {"format": FORMAT, "temporal": found | {"groups": motion_over_seeds(group(trained), found["networks"])}}


def motion_over_seeds(groups: Sequence[Group], networks: Mapping[str, Mapping[str, dict[str, Any]]]) -> dict[str, Any]:
    """Scores of `temporal` over the seeds of each group: group -> variant -> score; None if a network lacks it.

    networks: run's name -> variant -> score -> number.
    """
    found: dict[str, Any] = {}
    for each in groups:
        rows = [networks[run.name] for run in each.runs]
        found[each.label] = {
            variant: {
                score: None if None in values else over_seeds(values)
                for score, values in ((score, [row[variant][score] for row in rows]) for score in scores)
            }
            for variant, scores in rows[0].items()
        }
    return found


def temporal(
    networks: Mapping[str, Network],
    source: BodySource | None = None,
    *,
    shots: int = SHOTS,
    frames: int = FRAMES,
    window: int = WINDOW,
    variants: Sequence[VariantName] = WITH_AND_WITHOUT,
    seed: int = 0,
    rig: Rig | None = None,
    progress: ProgressCallback = silent,
) -> dict[str, Any]:
    """Measure TC and VC of every network, in evaluation mode, over shots of test motions; returns plain JSON.

    source: of the bodies that move, the open source by default; rig: the paper's by default. Each shot is rendered
    once. Every network labels every frame alone, as it would come from a sensor, in every variant; artifacts are drawn
    anew in every frame. Scores of the same labels carried along (`CarriedLabels`) are beside them, with `CARRIED`
    behind the variant's name. All variants are counted at the same points, those measured in each of them. "truth"
    has the scores of the true labels: their distance from 1 is due to pixels and the partition.
    progress: called with frames done and frames in all; rendering a frame counts as one, as does labelling it.

    Raises as `choose_shots`, `render_shot` and `predict`.
    """
    source, rig = open_source("open") if source is None else source, load_rig() if rig is None else rig
    augmentations = {variant: Augmentation(rig, variant, seed) for variant in variants}
    chosen = choose_shots(source, shots, frames)
    ways = [way for variant in variants for way in (variant, f"{variant}{CARRIED}")]
    tallies = {name: {way: TemporalConsistency() for way in ways} for name in networks}
    truth, rendered_points = TemporalConsistency(), 0
    advance = counter(progress, shots * frames * (1 + len(variants) * len(networks)))
    for shot in chosen:
        frames_of_shot: list[ShotFrame] = []
        for frame in render_shot(source, shot, rig):
            frames_of_shot.append(frame)
            advance()
        tracks = find_tracks([frame.body for frame in frames_of_shot], window)
        images = {
            variant: [augmentation(frame.sample) for frame in frames_of_shot]
            for variant, augmentation in augmentations.items()
        }
        measured: NDArray[np.bool_] = np.all([[image.range > 0 for image in made] for made in images.values()], axis=0)
        kept = tracks.measured(measured)
        labels = np.where(measured, np.stack([frame.sample.labels for frame in frames_of_shot]), np.uint8(BACKGROUND))
        rendered_points += tracks.points()
        truth.add(labels, labels, kept)
        for variant, made in images.items():
            for name, network in networks.items():
                alone, carried = _labels(network, made, rig)
                tallies[name][variant].add(alone, labels, kept)
                tallies[name][f"{variant}{CARRIED}"].add(carried, labels, kept)
                advance(frames)
    points = int(truth.points[0, 0])
    return {
        "shots": [{"first": shot.bodies[0].mesh, "last": shot.bodies[-1].mesh, **asdict(shot.view)} for shot in chosen],
        "frames": frames,
        "window": window,
        "frames_per_second": FRAMES_PER_SECOND,
        "pairs": truth.agreement.pixels,
        "points": points,
        "measured_throughout": _share(points, rendered_points),
        "truth_stays": _share(int(truth.points[1, 0]), points),
        "truth": truth.to_json(),
        "networks": {name: {way: tally.to_json() for way, tally in by_way.items()} for name, by_way in tallies.items()},
    }


def _labels(network: Network, images: Sequence[RangeImage], rig: Rig) -> tuple[Labels, Labels]:
    """Predict frames one by one; returns label images, uint8 [frames, H, W], of each alone and carried along."""
    device, video = device_of(network), CarriedLabels()
    alone, carried = [], []
    for image in images:
        range_m = metres(image.range, rig.range_step_m)
        prediction = predict(network, torch.from_numpy(range_m)[None, None].to(device))
        labels, confidence = (each[0].cpu().numpy() for each in prediction)
        pixels = np.flatnonzero(range_m)
        alone.append(labels)
        carried.append(video(range_m, labels, [(pixels, confidence.ravel()[pixels])], rig.camera))
    return np.stack(alone), np.stack(carried)


def _share(part: float, whole: float = 1) -> float | None:
    return round(part / whole, 5) if whole and not np.isnan(part) else None
