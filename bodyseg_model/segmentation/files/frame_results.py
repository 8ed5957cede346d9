"""Results of labelled frames, one after another: their images, the preview and the summary."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.labels.label_map import LabelMap
from bodyseg_data.core.system.stopwatch import Stopwatch
from bodyseg_model.recordings.recording import Frame
from bodyseg_model.segmentation.files.output_folder import IMAGES, OutputFolder
from bodyseg_model.segmentation.pictures.overlay import Preview, draw_overlay
from bodyseg_model.segmentation.pictures.picture_png import encode_picture
from bodyseg_model.segmentation.segmenter import Segmentation
from bodyseg_model.segmentation.sequence_summary import SequenceSummary

_LABELS, _OVERLAY, _UNDISTORTED = IMAGES
_WRITE: Final = "write"


@dataclass(frozen=True)
class LabelledFrame:
    """A frame and its labels. stored: uint16 [H, W], without lens distortion, in the sensor's steps. range_m: float32
    [H, W], metres. milliseconds: of reading it. camera: of this frame alone, where it has one.
    """

    file: Frame
    stored: NDArray[np.uint16]
    range_m: NDArray[np.float32]
    result: Segmentation
    milliseconds: Mapping[str, float]
    camera: Mapping[str, Any] | None


class FrameResults:
    """Writes the images of frames into a folder, in the order of the frames, and collects preview and summary.

    label_map: the network's classes. preview: None if no overlays are drawn. shape: rows and columns of the preview's
    frames; others are left out of it.
    """

    def __init__(self, out: OutputFolder, label_map: LabelMap, preview: Preview | None, shape: tuple[int, int]) -> None:
        self.summary = SequenceSummary()
        self._out, self._label_map, self._preview, self._shape = out, label_map, preview, shape

    def prepare(self) -> None:
        """Load the compiled loops, so that the first frame takes no longer than others."""
        if self._preview is not None:
            nothing = np.zeros((1, 1), np.float32)
            draw_overlay(nothing, nothing.astype(np.uint8), [np.zeros(1, np.intp)], self._label_map)

    def __repr__(self) -> str:
        return f"FrameResults({self._out!r})"

    def add(self, frame: LabelledFrame) -> None:
        """Write and count one frame. Raises BadConfig, naming a file that cannot be written."""
        watch, result = Stopwatch((_WRITE,)), frame.result
        with watch(_WRITE):
            images: dict[str, NDArray[Any]] = {_LABELS: result.labels}
            if self._preview is not None:
                bodies = [body.pixels for body in result.bodies]
                overlay = images[_OVERLAY] = draw_overlay(frame.range_m, result.labels, bodies, self._label_map)
                if overlay.shape[:2] == self._shape:
                    self._preview.add(overlay)  # an animation has frames of one size
            if _UNDISTORTED in self._out.folders:
                images[_UNDISTORTED] = frame.stored
            for folder, image in images.items():
                self._out.write(folder, frame.file.name, encode_picture(image))
        times = {**frame.milliseconds, **result.milliseconds, **watch.milliseconds}
        file = frame.file
        self.summary.add(file.name, file.where, frame.range_m, result, times, file.sequence, frame.camera)
