"""Networks that segment range images into body parts: training, evaluation, segmentation of frames, stability.

    from bodyseg_model import FrameLabeller, evaluate, load_network, train

Each name is imported on first use. The names in `__all__` are the public interface; all else may move.
"""

from typing import TYPE_CHECKING

from bodyseg_data.core import lazy_door

if TYPE_CHECKING:  # each name `as` itself, so that type checkers of other programs take it for offered
    from bodyseg_data import __version__ as __version__
    from bodyseg_model.evaluation import Evaluation as Evaluation
    from bodyseg_model.evaluation import evaluate as evaluate
    from bodyseg_model.evaluation import open_images as open_images
    from bodyseg_model.networks import Network as Network
    from bodyseg_model.networks import Trained as Trained
    from bodyseg_model.networks import predict as predict
    from bodyseg_model.networks import wrapped as wrapped
    from bodyseg_model.recordings import LiveRecording as LiveRecording
    from bodyseg_model.recordings import driver_camera as driver_camera
    from bodyseg_model.recordings import frame_camera as frame_camera
    from bodyseg_model.recordings import open_recording as open_recording
    from bodyseg_model.recordings import to_metres as to_metres
    from bodyseg_model.runtimes import load_network as load_network
    from bodyseg_model.runtimes import on_backend as on_backend
    from bodyseg_model.runtimes import write_onnx as write_onnx
    from bodyseg_model.segmentation import JOINTS as JOINTS
    from bodyseg_model.segmentation import Background as Background
    from bodyseg_model.segmentation import CarriedLabels as CarriedLabels
    from bodyseg_model.segmentation import FrameLabeller as FrameLabeller
    from bodyseg_model.segmentation import LabelledFrame as LabelledFrame
    from bodyseg_model.segmentation import Segmentation as Segmentation
    from bodyseg_model.segmentation import Segmenter as Segmenter
    from bodyseg_model.training import Diverged as Diverged
    from bodyseg_model.training import GeometricAugmentation as GeometricAugmentation
    from bodyseg_model.training import Recipe as Recipe
    from bodyseg_model.training import RunOptions as RunOptions
    from bodyseg_model.training import Validation as Validation
    from bodyseg_model.training import recipe_for as recipe_for
    from bodyseg_model.training import train as train
else:
    __getattr__, __dir__, __all__ = lazy_door(__name__)
