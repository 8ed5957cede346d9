"""Draws bodies in the colours of the template, as a network sees them: `bench dense --figure FILE.png`."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from benches.measuring import Figures
from benches.model.dense import Shown
from bodyseg_data import load_template
from bodyseg_data.core import BadConfig
from bodyseg_data.drawing import INK, PAPER, font, save_picture
from bodyseg_data.labels import NOWHERE

_HEIGHT: Final = 320
_LEAST_WIDTH: Final = 96  # of a title
_GAP: Final = 8
_HEAD: Final = 30
_LINES_M: Final = 0.1  # between the dark lines that are drawn across bodies, so that shifts are seen
_EMPTY: Final = (24, 26, 32)


def draw_dense(figures: Figures, path: Path) -> None:
    """Write a PNG of the images that `bench_dense` kept, a row for each set of images: true and found points side by
    side, found ones of people.

    Raises BadConfig where no network gives points, or if the file cannot be written.
    """
    if not figures.shown:
        raise BadConfig("none of the networks gives points of the template: nothing is to be drawn")
    sets = itertools.groupby(figures.shown, key=lambda shown: shown.where)
    rows = [[panel for shown in of_set for panel in _panels(shown)] for _, of_set in sets]
    widths = [[max(panel.width, _LEAST_WIDTH) + _GAP for _, panel in row] for row in rows]
    step = _HEIGHT + _HEAD + _GAP
    sheet = Image.new("RGB", (_GAP + max(map(sum, widths)), step * len(rows)), PAPER)
    pen = ImageDraw.Draw(sheet)
    for number, (row, of_panels) in enumerate(zip(rows, widths, strict=True)):
        places = itertools.accumulate(of_panels[:-1], initial=_GAP)
        for left, (title, panel) in zip(places, row, strict=True):
            pen.text((left, step * number + 6), title, INK, font(15))
            sheet.paste(panel, (left, step * number + _HEAD))
    save_picture(sheet, path)


def _panels(shown: Shown) -> list[tuple[str, Image.Image]]:
    box = _box(shown.found)
    named = [(f"{shown.where}: found", shown.found)]
    if shown.truth is not None:
        named = [(f"{shown.where}: true", shown.truth), *named]
    return [(title, _panel(numbers[box])) for title, numbers in named]


def _box(numbers: NDArray[np.uint16]) -> tuple[slice, slice]:
    sides = [np.flatnonzero((numbers != NOWHERE).any(axis=axis)) for axis in (1, 0)]
    down, across = (slice(max(0, int(side[0]) - 8), int(side[-1]) + 9) if len(side) else slice(None) for side in sides)
    return down, across


def _panel(numbers: NDArray[np.uint16]) -> Image.Image:
    points = load_template().points
    least, most = points.min(axis=0), points.max(axis=0)
    colours = 40 + 200 * (points - least) / (most - least)
    dark = (np.abs(points / _LINES_M - np.round(points / _LINES_M))[:, :2] < 0.06).any(axis=1)
    colours[dark] *= 0.45
    table = np.full((NOWHERE + 1, 3), _EMPTY, np.uint8)
    table[: len(points)] = colours
    image = Image.fromarray(table[numbers])
    return image.resize((max(1, round(image.width * _HEIGHT / image.height)), _HEIGHT), Image.Resampling.BILINEAR)
