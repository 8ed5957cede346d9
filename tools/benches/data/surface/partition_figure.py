"""Draws time against error of ways to measure distance: `tools/bench partition --figure FILE.png`."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from benches.charts.fronts import pareto_front
from benches.charts.scales import thousands
from bodyseg_data.drawing import new_chart, save_chart

_NOTHING: Final = 0.0004  # where "no error" is drawn, since a log axis has no zero
_MARKERS: Final = {"exact": "*", "unfolded": "o", "edges": "s", "marching": "^", "heat": "D"}
_GREYS: Final = {
    "exact": "#000000",
    "unfolded": "#303030",
    "edges": "#6a6a6a",
    "marching": "#8c8c8c",
    "heat": "#b0b0b0",
}
_TICKS: Final = (10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10000)
_LABELS: Final = {
    "exact": ("right", (-13, 0)),
    "unfolded": ("right", (-4, -14)),
    "edges": ("center", (0, 14)),
    "marching": ("center", (0, 14)),
    "heat": ("left", (10, 0)),
}
"""On which side of its point each name stands, and how far away, points."""


def draw_partition(figures: dict[str, Any], path: Path) -> None:
    """Write a PNG of what `bench_partition` measured. Raises MissingLibrary without matplotlib, BadConfig if the file
    cannot be written.
    """
    scan = next(name for name in figures["bodies"] if name.startswith("scan"))
    panels = [(f"open bodies ({len(figures['open'])})", figures["methods"])]
    if isinstance(figures["mit"], dict):
        panels.append((f"MIT frames ({len(figures['mit']['frames'])})", figures["mit"]["methods"]))
    panels.append((scan, figures["bodies"][scan]["methods"]))
    figure = new_chart(13, 9)
    halves: Any = figure.subfigures(2, 1, height_ratios=(1, 0.95))
    upper, lower = halves
    axes: Any = upper.subplots(1, len(panels), sharey=True, squeeze=False)
    for axis, (title, methods) in zip(axes[0], panels, strict=True):
        _scatter(axis, methods, figures["default"])
        axis.set_title(title, fontsize=11)
    axes[0][0].set_ylabel("surface labelled differently from the exact answer", fontsize=10)
    _table(lower.subplots(), figures)
    save_chart(figure, path, dpi=120)


def _scatter(axis: Any, methods: dict[str, Any], default: str) -> None:
    points = {name: (row["partition_ms"], max(row["wrong_surface"], _NOTHING)) for name, row in methods.items()}
    front = pareto_front(points.values(), lambda point: point)
    axis.plot(*zip(*front, strict=True), color="black", linewidth=1, linestyle="--", zorder=1)
    for name, (x, y) in points.items():
        big = name == default
        axis.scatter(x, y, s=260 if big else 80, marker=_MARKERS[name], c=_GREYS[name], edgecolors="black", zorder=2)
        side, offset = _LABELS[name]
        label = f"{name} (default)" if big else name
        axis.annotate(label, (x, y), offset, textcoords="offset points", ha=side, va="center", fontsize=10)
    axis.set_xscale("log")
    axis.set_yscale("log")
    low, high = min(x for x, _ in points.values()), max(x for x, _ in points.values())
    axis.set_xlim(low / 2.2, high * 2.2)
    axis.set_ylim(_NOTHING / 1.6, 0.13)
    axis.set_yticks([_NOTHING, 0.001, 0.01, 0.1], ["none", "0.1 %", "1 %", "10 %"])
    axis.minorticks_off()
    ticks = [tick for tick in _TICKS if low / 2.2 <= tick <= high * 2.2]
    axis.set_xticks(ticks, [thousands(tick) for tick in ticks])
    axis.set_xlabel("partition of a body, ms; dashed: the front", fontsize=10)
    axis.grid(color="#dddddd", linewidth=0.6)
    axis.set_axisbelow(True)


def _table(axis: Any, figures: dict[str, Any]) -> None:
    """Errors on broken bodies, as they are and as `partition` answers; darker is worse."""
    axis.axis("off")
    methods = list(figures["methods"])
    axis.set_title(
        "Broken bodies: surface wrong with each method on the mesh as it is → mended first, as partition does",
        fontsize=11,
    )
    names = list(figures["bodies"])
    texts, shades = [], []
    for name in names:
        rows = figures["bodies"][name]["methods"]
        texts.append([_cell(rows[method], method) for method in methods])
        shades.append([_shade(rows[method]["wrong_surface"]) for method in methods])
    table = axis.table(
        texts,
        cellColours=shades,
        rowLabels=names,
        colLabels=methods,
        cellLoc="center",
        bbox=(0.17, 0.08, 0.83, 0.92),
    )
    table.auto_set_font_size(False)
    table.set_fontsize(9.5)
    for (row, column), cell in table.get_celld().items():
        cell.set_edgecolor("#bbbbbb")
        if row == 0 or column == -1:
            cell.set_facecolor("white")
        if row == 0 and methods[column] == figures["default"]:
            cell.get_text().set_weight("bold")
    axis.text(
        0.17,
        0.0,
        f"×: it has no answer.  *: '{figures['falls_back_to']}' is used instead.  "
        "Against the sound body's exact answer; the scan against its own.",
        fontsize=9.5,
        transform=axis.transAxes,
    )


def _cell(row: dict[str, Any], method: str) -> str:
    before = "×" if isinstance(row["as_it_is"], str) else f"{row['as_it_is']:.2%}"
    fallen = row["note"] is not None and not row["note"].startswith(f"distances by the method {method!r}")
    return f"{before} → {row['wrong_surface']:.2%}{'*' if fallen else ''}".replace("%", " %")


def _shade(wrong: float) -> str:
    level = 255 - round(min(wrong, 0.15) / 0.15 * 90)
    return f"#{level:02x}{level:02x}{level:02x}"
