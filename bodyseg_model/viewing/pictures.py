"""Pictures of a page: panels of one size with captions, in lines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from bodyseg_data.core.labels.label_map import LabelMap
from bodyseg_data.core.parts import BACKGROUND, colour_labels
from bodyseg_data.drawing.style import FAINT, INK, PAPER, THING, font

EMPTY: Final = (24, 26, 32)
"""Colour of pixels without a range."""

Legend = tuple[tuple[str, tuple[int, int, int]], ...]
"""Name and sRGB of each colour."""

KIND_LEGEND: Final[Legend] = (
    ("right", (206, 210, 216)),
    ("left for right", (74, 124, 206)),
    ("front for back", (224, 161, 60)),
    ("both at once", (176, 48, 140)),
    ("any other part", (214, 60, 52)),
)
"""Name and sRGB of each of `KINDS` of predictions."""

_KIND_COLOURS: Final = np.array([colour for _, colour in KIND_LEGEND], np.uint8)

WIDTH: Final = 1040
"""Width of a picture, pixels: twice that of its place on the page, for screens of high density."""

_GAP: Final = 8
_HEAD: Final = 26
_NOTE: Final = 30
_MOST_ROWS: Final = 420


@dataclass(frozen=True)
class Panel:
    """An image with its name above and a note below. image: sRGB uint8 [H, W, 3]."""

    name: str
    image: NDArray[np.uint8] = field(repr=False)
    note: str = ""


@dataclass(frozen=True)
class Layout:
    """Lines of `columns` panels of images of `rows` x `width` pixels, the size that they are reduced to."""

    columns: int
    rows: int
    width: int

    @classmethod
    def of(cls, columns: int, shape: tuple[int, int]) -> Layout:
        """The layout of images of `shape` (rows, columns) as large as fit into `WIDTH`."""
        scale = min((WIDTH - _GAP * (columns + 1)) / columns / shape[1], _MOST_ROWS / shape[0])
        return cls(columns, max(1, round(shape[0] * scale)), max(1, round(shape[1] * scale)))

    def reduced(self, image: NDArray[Any]) -> NDArray[Any]:
        """An image [H, W, ...] in the size of a panel, by its nearest pixels: means would hide missing ones."""
        rows = ((np.arange(self.rows) + 0.5) * image.shape[0] / self.rows).astype(np.intp)
        columns = ((np.arange(self.width) + 0.5) * image.shape[1] / self.width).astype(np.intp)
        picked: NDArray[Any] = image[rows[:, None], columns]
        return picked

    def draw(self, lines: Sequence[Sequence[Panel]]) -> NDArray[np.uint8]:
        """All panels in one picture, sRGB uint8 [H, W, 3]; their images are of the size of `reduced`."""
        sheet = Image.new("RGB", (WIDTH, self._line * len(lines) + _GAP), PAPER)
        pen = ImageDraw.Draw(sheet)
        for number, line in enumerate(lines):
            for panel, (left, top, _, _) in zip(line, self.boxes(number), strict=False):
                pen.text((left, top - _HEAD), panel.name, INK, font=font(19))
                sheet.paste(Image.fromarray(panel.image), (left, top))
                pen.text((left, top + self.rows + 2), panel.note, FAINT, font=font(16))
        return np.asarray(sheet)

    def boxes(self, line: int) -> list[tuple[int, int, int, int]]:
        """Left, top, width and height of the images of a line in the picture."""
        cell, top = (WIDTH - _GAP) // self.columns, _GAP + line * self._line + _HEAD
        return [(_GAP + column * cell, top, self.width, self.rows) for column in range(self.columns)]

    @property
    def _line(self) -> int:
        return _HEAD + self.rows + _NOTE


def label_image(labels: NDArray[np.uint8], measured: NDArray[np.bool_], label_map: LabelMap) -> NDArray[np.uint8]:
    """Classes in their colours, sRGB uint8 [H, W, 3]; what was measured and has no class is grey.

    labels: uint8 [H, W], classes of the map. measured: bool [H, W].
    """
    colours = colour_labels(labels, EMPTY, label_map.colours)
    colours[(labels == BACKGROUND) & measured] = THING
    return colours


def kind_image(kinds: NDArray[np.uint8], measured: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Kinds of predictions in their colours, sRGB uint8 [H, W, 3]; what was measured and has no kind is grey.

    kinds: uint8 [H, W], 255 where there is none. measured: bool [H, W].
    """
    colours = colour_labels(kinds, EMPTY, _KIND_COLOURS)
    colours[(kinds == BACKGROUND) & measured] = THING
    return colours


def share_image(shares: NDArray[np.float32], measured: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Shares from 0, red, through 0.5, yellow, to 1, green, sRGB uint8 [H, W, 3].

    shares: float32 [H, W], such as confidences. measured: bool [H, W]; elsewhere the image is nearly black.
    """
    stops = np.array([[196, 40, 52], [236, 196, 76], [38, 150, 96]], np.float64)
    position = 2 * np.clip(shares, 0, 1)
    colours = np.stack([np.interp(position, (0, 1, 2), channel) for channel in stops.T], axis=-1)
    colours[~measured] = EMPTY
    found: NDArray[np.uint8] = np.rint(colours).astype(np.uint8)
    return found


def class_legend(label_map: LabelMap) -> Legend:
    """The classes of a map."""
    colours = [(int(red), int(green), int(blue)) for red, green, blue in label_map.colours]
    return tuple(zip(label_map.names, colours, strict=True))


def legend_html(entries: Legend, columns: int) -> str:
    """A legend as HTML, in columns from top to bottom."""
    square = "flex:none;width:12px;height:12px;border-radius:3px;background:rgb"
    lines = "".join(
        '<div style="break-inside:avoid;display:flex;gap:6px;align-items:center">'
        f'<span style="{square}{colour}"></span><span>{escape(name)}</span></div>'
        for name, colour in entries
    )
    style = f"columns:{columns};column-gap:10px;font-size:12px;line-height:1.5;padding:4px 8px"
    return f'<div style="{style}">{lines}</div>'


def facts_html(facts: Sequence[str], warning: str = "") -> str:
    """Lines of text as HTML, the first one bold; a warning, where there is one, in red above them."""
    lines = [f'<div style="color:#c22f2f;font-weight:600">{escape(warning)}</div>'] if warning else []
    lines += [f"<div><b>{escape(line)}</b></div>" for line in facts[:1]]
    lines += [f"<div>{escape(line)}</div>" for line in facts[1:]]
    return f'<div style="font-size:12px;line-height:1.45;padding:2px 8px">{"".join(lines)}</div>'


def sheet_of(picture: NDArray[np.uint8], view: NDArray[np.uint8], facts: Sequence[str]) -> Image.Image:
    """The picture of panels with the points as a browser drew them beside it, and facts above both.

    picture: sRGB uint8 [H, W, 3]. view: the same, of any size; it is scaled to the picture's height.
    """
    width = max(1, round(view.shape[1] * picture.shape[0] / view.shape[0]))
    line = 24
    top = line * len(facts) + 2 * _GAP
    sheet = Image.new("RGB", (picture.shape[1] + width, top + picture.shape[0]), PAPER)
    pen = ImageDraw.Draw(sheet)
    for number, fact in enumerate(facts):
        pen.text((_GAP, _GAP + number * line), fact, INK, font=font(17))
    sheet.paste(Image.fromarray(picture), (0, top))
    seen = Image.fromarray(np.ascontiguousarray(view))
    sheet.paste(seen.resize((width, picture.shape[0]), Image.Resampling.LANCZOS), (picture.shape[1], top))
    return sheet
