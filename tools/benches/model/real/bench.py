"""`bench real`: a network's score on real range images of a person seen from all round.

docs/real_frames.md says how to read the results.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from benches.measuring import Progress, evenly_spaced, silent
from benches.model.real.agreement import agreement
from benches.model.real.fusion import VOXEL_M, FusedSurface, fitted, fuse, residuals_m
from benches.model.real.labels import Placements, frame_labels, load_placements, repeatability, surface_labels
from benches.model.real.recording import BACKGROUND as PEOPLE
from benches.model.real.recording import Frame, read_recording
from bodyseg_data.bodies.anny.library import one_thread
from bodyseg_data.core.errors import BadConfig, check_int
from bodyseg_data.core.parts import BACKGROUND, LANDMARKS, MIRRORED_LABELS
from bodyseg_model.evaluation.calibration import Confidences
from bodyseg_model.evaluation.mistakes import count_kinds
from bodyseg_model.evaluation.scores import ConfusionMatrix, pairs_of
from bodyseg_model.networks.checkpoints import SHIPPED, Trained, load_network
from bodyseg_model.segmentation.cameras import frame_camera
from bodyseg_model.segmentation.segmenter import Segmenter
from bodyseg_model.sensor_fit.recording import Frame as ShadowFrame
from bodyseg_model.sensor_fit.recording import Recording as ShadowRecording
from bodyseg_model.sensor_fit.shadows import Shadow, measure_shadow, probably_mirrored

_FRAMES: Final = 50
_SHADOW_FRAMES: Final = 20
_SHOWN: Final = 4

Labels = NDArray[np.uint8]


@dataclass(frozen=True)
class Answer:
    """A network's answer to a frame, on the person. labels: uint8 [H, W], 255 elsewhere. confidence: float32 [H, W]."""

    labels: Labels
    confidence: NDArray[np.float32]


def bench_real(
    data: str, views: int = _FRAMES, runs: Sequence[Path] = (), progress: Progress = silent
) -> dict[str, Any]:
    """Score a network on a recording of one still person, by labels of the surface that its frames show together.

    data: folder of frames with cameras, see `read_recording`. views: frames to use, evenly over the recording. runs:
    the network is in the first of them; without, it is the one that ships. Raises BadConfig or BadLandmarks for a
    recording or landmarks that cannot be used; otherwise as `load_network`.
    """
    check_int("the number of frames", views, 1)
    trained = load_network(runs[0] if runs else SHIPPED)
    placements = load_placements(Path(data))
    stored = evenly_spaced(read_recording(Path(data)), views)
    shadow, mirrored = settled(stored)
    frames = [frame.mirrored() for frame in stored] if mirrored else stored
    placements = placements.mirrored() if mirrored else placements
    steps = 3 * len(frames)
    with one_thread():
        fused = fuse(frames)
        before = residuals_m(frames, fused)
        frames = fitted(frames, fused)
        fused = fuse(frames)
        after = residuals_m(frames, fused)
        truth, repeated = true_labels(frames, fused, placements)
        progress(len(frames), steps)
        ways = {}
        for number, way in enumerate((mirrored, not mirrored)):
            ways[way] = []
            for done, frame in enumerate(stored):
                ways[way].append(_answer(trained, frame, way, mirrored))
                progress((1 + number) * len(frames) + done + 1, steps)
    answers = ways[mirrored]
    chosen = evenly_spaced(range(len(frames)), _SHOWN)
    return {
        "recording": Path(data).name,
        "frames": len(frames),
        "network": runs[0].name if runs else "shipped",
        "mirrored": {"frames": mirrored, **_shadow_json(shadow)},
        "fusion": {
            "voxel_mm": 1000 * VOXEL_M,
            "vertices": len(fused.vertices),
            "residual_mm": {"stored": _millimetres(before), "fitted": _millimetres(after)},
        },
        "landmarks": repeated,
        "scores": scored(frames, truth, answers),
        "as_if_mirrored_otherwise": scored(frames, truth, [_exchanged(one) for one in ways[not mirrored]]),
        "agreement": agreement(frames, [answer.labels for answer in answers]),
        "agreement_of_truth": agreement(frames, truth),
        "shown": {frames[n].name: _picture(frames[n], truth[n], answers[n]) for n in chosen},
    }
