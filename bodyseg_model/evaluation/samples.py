"""Figure of single test images, as in the paper's Fig. 5: range, truth, prediction, mistakes, confidence."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from bodyseg_data.artifacts.surface import box_of
from bodyseg_data.core.labels.label_map import PARTS33, LabelMap
from bodyseg_data.core.parts import BACKGROUND, colour_labels
from bodyseg_data.drawing.contact_sheet import colour_range
from bodyseg_data.drawing.style import FAINT, INK, PAPER, draw_legend, fitted, font
from bodyseg_model.evaluation.evaluation import PredictedImage
from bodyseg_model.evaluation.mistakes import KINDS, kinds_of
from bodyseg_model.evaluation.report import PAPERS_THRESHOLD, subset_order
from bodyseg_model.evaluation.scores import ConfusionMatrix

_THRESHOLD: Final = f"{100 * PAPERS_THRESHOLD:.0f} %"
_HEADS: Final = ("range", "truth", "prediction", "mistakes", "confidence", f"above {_THRESHOLD} only")

_EMPTY: Final = (24, 26, 32)
_DROPPED: Final = (120, 122, 128)
_RIGHT, _WRONG, _SWAPPED = (220, 226, 236), (232, 134, 46), (148, 62, 190)
_KIND_COLOURS: Final = {"right": _RIGHT, "other": _WRONG}
"""Any other kind is a swap. Light, medium and darker, so that they are distinct in grey as well."""

# Low to high confidence: dark to light as well as blue to yellow.
_RAMP: Final = np.array([[0, 34, 78], [66, 78, 108], [124, 123, 120], [189, 175, 110], [254, 232, 56]])

_HEIGHT: Final = 340
_WIDTH: Final = 190
_LEAST_WIDTH: Final = 150
_TOP: Final = 30
_GAP: Final = 8
_CAPTION: Final = 22
_BODY_MARGIN: Final = 6


class SamplePicture:
    """Collects the first image of every subset and the image of lowest accuracy during an evaluation.

    label_map: the classes of the labels.
    """

    def __init__(self, label_map: LabelMap = PARTS33) -> None:
        self._label_map = label_map
        self._first: dict[str, tuple[float, PredictedImage]] = {}
        self._worst: tuple[float, PredictedImage] | None = None

    def watch(self, image: PredictedImage, accuracy: float) -> None:
        """Consider one image for the figure; empty ones are ignored."""
        if np.isnan(accuracy):
            return
        if image.subset not in self._first:
            self._first[image.subset] = accuracy, _cropped(image)
        if self._worst is None or accuracy < self._worst[0]:
            self._worst = accuracy, _cropped(image)

    def draw(self) -> Image.Image | None:
        """Draw the figure; None if every image was empty."""
        if self._worst is None:
            return None
        groups = sorted(self._first, key=subset_order)
        shown = [(f"first of {name}", *self._first[name]) for name in groups]
        shown.append(("worst of all", *self._worst))
        lines = [[fitted(panel, _WIDTH, _HEIGHT) for panel in _panels(image, self._label_map)] for _, _, image in shown]
        widths = [max(_LEAST_WIDTH, *(line[column].width for line in lines)) for column in range(len(_HEADS))]
        width = sum(widths) + _GAP * (len(_HEADS) + 1)
        legend = _legend(width - 2 * _GAP, self._label_map)
        heights = [_CAPTION + line[0].height + _GAP for line in lines]
        picture = Image.new("RGB", (width, _TOP + sum(heights) + legend.height + 2 * _GAP), PAPER)
        pen = ImageDraw.Draw(picture)
        lefts = [_GAP + sum(widths[:column]) + _GAP * column for column in range(len(_HEADS))]
        for left, head in zip(lefts, _HEADS, strict=True):
            pen.text((left, 7), head, INK, font=font(15))
        top = _TOP
        for (which, accuracy, image), line, height in zip(shown, lines, heights, strict=True):
            pen.text((_GAP, top + 3), f"{which}: {_caption(accuracy, image, self._label_map)}", FAINT, font=font(13))
            for left, panel in zip(lefts, line, strict=True):
                picture.paste(panel, (left, top + _CAPTION))
            top += height
        picture.paste(legend, (_GAP, top + _GAP))
        return picture


def _cropped(image: PredictedImage) -> PredictedImage:
    """A copy of an image, cropped to the body."""
    box = box_of(image.labels != BACKGROUND, _BODY_MARGIN) or np.s_[:, :]
    arrays = ("range_m", "labels", "predicted", "confidence")
    return image._replace(**{name: getattr(image, name)[box].copy() for name in arrays})


def _caption(accuracy: float, image: PredictedImage, label_map: LabelMap) -> str:
    confident = ConfusionMatrix(len(label_map))
    confident.add(np.where(image.confidence > PAPERS_THRESHOLD, image.labels, np.uint8(BACKGROUND)), image.predicted)
    share = confident.pixels / np.count_nonzero(image.labels != BACKGROUND)
    caption = f"{image.key}. Average per-class accuracy {100 * accuracy:.1f} %"
    if not confident.pixels:
        return f"{caption}; no pixel is above {_THRESHOLD}"
    better = 100 * confident.average_per_class_accuracy()
    return f"{caption}; {better:.1f} % among the {100 * share:.0f} % of pixels above {_THRESHOLD}"


def _panels(image: PredictedImage, label_map: LabelMap) -> list[NDArray[np.uint8]]:
    body = image.labels != BACKGROUND
    # Noise has long tails: the ramp covers 98 % of the pixels.
    near, far = (float(edge) for edge in np.percentile(image.range_m[body], (1, 99)))
    kinds = np.zeros(body.shape, np.uint8)
    kinds[body] = kinds_of(label_map)[image.labels[body], image.predicted[body]]
    mistakes = np.array([_KIND_COLOURS.get(kind, _SWAPPED) for kind in KINDS], np.uint8)[kinds]
    mistakes[~body] = _EMPTY
    confidence = _colour_confidence(image.confidence)
    confidence[~body] = _EMPTY
    confident = colour_labels(image.predicted, _EMPTY, label_map.colours)
    confident[body & (image.confidence <= PAPERS_THRESHOLD)] = _DROPPED
    return [
        colour_range(image.range_m, near, far),
        colour_labels(image.labels, _EMPTY, label_map.colours),
        colour_labels(image.predicted, _EMPTY, label_map.colours),
        mistakes,
        confidence,
        confident,
    ]


def _colour_confidence(confidence: NDArray[np.float32]) -> NDArray[np.uint8]:
    position = np.clip(confidence, 0, 1) * (len(_RAMP) - 1)
    colours = np.stack([np.interp(position, np.arange(len(_RAMP)), channel) for channel in _RAMP.T], axis=-1)
    drawn: NDArray[np.uint8] = np.rint(colours).astype(np.uint8)
    return drawn


def _legend(width: int, label_map: LabelMap) -> Image.Image:
    """The colours of mistakes and confidence, and the classes."""
    parts = draw_legend(width, label_map)
    legend = Image.new("RGB", (width, parts.height + 34), PAPER)
    legend.paste(parts, (0, 34))
    pen = ImageDraw.Draw(legend)
    left = 0
    for colour, name in (
        (_RIGHT, "right"),
        (_WRONG, "wrong"),
        (_SWAPPED, "left for right, or front for back"),
        (_DROPPED, "dropped"),
        (_EMPTY, "nothing measured"),
    ):
        pen.rectangle((left, 7, left + 15, 22), colour, FAINT)
        pen.text((left + 22, 15), name, INK, font=font(13), anchor="lm")
        left += 22 + int(font(13).getlength(name)) + 22
    ramp = _colour_confidence(np.tile(np.linspace(0, 1, 150, dtype=np.float32), (15, 1)))
    legend.paste(Image.fromarray(ramp), (left, 7))
    pen.text((left + 158, 15), "confidence 0 to 100 %", INK, font=font(13), anchor="lm")
    return legend
