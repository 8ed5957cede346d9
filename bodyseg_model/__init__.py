"""Networks that segment range images into body parts: training, evaluation, segmentation of frames, stability.

    from bodyseg_model import FrameLabeller, evaluate, load_network, train

Each name is imported on first use. The names in `__all__` are the public interface; all else may move.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import bodyseg_data
from bodyseg_data.core import lazy_door

if TYPE_CHECKING:
    from bodyseg_model.evaluation import Evaluation, evaluate, open_images
    from bodyseg_model.networks import Network, Trained, load_network, predict
    from bodyseg_model.recordings import LiveRecording, frame_camera, open_recording, orbbec, realsense, to_metres
    from bodyseg_model.runtimes import on_backend
    from bodyseg_model.segmentation import Background, FrameLabeller, Segmenter, shipped_score
    from bodyseg_model.training import Recipe, RunOptions, Validation, recipe_for, train

    __version__: str

__all__ = [
    "Background",
    "Evaluation",
    "FrameLabeller",
    "LiveRecording",
    "Network",
    "Recipe",
    "RunOptions",
    "Segmenter",
    "Trained",
    "Validation",
    "evaluate",
    "frame_camera",
    "load_network",
    "on_backend",
    "open_images",
    "open_recording",
    "orbbec",
    "predict",
    "realsense",
    "recipe_for",
    "shipped_score",
    "to_metres",
    "train",
]

_public, _ = lazy_door(
    __name__,
    {
        "evaluation": "Evaluation evaluate open_images",
        "networks": "Network Trained load_network predict",
        "recordings": "LiveRecording frame_camera open_recording orbbec realsense to_metres",
        "runtimes": "on_backend",
        "segmentation": "Background FrameLabeller Segmenter shipped_score",
        "training": "Recipe RunOptions Validation recipe_for train",
    },
)


def __getattr__(name: str) -> Any:
    return bodyseg_data.__version__ if name == "__version__" else _public(name)  # one distribution
