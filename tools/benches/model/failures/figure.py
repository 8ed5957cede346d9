"""Draws the worst images that `bench failures` found: `--figure FILE.png`, and FILE_hard.png for a hard set."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from benches.measuring import Figures
from benches.model.failures.causes import NAMES
from benches.model.failures.study import VIEWS_A_BODY, Picture
from bodyseg_data.drawing import FAINT, INK, PAPER, colour_range, draw_legend, fitted, font, save_picture
from bodyseg_data.labels import BACKGROUND, colour_labels

Tree = dict[str, Any]

_EMPTY: Final = (24, 26, 32)
_RIGHT: Final = (228, 229, 226)
_COLOURS: Final = {
    "lost_data": (240, 228, 66),
    "out_of_frame": (86, 180, 233),
    "grazing": (0, 158, 115),
    "contact": (213, 94, 0),
    "border": (150, 150, 150),
    "left/right": (228, 140, 190),
    "front/back": (120, 40, 130),
    "pose": (0, 84, 166),
    "noise": (240, 168, 40),
    "border_moved": (125, 82, 50),
    "unexplained": (0, 0, 0),
}
"""Hues after Okabe and Ito, lightness as far apart as can be; the commonest cause, a border's own width, is grey."""

_HEADS: Final = ("range", "truth", "prediction", "wrong, by cause")
_COLUMNS: Final = 3
_PANEL_WIDTH: Final = 146
_PANEL_HEIGHT: Final = 236
_GAP: Final = 5
_BETWEEN: Final = 26
_TITLE: Final = 62
_CAPTION: Final = 56
_LINE: Final = 24
_LONGEST_RANGE: Final = 99  # per cent of a body's pixels that the ramp of ranges covers, since noise has tails


class _Item(NamedTuple):
    lines: tuple[str, str, str]
    panels: list[Image.Image]

    @property
    def height(self) -> int:
        return _CAPTION + max(panel.height for panel in self.panels)


def draw_failures(figures: Figures, path: Path) -> None:
    """Write a PNG of the worst images of the test set, and one beside it, NAME_hard.png, of those of the hard set.

    Raises BadConfig if a file cannot be written.
    """
    for name, pictures in figures.shown.items():
        found = figures["sets"][name]
        file = path if name == "test" else path.with_stem(f"{path.stem}_{name}")
        save_picture(_sheet(found, pictures, _title(found, name, figures["network"], len(pictures))), file)


def _title(found: Tree, name: str, network: str, shown: int) -> str:
    accuracy = "none" if found["accuracy"] is None else f"{100 * found['accuracy']:.1f} %"
    return (
        f"Network '{network}': the worst {shown} of {found['images']} {name} images, at most {VIEWS_A_BODY} of one "
        f"body in one posture or motion. Average per-class accuracy of all {found['images']}: {accuracy}"
    )


def _sheet(found: Tree, pictures: list[Picture], title: str) -> Image.Image:
    items = [
        _item(number, facts, picture)
        for number, (facts, picture) in enumerate(zip(found["worst"], pictures, strict=True), 1)
    ]
    rows = [items[start : start + _COLUMNS] for start in range(0, len(items), _COLUMNS)]
    item_width = len(_HEADS) * (_PANEL_WIDTH + _GAP)
    width = _COLUMNS * item_width + (_COLUMNS + 1) * _BETWEEN
    legend = _legend(found, width - 2 * _BETWEEN)
    heights = [max(item.height for item in row) + _GAP for row in rows]
    sheet = Image.new("RGB", (width, _TITLE + sum(heights) + legend.height + _BETWEEN), PAPER)
    pen = ImageDraw.Draw(sheet)
    pen.text((_BETWEEN, 10), title, INK, font=font(18))
    lefts = [_BETWEEN + column * (item_width + _BETWEEN) for column in range(_COLUMNS)]
    for left in lefts[: len(items)]:
        for index, head in enumerate(_HEADS):
            pen.text((left + index * (_PANEL_WIDTH + _GAP), 40), head, FAINT, font=font(14))
    top = _TITLE
    for row, height in zip(rows, heights, strict=True):
        for left, item in zip(lefts, row, strict=False):
            for line, (text, colour) in enumerate(zip(item.lines, (INK, INK, FAINT), strict=True)):
                pen.text((left, top + 1 + 17 * line), text, colour, font=font(14))
            for index, panel in enumerate(item.panels):
                sheet.paste(panel, (left + index * (_PANEL_WIDTH + _GAP), top + _CAPTION))
        top += height
    sheet.paste(legend, (_BETWEEN, top + _BETWEEN // 2))
    return sheet


def _item(number: int, facts: Tree, picture: Picture) -> _Item:
    causes = ", ".join(f"{_plain(name)} {100 * share:.0f} %" for name, share in facts["causes"].items())
    seen = f"{facts['distance_cm'] / 100:.2f} m, {facts['azimuth_deg']}°"
    drawn = [f"noise {facts['sigma_mm']:.0f} mm, {100 * facts['missing_rate']:.0f} % missing"]
    if facts["new_pose_deg"] is not None:
        drawn.append(f"{facts['new_pose_deg']:.0f}° from any training pose")
    who = f"{facts['subject']}, {_plain(facts['pose'])}"
    lines = (
        f"{number}. {who} ({seen}): accuracy {100 * facts['accuracy']:.0f} %",
        f"wrong pixels: {causes or 'none'}",
        "; ".join(drawn),
    )
    return _Item(lines, [fitted(panel, _PANEL_WIDTH, _PANEL_HEIGHT) for panel in _panels(picture)])


def _panels(picture: Picture) -> list[NDArray[np.uint8]]:
    body = picture.truth != BACKGROUND
    near, far = (int(edge) for edge in np.percentile(picture.range[body], (100 - _LONGEST_RANGE, _LONGEST_RANGE)))
    table = np.full((256, 3), _RIGHT, np.uint8)
    table[: len(NAMES)] = [_COLOURS[name] for name in NAMES]
    wrong = table[picture.causes]
    wrong[~body] = PAPER
    return [
        colour_range(picture.range, near, far),
        colour_labels(picture.truth, _EMPTY),
        colour_labels(picture.predicted, _EMPTY),
        wrong,
    ]


def _legend(found: Tree, width: int) -> Image.Image:
    """The colours of causes with their shares of all wrong pixels, and the 33 parts."""
    parts = draw_legend(width)
    shares = {cause["cause"]: cause["share_of_wrong"] for cause in found["causes"]}
    entries = [(_RIGHT, "right"), *((_COLOURS[name], f"{_plain(name)} {_share(shares[name])}") for name in NAMES)]
    each = width // (-(-len(entries) // 2))
    legend = Image.new("RGB", (width, 3 * _LINE + 10 + parts.height), PAPER)
    pen = ImageDraw.Draw(legend)
    pen.text((0, 10), "Cause, and its share of the wrong pixels of all images:", INK, font=font(14), anchor="lm")
    for index, (colour, text) in enumerate(entries):
        line, column = divmod(index, -(-len(entries) // 2))
        left, top = column * each, _LINE * (1 + line)
        pen.rectangle((left, top + 2, left + 15, top + 17), colour, FAINT)
        pen.text((left + 22, top + 10), text, INK, font=font(14), anchor="lm")
    legend.paste(parts, (0, 3 * _LINE + 10))
    return legend


def _plain(name: str) -> str:
    return name.replace("_", " ")


def _share(share: float | None) -> str:
    return "" if share is None else f"{100 * share:.1f} %"
