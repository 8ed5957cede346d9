"""Draws one choice: every method as a point, the front as a step line, the default as a star; readable in grey."""

from __future__ import annotations

import itertools
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from benches.charts.choice import Choice, Panel
from benches.charts.fronts import Point, front, shortfalls
from benches.charts.labels import Label, place_labels
from benches.charts.legends import legend_line, legend_mark
from benches.charts.scales import axis_title, scale_of
from bodyseg_data.drawing import new_chart
from bodyseg_data.drawing.style import chart_bytes

FRONT: Final = "#0072B2"  # this and the next by M. Okabe and K. Ito, distinct to the colour-blind and in grey
DEFAULT: Final = "#E69F00"
BEATEN: Final = "#8c8c8c"
_BEHIND: Final = "#f2f2ef"  # where everything is beaten
_LIMIT: Final = "#555555"
_MARKERS: Final = ("o", "s", "^", "D", "v", "P", "X", "p")

DPI: Final = 120
_SMALL: Final = 7.0
_LETTERS_AN_INCH: Final = 19.0  # of small print
_LEGEND_LINE_IN: Final = 0.24
_PRINT_LINE_IN: Final = 0.15
_TOP_IN: Final = 0.72
_LEADER_FROM: Final = 10.0  # pixels between a marker and its name
_LIMIT_NAME_HEIGHTS: Final = (0.95, 0.85, 0.7, 0.55, 0.4, 0.25)  # where beside its line
_INSET: Final = 4.0  # pixels between names and the edge

Source = dict[str, str]
"""Command, commit and hardware of a measurement."""


@dataclass(frozen=True)
class Picture:
    """A drawn chart: the bytes of both files."""

    svg: bytes
    png: bytes


def draw(choice: Choice, panels: Sequence[Panel], sources: Sequence[Source]) -> Picture:
    """Draw a choice. The same panels and sources give the same bytes. Raises MissingLibrary without matplotlib."""
    figure = chart(choice, panels, sources)
    return Picture(chart_bytes(figure, "svg", DPI), chart_bytes(figure, "png", DPI))


def chart(choice: Choice, panels: Sequence[Panel], sources: Sequence[Source]) -> Any:
    """The figure of matplotlib that `draw` writes, with one axes a panel."""
    rows = -(-len(panels) // 2)
    columns = -(-len(panels) // rows)
    width = 12.5 if columns > 1 else 9.0
    families = list(dict.fromkeys(point.family for panel in panels for point in panel.points))
    markers = dict(zip(families, _MARKERS * len(families), strict=False))
    figure = new_chart(width, 1.2 + (5.6 if rows == 1 else 4.4 * rows))
    import matplotlib

    with matplotlib.rc_context({"text.parse_math": False}):  # a dollar in a name is a dollar
        axes = figure.subplots(rows, columns, squeeze=False).ravel()
        for axis in axes[len(panels) :]:
            axis.set_axis_off()
        _dress(figure, choice, sources, markers, any(panel.limits for panel in panels))
        for number, (axis, panel) in enumerate(zip(axes, panels, strict=False)):
            _divide(axis, choice, panel, panels)
            _panel(axis, choice, panel, markers)
            axis.set_title(_headline(choice, panel, width / columns), loc="left", fontsize=10)
            if number >= len(panels) - columns:
                axis.set_xlabel(axis_title(choice.x), fontsize=10)
            if number % columns == 0:
                axis.set_ylabel(axis_title(choice.y, "\n"), fontsize=10)
            _behind(axis, choice, panel)
        figure.draw_without_rendering()
        figure.set_layout_engine("none")  # names are placed for axes that move no more
        for axis, panel in zip(axes, panels, strict=False):
            # The layout's solver adds up in the order of addresses: its last digits differ from run to run.
            axis.set_position([round(side, 9) for side in axis.get_position().bounds])
            _name(figure, axis, choice, panel)
    return figure


def _divide(axis: Any, choice: Choice, panel: Panel, panels: Sequence[Panel]) -> None:
    """Scales for a panel alone, or for all where these share them."""
    beside = panels if "x" in choice.shared else [panel]
    points, limits = ([each for one in beside for each in getattr(one, kind)] for kind in ("points", "limits"))
    scale_of([*(point.x for point in points), *(limit.x for limit in limits)], choice.x).apply(axis, "x")
    beside = panels if "y" in choice.shared else [panel]
    heights = [point.y + side for one in beside for point in one.points for side in _bars(point)]
    scale_of(heights, choice.y).apply(axis, "y")


def _dress(figure: Any, choice: Choice, sources: Sequence[Source], markers: dict[str, str], limits: bool) -> None:
    """Title, note, legend and small print, around the room that is left to the panels."""
    width, height = figure.get_size_inches()
    letters = int(width * _LETTERS_AN_INCH)
    words = (f"{one['command']}   ·   commit {one['commit']}   ·   {one['hardware']}" for one in sources)
    small = "\n".join(textwrap.fill(line, letters, break_long_words=False, break_on_hyphens=False) for line in words)
    handles, columns = _legend(markers, limits), 3 if width < 10 else 5
    print_in = _PRINT_LINE_IN * (small.count("\n") + 1) + 0.08
    below_in = print_in + _LEGEND_LINE_IN * -(-len(handles) // columns) + 0.05
    left = 0.12 / width
    figure.text(left, 1 - 0.10 / height, choice.title, fontsize=14, weight="bold", va="top")
    figure.text(left, 1 - 0.40 / height, choice.note, fontsize=9.5, color="#333333", va="top")
    figure.text(left, 0.06 / height, small, fontsize=_SMALL, color="#444444", va="bottom")
    figure.legend(
        handles=handles,
        loc="lower left",
        bbox_to_anchor=(left, print_in / height),
        ncols=columns,
        fontsize=9,
        frameon=False,
        borderpad=0,
        borderaxespad=0,
        handletextpad=0.3,
        columnspacing=1.6,
    )
    figure.get_layout_engine().set(rect=(0, below_in / height, 0.985, 1 - (below_in + _TOP_IN) / height))


def _legend(markers: dict[str, str], limits: bool) -> list[Any]:
    plain = next(iter(markers.values()))
    found = [
        legend_mark("the default", "*", DEFAULT, "black", 15),
        legend_mark("on the front: nothing is better in both", plain, FRONT, "black", 8),
        legend_mark("beaten in both, or in one at a draw", plain, "none", BEATEN, 6),
    ]
    if limits:
        found.append(legend_line("a limit, not another way", color=_LIMIT, linestyle="--"))
    if len(markers) > 1:
        found += [legend_mark(family, marker, "#d8d8d8", "black", 7) for family, marker in markers.items()]
    return found


def _headline(choice: Choice, panel: Panel, width_in: float) -> str:
    """The panel's name, and whether its default is on the front."""
    default = next((point for point in panel.points if point.name == panel.default), None)
    if default is None:
        return panel.name
    falls = shortfalls(default, panel.points, choice.x, choice.y)
    verdict = "the default is on the front"
    if falls:
        shares = ((choice.x.noun, falls[0].x_share), (choice.y.noun, falls[0].y_share))
        gains = ", ".join(f"{noun} {share:.0%} better" for noun, share in shares).replace("%", " %")
        better = falls[0].better
        chance = abs(better.y - default.y) < np.hypot(better.y_sd or 0, default.y_sd or 0)
        name = better.label.replace("\n", " ")
        verdict = f"the default is beaten by {name!r}: {gains}{', within the spread' if chance else ''}"
    return textwrap.fill(f"{panel.name}: {verdict}", int(width_in * 11))


def _panel(axis: Any, choice: Choice, panel: Panel, markers: dict[str, str]) -> None:
    """Draw points, error bars and limits."""
    best = {point.name for point in front(panel.points, choice.x, choice.y)}
    for point in panel.points:
        x, y = _position(choice, point)
        if point.y_sd is not None:
            ends = [(point.y + side) * choice.y.factor for side in _bars(point)]
            axis.plot([x, x], ends, color=BEATEN, linewidth=1, marker="_", markersize=6, zorder=2)
        look: dict[str, Any] = {"s": 30, "facecolors": "none", "edgecolors": BEATEN, "linewidths": 1.0, "zorder": 3}
        if point.name in best:
            look = {"s": 62, "facecolors": FRONT, "edgecolors": "black", "linewidths": 0.8, "zorder": 4}
        marker = markers[point.family]
        if point.name == panel.default:
            marker = "*"
            look = {"s": 380, "facecolors": DEFAULT, "edgecolors": "black", "linewidths": 1.1, "zorder": 5}
        axis.scatter(x, y, marker=marker, **look)
    for limit in panel.limits:
        axis.axvline(limit.x * choice.x.factor, color=_LIMIT, linewidth=1.1, linestyle="--", zorder=1.5)
    axis.grid(color="#dededb", linewidth=0.6)
    axis.set_axisbelow(True)
    axis.spines[["top", "right"]].set_visible(False)


def _steps(choice: Choice, panel: Panel, x_ends: tuple[float, float], y_ends: tuple[float, float]) -> Any:
    """Corners [N, 2] of the front's line, from the best x to the worst: what can be had at each x."""
    best = sorted(_position(choice, point) for point in front(panel.points, choice.x, choice.y))
    if choice.x.more_is_better:
        best.reverse()
    corners = [(best[0][0], y_ends[1] if not choice.y.more_is_better else y_ends[0])]
    for x, y in best:
        corners += [(x, corners[-1][1]), (x, y)]
    corners.append((x_ends[0] if choice.x.more_is_better else x_ends[1], corners[-1][1]))
    return np.array(corners)


def _behind(axis: Any, choice: Choice, panel: Panel) -> None:
    """Draw the front's line, and a shade over all that it beats."""
    line = _steps(choice, panel, axis.get_xlim(), axis.get_ylim())
    axis.plot(*line.T, color="black", linewidth=1.1, zorder=2, scalex=False, scaley=False)
    axis.fill(*np.vstack([line, (line[-1, 0], line[0, 1])]).T, color=_BEHIND, linewidth=0, zorder=0)


def _name(figure: Any, axis: Any, choice: Choice, panel: Panel) -> None:
    """Write names beside the default, the front, the named baselines and the limits."""
    best = {point.name for point in front(panel.points, choice.x, choice.y)}
    wanted = [point for point in panel.points if point.named or point.name in best or point.name == panel.default]
    wanted.sort(key=lambda point: (point.name != panel.default, point.name not in best))
    heights = axis.transAxes.transform([(0, height) for height in _LIMIT_NAME_HEIGHTS])[:, 1]
    pixels = axis.transData.transform
    texts, anchors, radii = [], [], []
    for point in wanted:
        is_default = point.name == panel.default
        look: dict[str, Any] = {"color": "black" if is_default or point.name in best else "#555555"}
        if is_default:
            look["weight"] = "bold"
        texts.append(axis.text(0, 0, point.label, fontsize=9, zorder=6, **look))
        anchors.append(pixels([_position(choice, point)]))
        radii.append(_radius(point, panel, best))
    for limit in panel.limits:
        x = pixels((limit.x * choice.x.factor, axis.get_ylim()[0]))[0]
        texts.append(axis.text(0, 0, limit.label, fontsize=9, zorder=6, color=_LIMIT, style="italic"))
        anchors.append(np.array([(x, height) for height in heights]))
        radii.append(1.0)
    renderer = figure.canvas.get_renderer()
    sizes = [np.array(text.get_window_extent(renderer).size) for text in texts]
    dots = np.array([(*pixels(_position(choice, one)), _radius(one, panel, best)) for one in panel.points])
    area = np.array(axis.get_window_extent(renderer).extents) + _INSET * np.array([1, 1, -1, -1])
    labels = [Label(*each) for each in zip(sizes, anchors, radii, strict=True)]
    for text, label, found in zip(texts, labels, place_labels(labels, dots, _along(axis), area), strict=True):
        text.set_position(axis.transData.inverted().transform(found.corner))
        text.set_verticalalignment("bottom")
        if np.hypot(*(found.nearest - found.anchor)) > label.radius + _LEADER_FROM:
            ends = axis.transData.inverted().transform([found.anchor, found.nearest])
            axis.plot(*ends.T, color="#777777", linewidth=0.6, zorder=2.5, scalex=False, scaley=False)


def _radius(point: Point, panel: Panel, best: set[str]) -> float:
    """Radius of a point's marker, pixels."""
    return 14.0 if point.name == panel.default else 6.0 if point.name in best else 4.0


def _along(axis: Any) -> Any:
    """Points [K, 2] along all lines of an axes, pixels, close enough for no name to slip between."""
    points = [np.empty((0, 2))]
    for line in axis.lines:
        ends = line.get_transform().transform(np.array(line.get_xydata()))
        for start, stop in itertools.pairwise(ends):
            points.append(np.linspace(start, stop, 2 + int(np.hypot(*(stop - start)) / 4)))
    return np.concatenate(points)


def _position(choice: Choice, point: Point) -> tuple[float, float]:
    return point.x * choice.x.factor, point.y * choice.y.factor


def _bars(point: Point) -> tuple[float, ...]:
    """Heights above and below a point between which its error bar is drawn."""
    return (0.0,) if point.y_sd is None else (-min(point.y_sd, point.y), point.y_sd)
