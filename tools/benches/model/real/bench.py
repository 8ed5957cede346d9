"""`bench real`: a network's score on real range images of a person seen from all round.

docs/results/real_frames.md says how to read the results.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from benches.measuring import Figures, evenly_spaced
from benches.model.chosen import chosen_network
from benches.model.real.agreement import agreement
from benches.model.real.fusion import VOXEL_M, FusedSurface, fitted, fuse, residual_m
from benches.model.real.labels import Placements, frame_labels, load_placements, repeatability, surface_labels
from benches.model.real.recording import BACKGROUND as PEOPLE
from benches.model.real.recording import Frame, read_recording
from bodyseg_data.core import ProgressCallback, silent
from bodyseg_data.labels import BACKGROUND, LANDMARKS, PART_CLASSES
from bodyseg_data.machine import torch_threads
from bodyseg_data.rigs import Camera
from bodyseg_model.evaluation import ConfusionMatrix, GrossErrors, distances_to_parts, pairs_of
from bodyseg_model.evaluation.scores import Confidences, count_kinds
from bodyseg_model.networks import Trained
from bodyseg_model.recordings import FrameCamera
from bodyseg_model.recordings.cameras import assumed_sensors
from bodyseg_model.segmentation import Segmenter
from bodyseg_model.sensor_fit.edges import ProjectorShadow, measure_shadow, probably_mirrored
from bodyseg_model.sensor_fit.recording import MarkedFrame, MarkedRecording

_FRAMES: Final = 50
_SHADOW_FRAMES: Final = 20
_SHOWN: Final = 4

Labels = NDArray[np.uint8]


@dataclass(frozen=True)
class Answer:
    """A network's answer to a frame. labels: uint8 [H, W], 255 off the person. confidence: float32 [H, W], 0 there."""

    labels: Labels
    confidence: NDArray[np.float32]


@dataclass(frozen=True)
class Shown:
    """Panels of one frame in the picture: the frame, its true labels and the network's, uint8 [H, W]."""

    frame: Frame
    truth: Labels
    answer: Labels


def bench_real(
    data: str,
    views: int = _FRAMES,
    runs: Sequence[Path] = (),
    flip_average: bool = False,
    progress: ProgressCallback = silent,
) -> Figures:
    """Score a network on a recording of one still person, by labels of the surface that its frames show together.

    data: folder of frames with cameras, see `read_recording`. views: frames to use, evenly over the recording. runs:
    the network is in the first of them; without, it is the one that ships. flip_average: as `FlipAverage`. Raises
    BadConfig or BadLandmarks for a recording or landmarks that cannot be used; otherwise as `load_network`.
    """
    network_name, trained = chosen_network(runs, flip_average)
    placements = load_placements(Path(data))
    stored = read_recording(Path(data), views)
    shadow, mirrored = settled(stored)
    turned = [frame.mirrored() for frame in stored] if mirrored else stored
    placements = placements.mirrored() if mirrored else placements
    with torch_threads(1):
        rough = fuse(turned)
        frames = fitted(turned, rough)
        fused = fuse(frames)
        residuals = {"stored": residual_m(turned, rough), "fitted": residual_m(frames, fused)}
        of_surface = labels_of_surface(fused, placements)
        by_placement = in_frames(frames, fused, of_surface)
        truth = by_placement["mean"]
        progress(0, 2 * len(stored))
        answers: dict[bool, list[Answer]] = {}
        for way in (mirrored, not mirrored):
            segment = _Segmentation(trained, stored[0].placed.camera, way)
            answers[way] = []
            for frame in stored:
                answers[way].append(segment(frame, exchanged=way != mirrored, turned=mirrored))
                progress(sum(map(len, answers.values())), 2 * len(stored))
    chosen = answers[mirrored]

    def errors(name: str, given: Sequence[Answer]) -> dict[str, Any]:
        return {"gross_errors": gross_errors(frames, by_placement[name], given, fused, of_surface[name])}

    return Figures(
        {
            "recording": Path(data).name,
            "frames": len(frames),
            "network": network_name,
            "mirrored": {"frames": mirrored, **_shadow_json(shadow)},
            "fusion": {
                "voxel_mm": 1000 * VOXEL_M,
                "residual_mm": {name: {"median": round(1000 * each, 2)} for name, each in residuals.items()},
            },
            "landmarks": described(placements, of_surface),
            "scores": scored(frames, truth, chosen) | errors("mean", chosen),
            "accuracy_by_placement": {
                name: scored(frames, labels, chosen)["accuracy"] for name, labels in by_placement.items()
            },
            "gross_errors_by_placement": {name: errors(name, chosen)["gross_errors"] for name in by_placement},
            "scores_if_mirrored_otherwise": scored(frames, truth, answers[not mirrored]),
            "agreement": agreement(frames, [answer.labels for answer in chosen]),
        },
        [Shown(frames[n], truth[n], chosen[n].labels) for n in evenly_spaced(range(len(frames)), _SHOWN)],
    )


def settled(frames: Sequence[Frame]) -> tuple[ProjectorShadow | None, bool]:
    """Measure the projector's shadow behind the person, and whether frames are mirrored by it; without room behind the
    person or a known sensor, frames are taken as they are.
    """
    camera = frames[0].placed.camera
    chosen = []
    for frame in evenly_spaced(frames, _SHADOW_FRAMES):
        body = np.zeros(frame.range_m.shape, np.bool_)
        body.ravel()[frame.pixels] = True
        chosen.append(MarkedFrame(np.zeros(body.shape, np.uint16), frame.range_m, body))
    shadow = measure_shadow(MarkedRecording(tuple(chosen), camera, step_m=0.001))
    sensor = next((one for one in assumed_sensors() if _same_size(one.camera, camera)), None)
    side = None if sensor is None else FrameCamera(sensor.camera, sensor.name, rig=sensor.rig).projector_side
    return shadow, bool(probably_mirrored(shadow, side))


def surface_of(stored: Sequence[Frame], folder: Path) -> tuple[bool, list[Frame], FusedSurface, dict[str, Labels]]:
    """Whether stored frames are mirrored; the frames, turned right, that fit one surface; that surface, and the labels
    of its vertices by each placement of the landmarks in `folder`. Raises BadConfig as `surface_labels`.
    """
    _, mirrored = settled(stored)
    placements = load_placements(folder)
    with torch_threads(1):
        turned = [frame.mirrored() for frame in stored] if mirrored else stored
        frames = fitted(turned, fuse(turned))
        fused = fuse(frames)
        return mirrored, frames, fused, labels_of_surface(fused, placements.mirrored() if mirrored else placements)


def labels_of_surface(fused: FusedSurface, placements: Placements) -> dict[str, Labels]:
    """Labels of the surface's vertices, uint8 [V], by the mean of both placements, the first and the second.

    Raises BadConfig as `surface_labels`.
    """
    points = {
        "mean": (placements.first + placements.second) / 2,
        "first": placements.first,
        "second": placements.second,
    }
    return {name: surface_labels(fused, each, placements.labels, placements.left_out) for name, each in points.items()}


def in_frames(frames: Sequence[Frame], fused: FusedSurface, labels: Mapping[str, Labels]) -> dict[str, list[Labels]]:
    """Labels of frames, uint8 [H, W] each, by each labelling of the surface's vertices."""
    from scipy.spatial import KDTree

    tree = KDTree(fused.vertices)
    return {name: [frame_labels(frame, tree, each) for frame in frames] for name, each in labels.items()}


def described(placements: Placements, labels: Mapping[str, Labels]) -> dict[str, Any]:
    """Describe how well the placements repeat, and how much of the surface they label."""
    return {
        **repeatability(placements, labels["first"], labels["second"]),
        "surface_labelled": round(float((labels["mean"] != BACKGROUND).mean()), 4),
    }


def gross_errors(
    frames: Sequence[Frame], truth: Sequence[Labels], answers: Sequence[Answer], fused: FusedSurface, labels: Labels
) -> dict[str, float] | None:
    """Gross errors of the pixels that `scored` counts, by the surface, whose vertices have `labels`, uint8 [V]."""
    total, known = GrossErrors(), labels != BACKGROUND
    for frame, true, answer in zip(frames, truth, answers, strict=True):
        right, given = (image.ravel()[frame.pixels] for image in (true, answer.labels))
        scored_pixels = (right != BACKGROUND) & (given != BACKGROUND)
        wrong = scored_pixels & (right != given)
        points = frame.points(frame.pixels[wrong])
        away = distances_to_parts(points, given[wrong], fused.vertices[known], labels[known])
        total.add(away, int(np.count_nonzero(scored_pixels)) - len(away))
    return total.to_json()


def scored(frames: Sequence[Frame], truth: Sequence[Labels], answers: Sequence[Answer]) -> dict[str, Any]:
    """Scores of answers on the pixels with a true label that the network answered."""
    matrix, confidences = ConfusionMatrix(), Confidences()
    person = 0
    for frame, labels, answer in zip(frames, truth, answers, strict=True):
        known = np.where(answer.labels == BACKGROUND, np.uint8(BACKGROUND), labels)
        matrix.add(known, answer.labels)
        confidences.add(pairs_of(known, answer.labels), answer.confidence[known != BACKGROUND])
        person += len(frame.pixels)
    pixels = matrix.counts.sum(axis=1)
    kinds = count_kinds(matrix.counts)
    return {
        "pixels": matrix.pixels,
        "share_of_the_person": round(matrix.pixels / person, 4),
        "accuracy": _rounded(matrix.average_per_class_accuracy()),
        "pixel_accuracy": _rounded(matrix.pixel_accuracy()),
        "calibration_error": _rounded(confidences.ece()),
        "mean_confidence": _rounded(confidences.mean()),
        "kinds": {name: round((count or 0) / max(matrix.pixels, 1), 4) for name, count in kinds.items()},
        "parts": {
            name: {"pixels": int(count), "accuracy": _rounded(float(value))}
            for name, count, value in zip(LANDMARKS, pixels, matrix.per_class_accuracy(), strict=True)
            if count
        },
    }


class _Segmentation:
    """The path of `bodyseg segment` for frames as they are stored. mirrored: what it is told of them."""

    def __init__(self, trained: Trained, camera: Camera, mirrored: bool) -> None:
        self._segmenter = Segmenter(trained.network, camera, PEOPLE, mirrored=mirrored, rig=trained.rig)

    def __call__(self, frame: Frame, exchanged: bool, turned: bool) -> Answer:
        """Label a frame. exchanged: answer with right and left exchanged. turned: turn the images over."""
        segmented = self._segmenter(frame.range_m)
        confidence = np.zeros(frame.range_m.shape, np.float32)
        labels = np.full(frame.range_m.shape, BACKGROUND, np.uint8)
        body = segmented.bodies[0]  # the largest, as in the recording
        confidence.ravel()[body.pixels] = body.confidence
        labels.ravel()[body.pixels] = segmented.labels.ravel()[body.pixels]
        labels = PART_CLASSES.mirrored[labels] if exchanged else labels
        return Answer(labels[:, ::-1], confidence[:, ::-1]) if turned else Answer(labels, confidence)


def _same_size(one: Camera, other: Camera) -> bool:
    return (one.rows, one.columns) == (other.rows, other.columns)


def _shadow_json(shadow: ProjectorShadow | None) -> dict[str, Any]:
    if shadow is None:
        return {"shadow": None}
    return {"shadow": {side: {"width_px": round(width, 1)} for side, width in shadow.width_px.items()}}


def _rounded(value: float) -> float | None:
    return None if math.isnan(value) else round(value, 4)
