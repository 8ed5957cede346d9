"""Draws what `bench real` measured: `--figure FILE.png`."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
from PIL import Image, ImageDraw

from benches.measuring import Figures
from benches.model.real.bench import Shown
from bodyseg_data.drawing import FAINT, INK, PAPER, draw_legend, font, save_picture
from bodyseg_model.segmentation import draw_overlay

_HEADS: Final = ("true labels", "network")
_MARGIN: Final = 14
_TITLE: Final = 40
_CAPTION: Final = 22


def draw_real(figures: Figures, path: Path) -> None:
    """Write a PNG of some frames: true labels beside the network's, and below them the parts' colours.

    Grey: the person where no label is certain. Raises BadConfig if the file cannot be written.
    """
    panels = [_pair(shown) for shown in figures.shown]
    width, height = (max(pair[0].size[axis] for pair in panels) for axis in (0, 1))
    columns = min(2, len(panels))
    lines = -(-len(panels) // columns)
    cell = 2 * width + 2 * _MARGIN, height + _CAPTION + _MARGIN
    legend = draw_legend(columns * cell[0])
    size = columns * cell[0] + 2 * _MARGIN, _TITLE + lines * cell[1] + legend.height + 2 * _MARGIN
    picture = Image.new("RGB", size, PAPER)
    draw = ImageDraw.Draw(picture)
    draw.text((_MARGIN, 12), _title(figures), INK, font=font(15))
    for number, pair in enumerate(panels):
        line, column = divmod(number, columns)
        left, top = _MARGIN + column * cell[0], _TITLE + line * cell[1]
        for place, (head, image) in enumerate(zip(_HEADS, pair, strict=True)):
            x = left + place * (width + _MARGIN // 2)
            draw.text(
                (x + 4, top + 2),
                f"frame {figures.shown[number].frame.name.lstrip('0') or '0'}: {head}",
                FAINT,
                font=font(12),
            )
            picture.paste(image, (x, top + _CAPTION))
    picture.paste(legend, (_MARGIN, size[1] - legend.height - _MARGIN))
    save_picture(picture, path)


def _title(figures: Figures) -> str:
    scores = figures["scores"]
    gross = _percent((scores["gross_errors"] or {}).get("beyond_30_mm"))
    return (
        f"{figures['network']}: average per-class accuracy {_percent(scores['accuracy'])} on {len(scores['parts'])} "
        f"parts, pixels right {_percent(scores['pixel_accuracy'])}, gross errors {gross}, agreement of frames "
        f"{_percent(figures['agreement']['same'])}"
    )


def _percent(share: float | None) -> str:
    return "unknown" if share is None else f"{100 * share:.1f} %"


def _pair(shown: Shown) -> tuple[Image.Image, Image.Image]:
    """The person with true labels and with the network's, where these exist."""
    frame = shown.frame
    rows, columns = np.divmod(frame.pixels, frame.range_m.shape[1])
    box = slice(int(rows.min()), int(rows.max()) + 1), slice(int(columns.min()), int(columns.max()) + 1)
    person = np.zeros(frame.range_m.shape, np.float32)
    person.ravel()[frame.pixels] = frame.range_m.ravel()[frame.pixels]
    pictures = [draw_overlay(person, labels, [frame.pixels])[box] for labels in (shown.truth, shown.answer)]
    return Image.fromarray(pictures[0]), Image.fromarray(pictures[1])
