"""Draws what `bench limits` measured: `--figure FILE.png`."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from bodyseg_data.drawing import new_chart, save_chart

_COLOURS: Final = {"shape": "#8a8a8a", "confidence": "#c25a00", "both": "#1f4fa8"}


def draw_limits(figures: dict[str, Any], path: Path) -> None:
    """Write a PNG of precision against recall of surfaces, by shape, by confidence, and by both.

    Raises MissingLibrary without matplotlib, BadConfig if the file cannot be written.
    """
    figure = new_chart(6.5, 4.5)
    axis = figure.subplots()
    for way, curve in figures["curves"].items():
        axis.plot(curve["recall"], curve["precision"], color=_COLOURS[way], label=f"by {way}")
        counts = figures["ways"][way]
        kept = counts["people"] - counts["people_lost"]
        at = kept / counts["people"], kept / (kept + counts["things_kept"])
        axis.plot(*at, "o", color=_COLOURS[way])
    axis.set_xlabel("share of people kept")
    axis.set_ylabel("share of people among what is kept")
    axis.set_xlim(0.8, 1.005)
    axis.grid(color="#e4e4e8", linewidth=0.8)
    axis.spines[["top", "right"]].set_visible(False)
    axis.legend(frameon=False, loc="lower left")
    save_chart(figure, path, dpi=110)
