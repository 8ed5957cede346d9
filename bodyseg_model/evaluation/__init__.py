"""Evaluation of a network on a set of range images: accuracy, calibration, kinds of mistakes, figures, caching."""

from typing import TYPE_CHECKING

from bodyseg_data.core import lazy_door

if TYPE_CHECKING:
    from bodyseg_model.evaluation.evaluation import Evaluation, Scores, evaluate, open_images, time_frames
    from bodyseg_model.evaluation.figures import SamplePicture, draw_figures
    from bodyseg_model.evaluation.gross_errors import MEASURABLE, GrossErrors, TrueSurface, distances_to_parts
    from bodyseg_model.evaluation.reports import RigFit, over_seeds, report, sensor_warning
    from bodyseg_model.evaluation.scores import KINDS, ConfusionMatrix, count_pairs, kinds_of, pairs_of, told_kinds
else:
    __getattr__, __dir__, __all__ = lazy_door(__name__)
