"""Contact sheet: the stored images of several samples and their five variants, side by side.

Where bodies are small in the images, it shows the window of rows and columns that holds them.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from bodyseg_data.artifacts import RangeImage, SensorModel, VariantName
from bodyseg_data.drawing.style import EMPTY, FAINT, INK, PAPER, THING, colour_shares, draw_legend, fitted, font
from bodyseg_data.labels import BACKGROUND, PARTS33, LabelMap, colour_labels
from bodyseg_data.samples import HELD, Sample, Window, box_of

_MARGIN: Final = 0.08  # around what is measured, as a share of its longer side
_MOST_CROPPED: Final = 0.4  # share of an image up to which it is cropped to a window; with more, it stays whole

_GAP: Final = 6
_TITLE: Final = 40
_HEAD: Final = 26
_CAPTION: Final = 23
_NOTE: Final = 22
_SMALL: Final = 15  # size of letters that are still read where the sheet is shown in half its size
_PANEL_ROWS: Final = 320
_PANEL_COLUMNS: Final = 480

# Near to far: light to dark as well as warm to cold, so that it also reads in grey.
_RAMP: Final = np.array(
    [[255, 247, 200], [254, 217, 128], [247, 164, 86], [226, 104, 84], [178, 62, 104], [116, 46, 118], [66, 40, 104]]
)


def window_of(images: Sequence[NDArray[Any]]) -> Window:
    """Return rows and columns of all pixels where any of the images [H, W] is above 0, with a margin.

    Images stay whole if these are more than two fifths of them, as before a narrow camera, or if their sizes differ.
    """
    whole = slice(None), slice(None)
    if len({image.shape for image in images}) != 1:
        return whole
    measured = np.any([image > 0 for image in images], axis=0)
    box = box_of(measured)
    if box is None:
        return whole
    margin = round(_MARGIN * max(span.stop - 1 - span.start for span in box))
    box = box_of(measured, margin) or whole
    return box if measured[box].size < _MOST_CROPPED * measured.size else whole


@dataclass(frozen=True)
class Row:
    """One line of the sheet: a sample as stored, one step of its ranges in metres, and its image in each variant."""

    sample: Sample
    step_m: float
    variants: dict[VariantName, RangeImage]


def colour_range(
    image: NDArray[np.uint16 | np.float32], near: float | None = None, far: float | None = None
) -> NDArray[np.uint8]:
    """Colour a range image [H, W], in steps or metres, as sRGB uint8 [H, W, 3]: light at `near`, dark at `far`.

    near, far: in the unit of the image, by default its own ends. A tensor of a batch may be given as it is.
    """
    ends = span_of(image)
    near, far = ends[0] if near is None else near, ends[1] if far is None else far
    colours = colour_shares((np.asarray(image, np.float64) - near) / ((far - near) or 1), _RAMP)
    colours[image == 0] = EMPTY
    return colours


def span_of(image: NDArray[np.uint16 | np.float32]) -> tuple[float, float]:
    """Nearest and farthest range of a range image [H, W] that are measured, in its unit; (0, 1) if nothing is."""
    seen = image[image > 0]
    return (float(seen.min()), float(seen.max())) if len(seen) else (0.0, 1.0)


def draw_sheet(
    rows: Sequence[Row], shown: VariantName, title: str, sensor: SensorModel, label_map: LabelMap = PARTS33
) -> Image.Image:
    """Draw one line of panels a sample: camera range, projector range, labels, the variants, labels in `shown`.

    Where bodies fill less than two fifths of the image, as before a wide camera, all panels are cropped to them, alike.
    sensor: the model that made the variants; captions name its drawn quantities. label_map: the classes of labels.
    """
    seen = window_of([row.sample.range for row in rows])
    panels = [_panels(row, shown, sensor, label_map, seen) for row in rows]
    lit = ["projector range"] if rows[0].sample.projector_range is not None else []
    heads = ["camera range", *lit, "labels", *rows[0].variants, f"labels in {shown}"]
    widths = [
        max(_text_width(head, 20), *(max(line[column][1].width, _text_width(line[column][0])) for line in panels))
        for column, head in enumerate(heads)
    ]
    width = sum(widths) + _GAP * (len(widths) + 1)
    legend = _legend(width - 2 * _GAP, label_map)
    line_height = _CAPTION + _PANEL_ROWS + _NOTE + _GAP
    top = _TITLE + _HEAD
    sheet = Image.new("RGB", (width, top + line_height * len(rows) + legend.height + 2 * _GAP), PAPER)
    pen = ImageDraw.Draw(sheet)
    pen.text((_GAP, 8), title, INK, font=font(20))
    for number, (row, line) in enumerate(zip(rows, panels, strict=True)):
        left, line_top = _GAP, top + number * line_height
        pen.text((left, line_top + 2), _caption(row.sample), FAINT, font=font(_SMALL))
        for head, panel_width, (note, panel) in zip(heads, widths, line, strict=True):
            if number == 0:
                pen.text((left, _TITLE), head, INK, font=font(20))
            sheet.paste(panel, (left, line_top + _CAPTION))
            pen.text((left, line_top + _CAPTION + _PANEL_ROWS + 2), note, INK, font=font(_SMALL))
            left += panel_width + _GAP
    sheet.paste(legend, (_GAP, sheet.height - legend.height - _GAP))
    return sheet


def _panels(
    row: Row, shown: VariantName, sensor: SensorModel, label_map: LabelMap, seen: Window
) -> list[tuple[str, Image.Image]]:
    """Captions and pictures of one line. All camera range panels share the scale of the clean one.

    seen: rows and columns of the camera's images that are drawn; the projector's are drawn there too if equally large.
    """
    sample = row.sample
    span, occluder = span_of(sample.range), sample.projector_range
    panels = [(span_text(sample.range, row.step_m), colour_range(sample.range, *span))]
    if occluder is not None:
        panels.append((span_text(occluder, row.step_m), colour_range(occluder, *span_of(occluder))))
    panels.append(("", _colour_labels(sample.labels, sample.range, label_map)))
    panels += [(sensor.caption(image.drawn), colour_range(image.range, *span)) for image in row.variants.values()]
    panels.append(("", _colour_labels(row.variants[shown].labels, row.variants[shown].range, label_map)))
    shape = sample.range.shape
    return [
        (note, fitted(picture[seen] if picture.shape[:2] == shape else picture, _PANEL_COLUMNS, _PANEL_ROWS))
        for note, picture in panels
    ]


def _colour_labels(labels: NDArray[np.uint8], image: NDArray[np.uint16], label_map: LabelMap) -> NDArray[np.uint8]:
    """Colour labels [H, W] by their classes, sRGB [H, W, 3]; what has a range and no class, such as things, is grey."""
    classes = label_map.table[labels]
    colours = colour_labels(classes, EMPTY, label_map.colours)
    colours[(classes == BACKGROUND) & (image > 0)] = THING
    return colours


def _text_width(text: str, size: int = _SMALL) -> int:
    return math.ceil(font(size).getlength(text)) + 4


def span_text(image: NDArray[np.uint16], step_m: float) -> str:
    """Nearest and farthest range of a range image [H, W] in steps of `step_m` metres, in words."""
    near, far = span_of(image)
    return f"{near * step_m:.2f} to {far * step_m:.2f} m" if near else "nothing in view"


def _caption(sample: Sample) -> str:
    info = sample.info
    place = info.get("things", "")
    things = f"things {place}: {info.get('hidden_pct', 0)} % hidden" if place else ""
    things = "holds a thing" if place == HELD else things
    told = [str(info.get(name, "")) for name in ("subject", "pose")]
    view = info.view.words if info.view else ""
    return f"{', '.join(filter(None, (*told, view, things)))} ({info.split}, {sample.key})".lstrip()


def _legend(width: int, label_map: LabelMap) -> Image.Image:
    """Legend of the classes, and below it the colour scale of ranges."""
    parts = draw_legend(width, label_map)
    legend = Image.new("RGB", (width, parts.height + 34), PAPER)
    legend.paste(parts, (0, 0))
    pen = ImageDraw.Draw(legend)
    top = parts.height + 10
    ramp = colour_range(np.tile(np.arange(1, 241, dtype=np.uint16), (13, 1)), 1, 240)
    legend.paste(Image.fromarray(ramp), (0, top + 2))
    pen.text((248, top), "range: near to far within each line", INK, font=font(13))
    pen.rectangle((500, top + 2, 513, top + 14), EMPTY)
    pen.text((519, top), "nothing measured", INK, font=font(13))
    return legend
