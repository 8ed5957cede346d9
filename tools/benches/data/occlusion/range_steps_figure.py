"""Draws what `tools/bench range_step` measured: `--figure FILE.png`."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from bodyseg_data.drawing.style import new_chart, save_chart

_DEFAULT: Final = "#1f5ac8"
_OTHERS: Final = "#77777f"
_LIMIT: Final = "#e08a1e"


def draw_range_step(figures: dict[str, Any], path: Path) -> None:
    """Write a PNG of `bench_range_step`'s results: wrong pixels against bytes, and the limit.

    Raises MissingLibrary without matplotlib, BadConfig if the file cannot be written.
    """
    figure = new_chart(8.5, 5.5)
    axis: Any = figure.subplots()
    points = {name: (row["bytes"] / 1000, 100 * row["wrong_pixels"]) for name, row in figures["steps"].items()}
    axis.plot(*zip(*points.values(), strict=True), color=_OTHERS, linewidth=1, zorder=1)
    for name, point in points.items():
        default = name == figures["default"]
        axis.scatter(*point, s=70 if default else 28, color=_DEFAULT if default else _OTHERS, zorder=3)
        text = f"{name} mm (the default rig's)" if default else f"{name} mm"
        axis.annotate(text, point, textcoords="offset points", xytext=(7, 5), fontsize=9)
    axis.axhline(100 * figures["limit"], color=_LIMIT, linewidth=1.5, label=f"limit: {100 * figures['limit']:g} %")
    axis.set_xlabel("kB a sample, three images")
    axis.set_ylabel("pixels with a wrong shadow, % of the body in the projector's view")
    axis.set_xlim(0, 1.15 * max(kb for kb, _ in points.values()))
    axis.set_ylim(0, 1.15 * max(100 * figures["limit"], *(wrong for _, wrong in points.values())))
    axis.set_title(f"Step of stored range, {figures['views']} views of bare bodies", loc="left", fontsize=12)
    axis.spines[["top", "right"]].set_visible(False)
    axis.grid(alpha=0.25)
    axis.legend(loc="lower right", frameon=False)
    save_chart(figure, path, dpi=120)
