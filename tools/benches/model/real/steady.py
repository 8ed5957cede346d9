"""`bench steady`: how often labels change from frame to frame, each frame alone and with evidence carried along.

Of a still person, the points of the surface that a real recording's frames show together; of moving bodies, the points
of `bench motion`. docs/how-to/steady.md says how to read the results.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from benches.model.chosen import chosen_network
from benches.model.motion import CARRIED, temporal
from benches.model.real.bench import Answer, in_frames, scored, surface_of
from benches.model.real.fusion import FusedSurface
from benches.model.real.labels import ON_SURFACE_M
from benches.model.real.recording import BACKGROUND as PEOPLE
from benches.model.real.recording import Frame, read_recording
from bodyseg_data.core import ProgressCallback, silent
from bodyseg_data.labels import BACKGROUND
from bodyseg_model.networks import Trained
from bodyseg_model.segmentation import CarriedLabels, Segmenter
from bodyseg_model.segmentation.carried_labels import Cells, Floats

ALONE: Final = "alone"
CARRIED_ALONG: Final = "parts"


class StillLabels(CarriedLabels):
    """Evidence stays at its pixel."""

    def _motion(self, own: Cells, earlier: Cells, gain: float, *others: Any) -> tuple[Floats, Floats, float]:
        return np.eye(3, 4, dtype=np.float32), np.zeros_like(own.points), gain


class RigidLabels(CarriedLabels):
    """Evidence follows the body as a whole, none of its parts."""

    def _motion(self, own: Cells, earlier: Cells, gain: float, *others: Any) -> tuple[Floats, Floats, float]:
        rigid, _, _ = super()._motion(own, earlier, gain, *others)
        return rigid, np.zeros_like(own.points), gain


WAYS: Final[Mapping[str, type[CarriedLabels] | None]] = {
    ALONE: None,
    "still": StillLabels,
    "rigid": RigidLabels,
    CARRIED_ALONG: CarriedLabels,
}
"""Name -> how labels of earlier frames are carried along; None: not at all. The last is that of `--video`."""

TITLES: Final = {
    ALONE: "each frame alone",
    "still": "evidence stays at its pixel",
    "rigid": "carried, one rigid motion",
    CARRIED_ALONG: "`--video`: carried, with parts",
}

_FRAMES: Final = 100
_FACING: Final = 0.3  # least cosine between a normal and the way to the camera: beyond it, a pixel spans many points
_VARIANTS: Final = ("none", "all")
_NOT_MEASURED: Final = {"vc_right_where_truth_stays": None, "pixel_accuracy": None}

Labels = NDArray[np.uint8]


def bench_steady(
    data: str,
    views: int = _FRAMES,
    runs: Sequence[Path] = (),
    flip_average: bool = False,
    progress: ProgressCallback = silent,
) -> dict[str, Any]:
    """Measure labels of a still person and of moving bodies, with and without the evidence of earlier frames.

    data: folder of frames of one still person, in order, with cameras (`read_recording`). views: frames to use, evenly
    over the recording. runs: the network is in the first of them; without, it is the one that ships. flip_average: as
    `FlipAverage`. Raises BadConfig or BadLandmarks for a recording or landmarks that cannot be used; MissingLibrary;
    otherwise as `load_network`.
    """
    network_name, trained = chosen_network(runs, flip_average)

    def half(number: int) -> ProgressCallback:
        """Progress of the first or the second half, in steps of a thousandth."""
        return lambda done, total: progress(500 * number + 500 * done // total, 1000)

    still = still_person(trained, Path(data), views, half(0))
    moving = temporal({"network": trained.network}, progress=half(1))
    by_way = moving["networks"]["network"]
    return {
        "network": network_name,
        "still": still,
        "moving": {name: moving[name] for name in ("shots", "frames", "window")},
        "tables": {"steady": table(still["ways"], by_way)},
    }


def still_person(trained: Trained, folder: Path, views: int, progress: ProgressCallback = silent) -> dict[str, Any]:
    """Share of the points of the fused surface whose label changes from a frame to the next, of those that both see,
    and share of pixels right, for each of `WAYS`.

    Frames and cameras are made to fit one surface as in `bench_real`, and frames are labelled in their order.
    """
    stored = read_recording(folder, views)
    mirrored, frames, fused, labels = surface_of(stored, folder)
    truth = in_frames(frames, fused, {"mean": labels["mean"]})["mean"]
    answers = labelled(trained, stored, mirrored, progress)
    angles = [
        float(np.degrees(np.arccos(np.clip(one.placed.axes[2] @ other.placed.axes[2], -1, 1))))
        for one, other in itertools.pairwise(frames)
    ]
    ways = {}
    for way, given in answers.items():
        compared, changed = changes(frames, fused, [answer.labels for answer in given])
        ways[way] = {
            "changed": round(changed / compared, 5) if compared else None,
            "pixel_accuracy": scored(frames, truth, given)["pixel_accuracy"],
        }
    return {
        "recording": folder.name,
        "frames": len(frames),
        "degrees_apart": {"median": round(float(np.median(angles)), 2), "most": round(max(angles), 2)},
        "ways": ways,
    }


def labelled(
    trained: Trained, frames: Sequence[Frame], mirrored: bool, progress: ProgressCallback = silent
) -> dict[str, list[Answer]]:
    """Label frames as they are stored, in each of `WAYS`; the network labels each frame once.

    mirrored: frames show left for right; answers are then turned over, as the frames of the surface are.
    """
    segment = Segmenter(trained.network, frames[0].placed.camera, PEOPLE, mirrored=mirrored, rig=trained.rig)
    videos = {way: None if kind is None else kind() for way, kind in WAYS.items()}
    answers: dict[str, list[Answer]] = {way: [] for way in WAYS}
    for done, frame in enumerate(frames, start=1):
        found = segment(frame.range_m)
        seen = [(body.pixels, body.confidence) for body in found.bodies]
        for way, video in videos.items():
            labels = found.labels
            if video is not None:
                labels = video(frame.range_m, found.labels, seen, segment.camera)
            one = Answer(on_person(labels, frame), found.confidence)
            answers[way].append(Answer(one.labels[:, ::-1], one.confidence[:, ::-1]) if mirrored else one)
        progress(done, len(frames))
    return answers


def on_person(labels: Labels, frame: Frame) -> Labels:
    """Labels of the recording's person alone, uint8 [H, W]."""
    found = np.full(labels.shape, BACKGROUND, np.uint8)
    found.ravel()[frame.pixels] = labels.ravel()[frame.pixels]
    return found


def changes(frames: Sequence[Frame], surface: FusedSurface, answers: Sequence[Labels]) -> tuple[int, int]:
    """Number of points of the surface that two successive frames both label, over all pairs, and of those whose label
    changes.
    """
    named = [point_labels(frame, surface, labels) for frame, labels in zip(frames, answers, strict=True)]
    compared = changed = 0
    for one, other in itertools.pairwise(named):
        both = (one != BACKGROUND) & (other != BACKGROUND)
        compared += int(np.count_nonzero(both))
        changed += int(np.count_nonzero(both & (one != other)))
    return compared, changed


def point_labels(frame: Frame, surface: FusedSurface, labels: Labels) -> Labels:
    """Labels that a frame gives the vertices of the surface, uint8 [V]: those of the pixels that see them.

    `BACKGROUND` where a vertex turns away, the frame measured another surface, or the pixel has no label. labels: uint8
    [H, W], of the frame.
    """
    placed = frame.placed
    towards = placed.position - surface.vertices
    away = np.linalg.norm(towards, axis=1)
    at, ahead = placed.project(surface.vertices)
    inside = (ahead > 0) & ((surface.normals * towards).sum(axis=1) > _FACING * away)
    column, row = np.floor(at[:, 0]), np.floor(at[:, 1])
    inside &= (column >= 0) & (column < placed.camera.columns) & (row >= 0) & (row < placed.camera.rows)
    found = np.full(len(surface.vertices), BACKGROUND, np.uint8)
    seen = np.flatnonzero(inside)
    pixels = row[seen].astype(np.intp) * placed.camera.columns + column[seen].astype(np.intp)
    same = np.abs(frame.range_m.ravel()[pixels] - ahead[seen]) < ON_SURFACE_M
    found[seen[same]] = labels.ravel()[pixels[same]]
    return found


def ratio_of(scores: Mapping[str, float | None]) -> float | None:
    """Points that keep their one right label through a window, of those whose truth stays, over pixels right."""
    kept, right = scores["vc_right_where_truth_stays"], scores["pixel_accuracy"]
    return None if kept is None or not right else round(kept / right, 3)


def table(still: Mapping[str, Mapping[str, Any]], moving: Mapping[str, Mapping[str, Any]]) -> list[dict[str, str]]:
    """Rows of the page of tables: what changes on the still person, and what keeps its right label on moving bodies."""
    rows = []
    for way, title in TITLES.items():
        row = {
            "labels": title,
            "still person: points that change, %": _percent(still[way]["changed"], 2),
            "pixels right, %": _percent(still[way]["pixel_accuracy"]),
        }
        for variant in _VARIANTS:
            measured = {ALONE: variant, CARRIED_ALONG: f"{variant}{CARRIED}"}.get(way)
            scores = moving.get(measured, _NOT_MEASURED) if measured else _NOT_MEASURED
            head, ratio = f"moving, `{variant}`", ratio_of(scores)
            row[f"{head}: VC₈ constant and right, %"] = _percent(scores["vc_right_where_truth_stays"])
            row[f"{head}: pixels right, %"] = _percent(scores["pixel_accuracy"])
            row[f"{head}: ratio"] = "–" if ratio is None else f"{ratio:.3f}"
        rows.append(row)
    return rows


def _percent(share: float | None, decimals: int = 1) -> str:
    return "–" if share is None else f"{100 * share:.{decimals}f}"
