"""Networks that segment range images into body parts: training, evaluation, segmentation of frames, stability.

    from bodyseg_model import FrameLabeller, evaluate, load_network, train

Each name is imported on first use. The names in `__all__` are the public interface; all else may move.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from bodyseg_data.core import lazy_door

if TYPE_CHECKING:
    from bodyseg_data import __version__ as __version__
    from bodyseg_model.evaluation import Evaluation as Evaluation, evaluate as evaluate, open_images as open_images
    from bodyseg_model.networks import Network as Network, Trained as Trained, load_network as load_network
    from bodyseg_model.networks import predict as predict, wrapped as wrapped
    from bodyseg_model.recordings import LiveRecording as LiveRecording, frame_camera as frame_camera
    from bodyseg_model.recordings import open_recording as open_recording, orbbec as orbbec, realsense as realsense
    from bodyseg_model.recordings import to_metres as to_metres
    from bodyseg_model.runtimes import on_backend as on_backend, write_onnx as write_onnx
    from bodyseg_model.segmentation import JOINTS as JOINTS, Background as Background, FrameLabeller as FrameLabeller
    from bodyseg_model.segmentation import Segmenter as Segmenter
    from bodyseg_model.training import Recipe as Recipe, RunOptions as RunOptions, Validation as Validation
    from bodyseg_model.training import recipe_for as recipe_for, train as train
else:
    __getattr__, __dir__, __all__ = lazy_door(__name__)
