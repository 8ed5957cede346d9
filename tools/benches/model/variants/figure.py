"""Draws what `tools/bench variants` measured: `--figure FILE.png`."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final, NamedTuple

from benches.charts.legends import legend_line
from benches.charts.scales import thousands
from bodyseg_data.drawing import new_chart, save_chart

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
    "noise": ("sigma of the noise, mm", 1, 40, "Noise, other artifacts as in X_all (Fig. 7)"),
    "missing": ("missing pixels, %", 100, 50, "Missing data, other artifacts as in X_all (Fig. 8)"),
    "noise_alone": ("sigma of the noise, mm", 1, 40, "Noise and no other artifact"),
    "missing_alone": ("missing pixels, %", 100, 50, "Missing data and no other artifact"),
}
"""Sweep -> axis, what strengths are multiplied by, the strength to mark, title."""

_GRID: Final = "#e2e2e2"


def draw_variants(figures: Tree, path: Path) -> None:
    """Write a PNG of `bench_variants`'s results: a panel for each sweep, five curves each, and the table of test sets.

    Bands are one standard deviation over seeds. Raises MissingLibrary without matplotlib, BadConfig if the file cannot
    be written.
    """
    rows = len(figures["sweeps"]) // 2
    figure = new_chart(16.5, 1.6 + 3.9 * rows)
    grid = figure.add_gridspec(rows, 3, width_ratios=(1, 1, 1.08))
    lowest = min(value for sweep in figures["sweeps"].values() for c in sweep["curves"].values() for value in c["mean"])
    for position, (name, sweep) in enumerate(figures["sweeps"].items()):
        axis = figure.add_subplot(grid[position // 2, position % 2])
        _sweep(axis, name, sweep)
        axis.set_ylim(max(0.0, 0.1 * (10 * lowest // 1)), 1)
        if position % 2 == 0:
            axis.set_ylabel("average per-class accuracy", fontsize=10)
    _table(figure.add_subplot(grid[:, 2]), figures["table"])
    handles = [legend_line(f"trained on {name}", **_drawn(name)) for name in _STYLES]
    figure.legend(handles=handles, loc="outside lower center", ncols=5, fontsize=10.5, handlelength=4.5, frameon=False)
    figure.suptitle(_scale(figures["scale"]), x=0.005, ha="left", fontsize=10.5)
    save_chart(figure, path, dpi=110)


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
    label, factor, mark, title = _PANELS[name]
    strengths = [factor * strength for strength in sweep["strengths"]]
    axis.axvline(mark, color="#9a9a9a", linewidth=0.8, linestyle=(0, (2, 2)), zorder=1)
    for order, (variant, curve) in enumerate(sweep["curves"].items()):
        if None not in curve["sd"]:
            edges = [[mean + way * sd for mean, sd in zip(curve["mean"], curve["sd"], strict=True)] for way in (-1, 1)]
            axis.fill_between(strengths, *edges, color=_STYLES[variant].colour, alpha=0.16, linewidth=0)
        axis.plot(strengths, curve["mean"], zorder=3 + order, **_drawn(variant))
    axis.set_xticks(strengths, [f"{strength:g}" for strength in strengths], fontsize=9)
    axis.yaxis.set_major_formatter(lambda value, _: f"{100 * value:.0f} %")
    axis.set_xlabel(label, fontsize=10)
    axis.set_title(title, loc="left", fontsize=11)
    axis.grid(axis="y", color=_GRID, linewidth=0.6)
    axis.set_axisbelow(True)
    axis.spines[["top", "right"]].set_visible(False)


def _table(axis: Any, table: Tree) -> None:
    """Training variant by test variant; the darker a cell, the better; the best of a column is bold."""
    names = list(table)
    means = [[table[train][test]["mean"] for test in names] for train in names]
    lowest, highest = min(map(min, means)), max(map(max, means))
    axis.imshow(means, cmap="Blues", vmin=lowest - 0.15 * (highest - lowest), vmax=highest, aspect="auto")
    best = [max(row[column] for row in means) for column in range(len(names))]
    for row, train in enumerate(names):
        for column, test in enumerate(names):
            cell = table[train][test]
            spread = "" if cell["sd"] is None else f"\n± {100 * cell['sd']:.1f}"
            dark = cell["mean"] - lowest > 0.55 * (highest - lowest)
            axis.text(
                column, row, f"{100 * cell['mean']:.1f}{spread}", ha="center", va="center", fontsize=10.5,
                color="white" if dark else "black", fontweight="bold" if cell["mean"] == best[column] else "normal",
            )  # fmt: skip
    axis.set_xticks(range(len(names)), names, fontsize=10)
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
