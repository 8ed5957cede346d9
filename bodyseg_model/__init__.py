"""Networks that segment range images into body parts: training, evaluation, segmentation of frames, stability.

    from bodyseg_model import FrameLabeller, Segmenter, load_network

Each name is imported on first use. The names in `__all__` are the public interface; all else may move.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import bodyseg_data
from bodyseg_data.core import lazy_door

if TYPE_CHECKING:
    from bodyseg_model.evaluation import evaluate
    from bodyseg_model.networks import Network, Trained, load_network, predict, shipped_network
    from bodyseg_model.recordings import find_frames, frame_camera
    from bodyseg_model.segmentation import Background, CarriedLabels, FrameLabeller, Segmenter, shipped_score
    from bodyseg_model.training import Recipe, RunOptions, Validation, recipe_for

    __version__: str

__all__ = [
    "Background",
    "CarriedLabels",
    "FrameLabeller",
    "Network",
    "Recipe",
    "RunOptions",
    "Segmenter",
    "Trained",
    "Validation",
    "evaluate",
    "find_frames",
    "frame_camera",
    "load_network",
    "predict",
    "recipe_for",
    "shipped_network",
    "shipped_score",
]

_public, _ = lazy_door(
    __name__,
    {
        "evaluation": "evaluate",
        "networks": "Network Trained load_network predict shipped_network",
        "recordings": "find_frames frame_camera",
        "segmentation": "Background CarriedLabels FrameLabeller Segmenter shipped_score",
        "training": "Recipe RunOptions Validation recipe_for",
    },
)


def __getattr__(name: str) -> Any:
    return bodyseg_data.__version__ if name == "__version__" else _public(name)  # one distribution
