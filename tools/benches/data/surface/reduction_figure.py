"""Draws triangles and views a second against range error: `tools/bench reduction --figure FILE.png`."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from benches.charts.fronts import pareto_front
from bodyseg_data.drawing import new_chart, save_chart

_NOTHING: Final = 0.01  # mm; where "none" is drawn, since a log axis has no zero
_TITLES: Final = {
    "open": "open bodies",
    "mit": "MIT frames",
    "smooth scan": "smooth scan",
    "rough scan": "scan with 0.3 mm noise",
}
_MARKERS: Final = {"open": "o", "mit": "s", "smooth scan": "^", "rough scan": "D"}
_COLOURS: Final = {"open": "#1f77b4", "mit": "#7f7f7f", "smooth scan": "#2ca02c", "rough scan": "#d95f02"}


def draw_reduction(figures: dict[str, Any], path: Path) -> None:
    """Write a PNG of what `bench_reduction` measured. Raises MissingLibrary without matplotlib, BadConfig if the file
    cannot be written.
    """
    figure = new_chart(13, 6)
    axes: Any = figure.subplots(1, 2)
    least = figures["default"]["from_triangles"]
    for name, kind in figures["kinds"].items():
        rows = _rows(kind)
        style = {"color": _COLOURS[name], "marker": _MARKERS[name], "markersize": 5, "linewidth": 1.2}
        label = f"{_TITLES[name]}, {kind['shares'][0]['triangles'] / 1000:.0f} 000 triangles"
        by_size = sorted(rows, key=lambda row: float(row["triangles"]))
        axes[0].plot([row["triangles"] for row in by_size], [_error(row) for row in by_size], label=label, **style)
        axes[1].scatter([_error(row) for row in rows], [row["views_per_second"] for row in rows], **_dots(name))
        front = pareto_front(rows, lambda row: (_error(row), -row["views_per_second"]))
        axes[1].plot(
            [_error(row) for row in front],
            [row["views_per_second"] for row in front],
            color=_COLOURS[name],
            drawstyle="steps-post",
            linewidth=1.2,
        )
        default = _default(kind, figures["default"]["tolerance_mm"], least)
        star = {"marker": "*", "s": 260, "c": _COLOURS[name], "edgecolors": "black", "zorder": 3}
        axes[0].scatter(default["triangles"], _error(default), **star)
        axes[1].scatter(_error(default), default["views_per_second"], **star)
    _dress(axes, figures)
    save_chart(figure, path, dpi=120)


def _rows(kind: dict[str, Any]) -> list[dict[str, Any]]:
    return [*kind["shares"], *kind["tolerances"]]


def _default(kind: dict[str, Any], tolerance_mm: float, least: int) -> dict[str, Any]:
    """The row that a packing with `--pymeshlab` and without `--tolerance-mm` gets."""
    whole: dict[str, Any] = kind["shares"][0]
    if whole["triangles"] < least:
        return whole
    reduced: dict[str, Any] = next(row for row in kind["tolerances"] if row["tolerance_mm"] == tolerance_mm)
    return reduced


def _dots(name: str) -> dict[str, Any]:
    return {"c": _COLOURS[name], "marker": _MARKERS[name], "s": 28}


def _error(row: dict[str, Any]) -> float:
    return max(float(row["p95_mm"]), _NOTHING)


def _dress(axes: Any, figures: dict[str, Any]) -> None:
    ticks = [_NOTHING, 0.1, 1, 10, 100], ["none", "0.1", "1", "10", "100"]
    error = "range error, 95th percentile of pixels, mm"
    axes[0].axhline(1, color="black", linewidth=0.8, linestyle=":")
    axes[0].annotate("the sensor's uncertainty", (0.02, 1.1), xycoords=("axes fraction", "data"), fontsize=9)
    axes[0].set(xscale="log", yscale="log", xlabel="triangles", ylabel=error)
    axes[0].set_yticks(*ticks)
    axes[0].legend(fontsize=9, loc="upper right")
    axes[1].axvline(1, color="black", linewidth=0.8, linestyle=":")
    speed = "views a second, one core, reduction included"
    speeds = [row["views_per_second"] for kind in figures["kinds"].values() for row in _rows(kind)]
    limits = min(2.5, 0.8 * min(speeds)), max(100, 1.25 * max(speeds))
    axes[1].set(xscale="log", yscale="log", xlabel=error, ylabel=speed, ylim=limits)
    shown = [tick for tick in (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000) if limits[0] <= tick <= limits[1]]
    axes[1].set_yticks(shown, map(str, shown))
    axes[1].set_xticks(*ticks)
    axes[0].set_title("what coarser meshes cost", fontsize=11)
    axes[1].set_title(
        f"what they save over {figures['views_a_body']} views; line: Pareto front, star: --pymeshlab", fontsize=11
    )
    for axis in axes:
        axis.minorticks_off()
        axis.grid(color="#e5e5e5", linewidth=0.6)
        axis.set_axisbelow(True)
