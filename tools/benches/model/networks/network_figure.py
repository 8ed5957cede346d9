"""Draws what `tools/bench network` measured: `--figure FILE.png`."""

from __future__ import annotations

from itertools import groupby
from pathlib import Path
from typing import Any, Final

from benches.charts.legends import legend_line
from benches.charts.scales import thousands
from bodyseg_data.drawing import new_chart, save_chart

Tree = dict[str, Any]

_MARKS: Final = (("#1f4fa8", "o"), ("#c25a00", "s"), ("#4d4d4d", "^"), ("#007a5e", "D"), ("#7b3294", "v"))
"""Colour and marker of one network after the other, the reference first."""

_REFERENCES: Final = (
    (1000 / 30, (0, (2, 2)), "33 ms: from frame to frame of the paper's sensor"),
    (61.0, (0, (6, 2)), "61 ms: the paper's network on its GPU"),
)
_TASKS: Final = {"scores": "forward to scores", "labels": "labels and confidence"}
_GRID: Final = "#e4e4e8"
_FAINT: Final = "#8a8a8a"


def draw_network(figures: Tree, path: Path) -> None:
    """Write a PNG of `bench_network`'s results: a row for each cell, a mark for each network, on a log scale.

    Raises MissingLibrary without matplotlib, BadConfig if the file cannot be written.
    """
    names = [figures["reference"], *(name for name in figures["networks"] if name != figures["reference"])]
    groups = [
        (key, list(rows)) for key, rows in groupby(figures["times"], key=lambda row: (row["frame"], row["device"]))
    ]
    figure = new_chart(12.5, 1.7 + 0.28 * len(figures["times"]) + 0.34 * len(groups))
    heights = [len(rows) + 1.2 for _, rows in groups]
    axes = figure.subplots(len(groups), 1, sharex=True, squeeze=False, height_ratios=heights)[:, 0]
    for axis, (_, rows) in zip(axes, groups, strict=True):
        _rows(axis, rows, names)
        axis.set_title(_group(rows[0], figures), loc="left", fontsize=10.5)
    _scale(axes)
    handles = [_handle(position, name, figures["networks"][name]) for position, name in enumerate(names)]
    handles += _reference_lines()
    figure.legend(handles=handles, loc="outside lower center", ncols=2, fontsize=10, frameon=False)
    head = f"times {names[0]}'s: {', '.join(names[1:])}   ({names[0]} itself)"
    axes[0].set_title(head, loc="right", fontsize=9, x=1.16)
    save_chart(figure, path, dpi=110)


def _rows(axis: Any, rows: list[Tree], names: list[str]) -> None:
    for position, row in enumerate(rows):
        axis.axhline(position, color=_GRID, linewidth=0.8, zorder=0)
        for number, name in enumerate(names):
            colour, marker = _MARKS[number % len(_MARKS)]
            found = row["networks"][name]
            axis.plot(found["quartiles"], [position, position], color=colour, linewidth=3, alpha=0.45, zorder=2)
            axis.plot(found["ms"], position, marker, color=colour, markersize=6.5, markeredgecolor="white", zorder=3)
        axis.text(1.01, position, _beside(row, names), transform=axis.get_yaxis_transform(), va="center", fontsize=9)
    axis.set_yticks(range(len(rows)), [_way(row) for row in rows], fontsize=9)
    axis.set_ylim(len(rows) - 0.4, -0.6)
    axis.tick_params(axis="y", length=0)
    axis.spines[["top", "right", "left"]].set_visible(False)


def _scale(axes: Any) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    last = axes[-1]
    last.set_xscale("log")
    low, high = last.get_xlim()
    last.set_xlim(min(low, 20), max(high, 80))
    last.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    last.xaxis.set_major_formatter(FuncFormatter(lambda value, _: thousands(value) if value >= 1 else f"{value:g}"))
    last.xaxis.set_minor_formatter(NullFormatter())
    last.set_xlabel("milliseconds a batch: median, and from quartile to quartile", fontsize=10)
    for axis in axes:
        for milliseconds, dashes, _ in _REFERENCES:
            axis.axvline(milliseconds, color=_FAINT, linewidth=0.9, linestyle=dashes, zorder=1)


def _group(row: Tree, figures: Tree) -> str:
    frame = figures["frames"][row["frame"]]
    size = f"{frame['rows']} × {frame['columns']}"
    where = figures["gpu"] if row["device"] == "cuda" else "Processor"
    if "median_body" not in frame:
        return f"{where}: {size} pixels, the body fills them"
    body = " × ".join(map(str, frame["median_body"]))
    return (
        f"{where}: {frame['count']} views of {size} pixels, bodies of typically {body}; scores of the body's rectangle"
    )


def _way(row: Tree) -> str:
    many = f", {row['together']} at once" if row["together"] > 1 else ""
    threads = "" if row["device"] == "cuda" else f", {row['threads']} thread{'s' if row['threads'] > 1 else ''}"
    return f"{_TASKS[row['task']]}{threads}, {row['precision']}{many}"


def _beside(row: Tree, names: list[str]) -> str:
    """Times of the others as multiples of the reference's, and the reference's frames a second."""
    times = ", ".join(f"{row['networks'][name]['times_as_long']:.3g} ×" for name in names[1:])
    return f"{times}   ({row['networks'][names[0]]['frames_per_second']:.3g} frames/s)"


def _handle(position: int, name: str, network: Tree) -> Any:
    colour, marker = _MARKS[position % len(_MARKS)]
    accuracy = network["accuracy_all"]
    right = "" if accuracy is None else f", {accuracy:.1%} per class on all"
    label = f"{name}: {network['parameters'] / 1e6:.3g} million parameters{right}"
    return legend_line(label, color=colour, marker=marker, linewidth=3, markersize=7)


def _reference_lines() -> list[Any]:
    return [legend_line(text, color=_FAINT, linewidth=0.9, linestyle=dashes) for _, dashes, text in _REFERENCES]
