"""Draws what `bench rooms` measured: `--figure FILE.png`."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from benches.measuring import Figures
from benches.model.rooms.real import ROOM
from bodyseg_data.drawing import new_chart, save_chart

_COLUMNS: Final = 5
_COLOURS: Final = {"precision": "#c25a00", "recall": "#1f4fa8"}


def draw_rooms(figures: Figures, path: Path) -> None:
    """Write a PNG of speed against precision and recall, above failures: found pixels green, wrongly labelled ones red,
    missed ones blue.

    Raises BadConfig if the file cannot be written; MissingLibrary without matplotlib.
    """
    rows = -(-len(figures.shown) // _COLUMNS)
    figure = new_chart(13, 4.2 + 2.1 * rows)
    above, below = figure.subfigures(2, 1, height_ratios=(4.2, 2.1 * max(rows, 1)))
    charts: dict[str, list[Any]] = {"made rooms, things of unseen kinds": [], "the real room": []}
    for name, way in all_ways(figures).items():
        charts["made rooms, things of unseen kinds"].append((name, way["ms"], way["made"]["unseen kinds"]))
        if "real" in way:
            charts["the real room"].append((name, way["ms"], way["real"][ROOM]["at"][f"{figures['threshold']:g}"]))
    for axis, (title, points) in zip(above.subplots(1, 2), charts.items(), strict=True):
        _chart(axis, title, points)
    axes = below.subplots(max(rows, 1), _COLUMNS, squeeze=False).ravel()
    for axis in axes:
        axis.set_axis_off()
    for axis, failure in zip(axes, figures.shown, strict=False):
        axis.imshow(failure.picture)
        axis.set_title(f"{failure.name}: {failure.wrong_m2:.1f} m² wrong", fontsize=8)
    save_chart(figure, path, dpi=100)


def all_ways(figures: dict[str, Any]) -> dict[str, Any]:
    """The ways of a run, and those of the search that was used before, whose times are of a machine as fast."""
    before, same = figures.get("before"), {}
    if before is not None:
        faster = figures["compact_ms"] / before["compact_ms"]
        same = {name: {**way, "ms": way["ms"] * faster} for name, way in before["ways"].items()}
    return {**same, **figures["ways"]}


def _chart(axis: Any, title: str, points: list[tuple[str, float, dict[str, float | None]]]) -> None:
    names = []
    for number, (name, ms, shares) in enumerate(sorted(points, key=lambda point: point[1])):
        heights = {kind: 100 * (shares[kind] or 0.0) for kind in _COLOURS}
        axis.plot([ms, ms], list(heights.values()), color="#d8d8de", zorder=1)
        for kind, height in heights.items():
            axis.plot(ms, height, "o", color=_COLOURS[kind], label="_" if number else kind)
        # Numbers left and right in turns, since some ways take about the same time, for whose names there is no room.
        side, shift = ("left", 5) if number % 2 else ("right", -5)
        place = {"textcoords": "offset points", "ha": side, "va": "center", "fontsize": 8}
        axis.annotate(str(number + 1), (ms, max(heights.values())), (shift, 0), **place)
        names.append(f"{number + 1}  {name}")
    axis.text(0.4, 0.62, "\n".join(names), transform=axis.transAxes, va="top", fontsize=8, linespacing=1.4)
    axis.set_title(f"{title}: % of pixels", loc="left", fontsize=10)
    axis.set_xlabel("processor time, ms a frame of 640 x 480")
    axis.set_ylim(-8, 112)
    axis.set_xlim(left=0)
    axis.margins(x=0.2)
    axis.grid(color="#e4e4e8", linewidth=0.8)
    axis.spines[["top", "right"]].set_visible(False)
    if points:
        axis.legend(frameon=False, loc="lower left")
