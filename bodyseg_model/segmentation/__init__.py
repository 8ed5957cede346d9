"""Segmentation of the frames of a real sensor: background removal, resampling, labels, overlays."""

from typing import TYPE_CHECKING

from bodyseg_data.core import lazy_door

if TYPE_CHECKING:
    from bodyseg_model.segmentation.carried_labels import CarriedLabels
    from bodyseg_model.segmentation.cutting import cut_people
    from bodyseg_model.segmentation.finder import Background, find_bodies
    from bodyseg_model.segmentation.frame_labeller import FrameLabeller, LabelledFrame, LabelledRecording
    from bodyseg_model.segmentation.joints import JOINTS
    from bodyseg_model.segmentation.output_folder import SUMMARY, UNFINISHED, FrameResults, ImageKind, OutputFolder
    from bodyseg_model.segmentation.pictures import Preview, draw_overlay
    from bodyseg_model.segmentation.segmenter import Segmentation, Segmenter
    from bodyseg_model.segmentation.sequence_summary import STILL_M, SequenceSummary, flicker
    from bodyseg_model.segmentation.views import TURNED_HELP, BackgroundMode, Turned, view_body
else:
    __getattr__, __dir__, __all__ = lazy_door(__name__)
