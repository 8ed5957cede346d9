"""Networks that segment range images into body parts: training, evaluation, segmentation of frames, stability.

    from bodyseg_model import FrameLabeller, evaluate, load_network, train

Each name is imported on first use. The names in `__all__` are the public interface; all else may move.
"""

from typing import TYPE_CHECKING

from bodyseg_data.core import lazy_door

__all__ = [
    "JOINTS",
    "Background",
    "CarriedLabels",
    "Diverged",
    "Evaluation",
    "FrameLabeller",
    "GeometricAugmentation",
    "LabelledFrame",
    "LiveRecording",
    "Network",
    "Recipe",
    "RunOptions",
    "Segmentation",
    "Segmenter",
    "Trained",
    "Validation",
    "driver_camera",
    "evaluate",
    "frame_camera",
    "load_network",
    "on_backend",
    "open_images",
    "open_recording",
    "predict",
    "recipe_for",
    "to_metres",
    "train",
    "wrapped",
    "write_onnx",
]

if TYPE_CHECKING:
    from bodyseg_data import __version__ as __version__
    from bodyseg_model.evaluation import Evaluation, evaluate, open_images
    from bodyseg_model.networks import Network, Trained, predict, wrapped
    from bodyseg_model.recordings import LiveRecording, driver_camera, frame_camera, open_recording, to_metres
    from bodyseg_model.runtimes import load_network, on_backend, write_onnx
    from bodyseg_model.segmentation import (
        JOINTS,
        Background,
        CarriedLabels,
        FrameLabeller,
        LabelledFrame,
        Segmentation,
        Segmenter,
    )
    from bodyseg_model.training import (
        Diverged,
        GeometricAugmentation,
        Recipe,
        RunOptions,
        Validation,
        recipe_for,
        train,
    )
else:
    __getattr__, __dir__, _ = lazy_door(__name__)
