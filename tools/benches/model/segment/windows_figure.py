"""Draws what `tools/bench windows` measured: `--figure FILE.png`."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from bodyseg_data.drawing import new_chart, save_chart

_TITLES: Final = {"set": "images of the set", "rooms": "bodies in made rooms"}
_COLOUR: Final = "#1f4fa8"


def draw_windows(figures: dict[str, Any], path: Path) -> None:
    """Write a PNG of `bench_windows`'s results: pixels right over milliseconds, a panel for the set and one for rooms.

    Raises MissingLibrary without matplotlib, BadConfig if the file cannot be written.
    """
    figure = new_chart(10, 4)
    panels = figure.subplots(1, len(figures["sets"]), sharex=True)
    for axis, (name, found) in zip(panels, figures["sets"].items(), strict=True):
        rows = found["margins"]
        ms, right = [row["ms"] for row in rows], [100 * row["right"] for row in rows]
        errors = [100 * row["less_error"] for row in rows]
        axis.errorbar(ms, right, errors, fmt="o-", color=_COLOUR, capsize=3, linewidth=1)
        axis.plot(ms[-1], right[-1], "*", color=_COLOUR, markersize=14)
        for number, (row, x, y) in enumerate(zip(rows, ms, right, strict=True)):
            label = "whole image" if row["margin_px"] is None else f"{row['margin_px']} px"
            beside = (8, "left") if number < 2 else (-9, "right")  # the last points are near the right end
            axis.annotate(label, (x, y), xytext=(beside[0], -3), textcoords="offset points", fontsize=9, ha=beside[1])
        axis.margins(x=0.3, y=0.18)
        axis.set_title(f"{found['bodies']} {_TITLES[name]}", loc="left", fontsize=10)
        axis.set_xlabel("processor time, ms a body, median, one thread")
        axis.grid(color="#e4e4e8")
    panels[0].set_ylabel("pixels right, %, mean over bodies")
    save_chart(figure, path, dpi=110)
