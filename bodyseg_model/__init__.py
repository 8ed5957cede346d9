"""Networks that segment range images into body parts: training, evaluation, segmentation of frames, stability.

    from bodyseg_model import FrameLabeller, evaluate, load_network, train

Each name is imported on first use. The names in `__all__` are the public interface; all else may move.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from bodyseg_data.core import lazy_door

if TYPE_CHECKING:
    from bodyseg_data import __version__ as __version__
    from bodyseg_model.evaluation import (
        Evaluation as Evaluation,
        evaluate as evaluate,
        open_images as open_images,
    )
    from bodyseg_model.networks import (
        Network as Network,
        Trained as Trained,
        load_network as load_network,
        predict as predict,
    )
    from bodyseg_model.recordings import (
        LiveRecording as LiveRecording,
        frame_camera as frame_camera,
        open_recording as open_recording,
        orbbec as orbbec,
        realsense as realsense,
        to_metres as to_metres,
    )
    from bodyseg_model.runtimes import on_backend as on_backend
    from bodyseg_model.segmentation import (
        Background as Background,
        FrameLabeller as FrameLabeller,
        Segmenter as Segmenter,
        shipped_score as shipped_score,
    )
    from bodyseg_model.training import (
        Recipe as Recipe,
        RunOptions as RunOptions,
        Validation as Validation,
        recipe_for as recipe_for,
        train as train,
    )
else:
    __getattr__, __dir__, __all__ = lazy_door(__name__)
