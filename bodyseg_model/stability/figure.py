"""Figure of stability.json: a panel for each sweep, a line for each group of networks."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final, NamedTuple

from bodyseg_data.drawing.style import new_chart, save_chart

Tree = dict[str, Any]


class _Style(NamedTuple):
    colour: str
    dashes: Any
    marker: str


_STYLES: Final = {
    "none": _Style("#000000", "-", "o"),
    "occ": _Style("#d98e00", (0, (6, 2)), "s"),
    "noise": _Style("#4aa3da", (0, (1.2, 1.6)), "^"),
    "md": _Style("#00785a", (0, (6, 2, 1.2, 2)), "D"),
    "all": _Style("#b8360f", "-", "*"),
}
"""Training variant -> line of its first group, as in the figure of `tools/bench variants`."""

_SPARE: Final = (
    _Style("#8a5aa3", (0, (4, 1.5)), "v"),
    _Style("#6b6b6b", (0, (2, 2)), "P"),
    _Style("#9a6a3a", (0, (8, 2)), "X"),
    _Style("#c9619a", (0, (3, 1.2, 1, 1.2)), "<"),
    _Style("#2f4b9a", (0, (1, 1)), ">"),
    _Style("#4aa3da", "-", "p"),
    _Style("#00785a", (0, (1.2, 1.6)), "h"),
    _Style("#d98e00", (0, (3, 1.2, 1, 1.2)), "d"),
    _Style("#000000", (0, (8, 2)), "^"),
    _Style("#8a5aa3", (0, (1, 1)), "s"),
    _Style("#6b6b6b", "-", "o"),
    _Style("#9a6a3a", (0, (1.2, 1.6)), "D"),
)
"""Lines of further groups; where a colour is repeated, the marker differs."""

_COLUMNS: Final = 4
_WIDTH: Final = 16.0
_MOST_IN_A_ROW: Final = 6


def draw_stability(figures: Tree, path: Path) -> None:
    """Write a PNG of what `summarise` returned. Bands are one standard deviation over seeds.

    Raises MissingLibrary without matplotlib, BadConfig if the file cannot be written.
    """
    sweeps, groups = figures["sweeps"], figures["groups"]
    rows = -(-len(sweeps) // _COLUMNS)
    styles = _styles(groups)
    handles = [_handle(label, group, styles[label]) for label, group in groups.items()]
    in_a_row = _fitting(handles)
    legend_rows = -(-len(handles) // in_a_row)
    figure = new_chart(_WIDTH, 0.9 + 0.3 * legend_rows + 3.0 * rows)
    axes = figure.subplots(rows, _COLUMNS, sharey=True, squeeze=False)
    for axis in axes.flat[len(sweeps) :]:
        axis.set_visible(False)
    for index, (name, sweep) in enumerate(sweeps.items()):
        axis = axes.flat[index]
        _panel(axis, sweep, figures["bound"])
        for order, (label, group) in enumerate(groups.items()):
            _line(axis, sweep["strengths"], group["curves"][name], styles[label], 3 + order)
        if index % _COLUMNS == 0:
            axis.set_ylabel("average per-class accuracy", fontsize=10)
    figure.legend(
        handles=handles, loc="outside lower center", ncols=in_a_row, fontsize=10.5, handlelength=4.5, frameon=False,
    )  # fmt: skip
    figure.suptitle(_title(figures), x=0.005, ha="left", fontsize=11)
    save_chart(figure, path, dpi=100)


def _styles(groups: Tree) -> dict[str, _Style]:
    styles: dict[str, _Style] = {}
    spare = 0
    for label, group in groups.items():
        style = _STYLES.get(group["variant"])
        if style is None or style in styles.values():
            style = _SPARE[spare % len(_SPARE)]
            spare += 1
        styles[label] = style
    return styles


def _panel(axis: Any, sweep: Tree, bound: float) -> None:
    strengths = sweep["strengths"]
    axis.axhline(bound, color="#8a8a8a", linewidth=0.9, linestyle=(0, (6, 2)), zorder=1)
    axis.set_ylim(0, 1)
    axis.set_xticks(strengths, [f"{strength:g}" for strength in strengths], fontsize=9)
    if strengths[-1] < strengths[0]:
        axis.invert_xaxis()  # severity rises to the right
    axis.yaxis.set_major_formatter(lambda value, _: f"{100 * value:.0f} %")
    axis.set_xlabel(sweep["axis"], fontsize=9.5)
    # In two lines: longer titles would run into the next panel's.
    axis.set_title(sweep["title"] + ("" if sweep["counts"] else "\n(not in mCE, mRR)"), loc="left", fontsize=10.5)
    axis.grid(axis="y", color="#e2e2e2", linewidth=0.6)
    axis.set_axisbelow(True)
    axis.spines[["top", "right"]].set_visible(False)


def _line(axis: Any, strengths: list[float], curve: Tree, style: _Style, order: int) -> None:
    if None not in curve["sd"]:
        edges = [[mean + sign * sd for mean, sd in zip(curve["mean"], curve["sd"], strict=True)] for sign in (-1, 1)]
        axis.fill_between(strengths, *edges, color=style.colour, alpha=0.15, linewidth=0)
    axis.plot(strengths, curve["mean"], zorder=order, **_drawn(style))


def _drawn(style: _Style) -> Tree:
    return {
        "color": style.colour,
        "linestyle": style.dashes,
        "linewidth": 1.6,
        "marker": style.marker,
        "markersize": 9 if style.marker == "*" else 5,
        "markeredgecolor": "white",
        "markeredgewidth": 0.5,
    }


def _handle(label: str, group: Tree, style: _Style) -> Any:
    from matplotlib.lines import Line2D

    count = len(group["seeds"])
    return Line2D([], [], label=f"{label}: {count} seed{'' if count == 1 else 's'}", **_drawn(style))


def _fitting(handles: list[Any]) -> int:
    """Number of legend entries that fit side by side, in columns as wide as the longest entry."""
    inches = 1.0 + 0.085 * max(len(handle.get_label()) for handle in handles)
    return max(1, min(_MOST_IN_A_ROW, len(handles), int(_WIDTH / inches)))


def _title(figures: Tree) -> str:
    return (
        f"{figures['images']} test images at every strength; one thing changes in each panel, all else is clean. "
        f"Lines: mean over seeds, bands: ± 1 standard deviation; dashed grey: {100 * figures['bound']:.0f} %"
    )
