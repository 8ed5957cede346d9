"""Draws what `tools/bench variants` measured: `--figure FILE.png`, and beside it real frames as networks label them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from PIL import Image, ImageDraw

from benches.charts.legends import legend_line
from benches.charts.scales import thousands
from benches.measuring import Figures
from benches.model.variants.real import Shown
from bodyseg_data.artifacts import VARIANTS
from bodyseg_data.drawing import (
    FAINT,
    INK,
    PAPER,
    draw_legend,
    fitted,
    font,
    new_chart,
    plain_axes,
    save_chart,
    save_picture,
)
from bodyseg_model.segmentation import draw_overlay

Tree = dict[str, Any]


class _Style(NamedTuple):
    colour: str
    dashes: Any
    marker: str
    width: float


_STYLES: Final = {
    "none": _Style("#000000", "-", "o", 1.5),
    "occ": _Style("#d98e00", (0, (6, 2)), "s", 1.5),
    "noise": _Style("#4aa3da", (0, (1.2, 1.6)), "^", 1.8),
    "md": _Style("#00785a", (0, (6, 2, 1.2, 2)), "D", 1.5),
    "all": _Style("#b8360f", "-", "*", 2.4),
}
"""Training variant -> its curve. Hues that the colour-blind can tell apart (after Okabe and Ito), and dashes and
markers for those who print in grey.
"""

_PANELS: Final = {
    "noise": ("sigma of the noise, mm", 1, "Noise, other artifacts as in all (the paper's Fig. 7)"),
    "missing": ("missing pixels, %", 100, "Missing data, other artifacts as in all (its Fig. 8)"),
    "grain": ("side of squares of equal noise, pixels", 1, "Noise of 40 mm in squares, nothing else"),
}
"""Sweep -> axis, what strengths are multiplied by, title."""


_GAP: Final = 6
_HEAD: Final = 22  # of a panel's title
_SIDE: Final = 170  # longest side of a panel, pixels: the frames' licence allows small pictures


def draw_variants(figures: Figures, path: Path) -> None:
    """Write a PNG of `bench_variants`'s results: a panel for each sweep, a curve for each variant, and the table of
    test sets; and, if there are real frames, one beside it, NAME_real.png, of some of them (Fig. 9).

    Bands are one standard deviation over seeds. Raises MissingLibrary without matplotlib, BadConfig if a file cannot
    be written.
    """
    figure = new_chart(20, 5.5)
    grid = figure.add_gridspec(1, 4, width_ratios=(1, 1, 0.8, 1.08))
    lowest = min(value for sweep in figures["sweeps"].values() for c in sweep["curves"].values() for value in c["mean"])
    for position, (name, sweep) in enumerate(figures["sweeps"].items()):
        axis = figure.add_subplot(grid[position])
        _sweep(axis, name, sweep)
        axis.set_ylim(max(0.0, 0.1 * (10 * lowest // 1)), 1)
        if position == 0:
            axis.set_ylabel("average per-class accuracy", fontsize=10)
    _table(figure.add_subplot(grid[3]), figures["table"])
    names = [name for name in _STYLES if name in figures["table"]]
    handles = [legend_line(f"trained on {name}", **_drawn(name)) for name in names]
    figure.legend(handles=handles, loc="outside lower center", ncols=5, fontsize=10.5, handlelength=4.5, frameon=False)
    figure.suptitle(_scale(figures["scale"]), x=0.005, ha="left", fontsize=10.5)
    save_chart(figure, path, dpi=110)
    if figures.shown:
        save_picture(_real_frames(figures.shown), path.with_stem(f"{path.stem}_real"))


def _real_frames(shown: Sequence[Shown]) -> Image.Image:
    """A line a frame, a panel a network, true labels first where they are known; below them the parts' colours."""
    heads = ["true labels", *(name for name in _STYLES if any(name in each.labels for each in shown))]
    lines = [[_panel(each, head) for head in heads] for each in shown]
    legend = draw_legend(len(heads) * (_SIDE + _GAP))
    heights = [max(panel.height for panel in line) + _HEAD for line in lines]
    picture = Image.new("RGB", (legend.width + 2 * _GAP, _HEAD + sum(heights) + legend.height + 3 * _GAP), PAPER)
    pen, top = ImageDraw.Draw(picture), _HEAD + _GAP
    for column, head in enumerate(heads):
        text = head if head not in _STYLES else f"trained on {head}"
        pen.text((_GAP + column * (_SIDE + _GAP), _GAP), text, INK, font=font(13))
    for each, line, height in zip(shown, lines, heights, strict=True):
        pen.text((_GAP, top), each.title, FAINT, font=font(12))
        for column, panel in enumerate(line):
            picture.paste(panel, (_GAP + column * (_SIDE + _GAP), top + _HEAD))
        top += height
    picture.paste(legend, (_GAP, top + _GAP))
    return picture


def _panel(shown: Shown, head: str) -> Image.Image:
    """The person with the labels of `head`; empty where there are none."""
    frame = shown.frame
    rows, columns = np.divmod(frame.pixels, frame.range_m.shape[1])
    box = np.s_[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    if head not in shown.labels:
        empty = Image.new("RGB", (_SIDE, _HEAD), PAPER)
        ImageDraw.Draw(empty).text((0, 2), "not known", FAINT, font=font(12))
        return empty
    panel = draw_overlay(frame.range_m, shown.labels[head], [frame.pixels])
    panel[frame.range_m == 0] = PAPER
    return fitted(panel[box], _SIDE, _SIDE)


def _drawn(name: str) -> dict[str, Any]:
    style = _STYLES[name]
    size = 10 if style.marker == "*" else 5.5
    return {
        "color": style.colour,
        "linestyle": style.dashes,
        "linewidth": style.width,
        "marker": style.marker,
        "markersize": size,
        "markeredgecolor": "white",
        "markeredgewidth": 0.6,
    }


def _sweep(axis: Any, name: str, sweep: Tree) -> None:
    label, factor, title = _PANELS[name]
    strengths = [factor * strength for strength in sweep["strengths"]]
    for order, (variant, curve) in enumerate(sweep["curves"].items()):
        if None not in curve["sd"]:
            edges = [[mean + way * sd for mean, sd in zip(curve["mean"], curve["sd"], strict=True)] for way in (-1, 1)]
            axis.fill_between(strengths, *edges, color=_STYLES[variant].colour, alpha=0.16, linewidth=0)
        axis.plot(strengths, curve["mean"], zorder=3 + order, **_drawn(variant))
    if strengths[0] > 0:
        axis.set_xscale("log", base=2)
    axis.set_xticks(strengths, [f"{strength:g}" for strength in strengths], fontsize=9)
    axis.yaxis.set_major_formatter(lambda value, _: f"{100 * value:.0f} %")
    axis.set_xlabel(label, fontsize=10)
    axis.set_title(title, loc="left", fontsize=11)
    plain_axes(axis)


def _table(axis: Any, table: Tree) -> None:
    """Training variant by test variant; the darker a cell, the better; the best of a column is bold."""
    names, tests = list(table), list(VARIANTS)
    means = [[table[train][test]["mean"] for test in tests] for train in names]
    lowest, highest = min(map(min, means)), max(map(max, means))
    axis.imshow(means, cmap="Blues", vmin=lowest - 0.15 * (highest - lowest), vmax=highest, aspect="auto")
    best = [max(row[column] for row in means) for column in range(len(tests))]
    for row, train in enumerate(names):
        for column, test in enumerate(tests):
            cell = table[train][test]
            spread = "" if cell["sd"] is None else f"\n± {100 * cell['sd']:.1f}"
            dark = cell["mean"] - lowest > 0.55 * (highest - lowest)
            axis.text(
                column, row, f"{100 * cell['mean']:.1f}{spread}", ha="center", va="center", fontsize=10.5,
                color="white" if dark else "black", fontweight="bold" if cell["mean"] == best[column] else "normal",
            )  # fmt: skip
    axis.set_xticks(range(len(tests)), tests, fontsize=10)
    axis.set_yticks(range(len(names)), names, fontsize=10)
    axis.set_xlabel("tested on", fontsize=10)
    axis.set_ylabel("trained on", fontsize=10)
    axis.tick_params(length=0)
    axis.spines[:].set_visible(False)
    axis.set_title("Average per-class accuracy, %; bold: best of the column", loc="left", fontsize=11)


def _scale(scale: Tree) -> str:
    seeds = f"{scale['seeds']} seeds (lines: mean, bands: ± 1 standard deviation)" if scale["seeds"] > 1 else "1 seed"
    rows, columns = scale["image"]
    steps, batch, views = scale["steps"], scale["images_a_step"], scale["train_images"]
    return (
        f"{seeds}; {thousands(steps)} steps of {batch} images ({thousands(steps * batch)} images of "
        f"{thousands(views)} views); {thousands(scale['test_images'])} test images of {rows} × {columns} pixels"
    )
