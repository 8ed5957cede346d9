"""Shared style of all pictures: colours, font, the legend of the parts, and writing PNG and SVG files."""

import functools
import io
import unicodedata
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from bodyseg_data.core import BadConfig
from bodyseg_data.files import write_result
from bodyseg_data.labels import PARTS33, LabelMap
from bodyseg_data.machine import required

PAPER: Final = (250, 250, 247)
INK: Final = (32, 34, 40)
FAINT: Final = (110, 112, 118)
THING: Final = (112, 116, 124)
"""Colour of pixels that see a thing, which has no label."""

EMPTY: Final = (24, 26, 32)
"""Colour of pixels without a range."""

font: Final = functools.cache(ImageFont.load_default)
"""Pillow's built-in font in a size in pixels, so that pictures look the same on every machine."""

_COLUMN: Final = 222  # fits the longest name
_LINE: Final = 21


def draw_legend(width: int, label_map: LabelMap = PARTS33) -> Image.Image:
    """Draw the legend of the classes (colour, number, name) in columns that fit `width` pixels; long names are cut."""
    columns = max(1, width // _COLUMN)
    lines = -(-len(label_map) // columns)
    columns = -(-len(label_map) // lines)
    legend = Image.new("RGB", (width, lines * _LINE), PAPER)
    pen = ImageDraw.Draw(legend)
    end = 38 if len(label_map) <= 100 else 46  # right end of the numbers, which have two digits or three
    for label, (name, colour) in enumerate(zip(label_map.names, label_map.colours.tolist(), strict=True)):
        column, line = divmod(label, lines)
        left, top = column * width // columns, line * _LINE
        pen.rounded_rectangle((left, top + 2, left + 15, top + 17), 3, tuple(colour))
        pen.text((left + end, top + 10), str(label), INK, font=font(13), anchor="rm")
        pen.text((left + end + 8, top + 10), _cut(name, width // columns - end - 12), INK, font=font(13), anchor="lm")
    return legend


def _cut(name: str, width: int) -> str:
    """As much of a name, in size 13, as fits into `width` pixels, with dots for the rest; the font has no accents."""
    plain = "".join(each for each in unicodedata.normalize("NFKD", name) if not unicodedata.combining(each))
    cut, dots = plain[:width], "..." * (len(plain) > width)  # letters are wider than a pixel
    while cut and font(13).getlength(cut + dots) > width:
        cut, dots = cut[:-1], "..."
    return cut + dots


def fitted(panel: NDArray[np.uint8], columns: int, rows: int) -> Image.Image:
    """Scale a panel, sRGB uint8 [H, W, 3], to a width or a height by picking pixels: means would hide missing ones."""
    height, width = panel.shape[:2]
    scale = min(rows / height, columns / width)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    return Image.fromarray(panel).resize(size, Image.Resampling.NEAREST)


def colour_shares(shares: NDArray[Any], ramp: NDArray[Any]) -> NDArray[np.uint8]:
    """Colour shares [H, W], 0 to 1, by the colours of a ramp [N, 3], evenly apart; sRGB uint8 [H, W, 3]."""
    position = np.clip(shares, 0, 1) * (len(ramp) - 1)
    colours = np.stack([np.interp(position, np.arange(len(ramp)), channel) for channel in ramp.T], axis=-1)
    drawn: NDArray[np.uint8] = np.rint(colours).astype(np.uint8)
    return drawn


def check_picture(path: Path, option: str = "--out") -> None:
    """Raise BadConfig, naming `option`, unless `path` ends in .png."""
    if path.suffix.lower() != ".png":
        raise BadConfig(f"{option} must be a .png file, found {path}")


def save_picture(picture: Image.Image, path: Path) -> None:
    """Write a picture as PNG, atomically. Raises BadConfig if it cannot be written."""
    buffer = io.BytesIO()
    picture.save(buffer, "PNG")
    write_result(path, buffer.getvalue())


def new_chart(width: float, height: float) -> Any:
    """Open an empty matplotlib figure, size in inches, without a display. Raises MissingLibrary without matplotlib."""
    figure = required("matplotlib.figure", "a chart", "train").Figure(figsize=(width, height), layout="constrained")
    required("matplotlib.backends.backend_agg", "a chart", "train").FigureCanvasAgg(figure)
    return figure


def plain_axes(axis: Any, grid: Literal["x", "y", "both"] = "y") -> None:
    """Draw a matplotlib axis with a pale grid behind what it shows, and no frame above and at the right."""
    axis.grid(axis=grid, color="#e2e2e2", linewidth=0.6)
    axis.set_axisbelow(True)
    axis.spines[["top", "right"]].set_visible(False)


def chart_bytes(figure: Any, kind: Literal["png", "svg"], dpi: int) -> bytes:
    """Encode a matplotlib figure as PNG or SVG; equal figures give equal bytes under one version of matplotlib."""
    import matplotlib

    if figure.get_layout_engine() is not None:  # with one, savefig would draw everything twice
        figure.set_dpi(dpi)
        figure.get_layout_engine().execute(figure)
        figure.set_layout_engine(None)
    buffer = io.BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": "bodyseg", "svg.fonttype": "path"}):
        figure.savefig(buffer, format=kind, dpi=dpi, metadata={"Date": None} if kind == "svg" else None)
    return buffer.getvalue()


def save_chart(figure: Any, path: Path, dpi: int) -> None:
    """Write a matplotlib figure as PNG, atomically. Raises BadConfig if it cannot be written."""
    write_result(path, chart_bytes(figure, "png", dpi))
