"""Draws what `tools/bench ablation` measured: `--figure FILE.png`."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from benches.charts.legends import legend_line
from benches.charts.scales import thousands
from benches.model.ablation.rows import BASE, LEAST_POINTS, NEAR_POINTS, Tree
from bodyseg_data.drawing import new_chart, save_chart

_GROUPS: Final = {
    "artifacts": "Artifacts",
    "sub-kinds": "Kinds of artifacts",
    "bodies": "Bodies",
    "views": "Views",
    "image": "Image",
    "network": "Network",
    "amount": "Amount",
}
_ON_ALL: Final = ("#1f4fa8", "o")
_WHERE_MEANT: Final = ("#c25a00", "D")
_FAINT: Final = "#8a8a8a"
_GRID: Final = "#e4e4e8"
_LINEAR: Final = 1.0
"""Points up to which the scale is linear, beyond which it is logarithmic."""

_TICKS: Final = (-30, -10, -3, -1, -LEAST_POINTS, 0, LEAST_POINTS, 1, 3, 10, 30, 60)
_AMOUNTS: Final = {"bodies": "bodies trained on", "views": "views of each body trained on"}


def draw_ablation(figures: Tree, path: Path) -> None:
    """Write a PNG of `bench_ablation`'s results: a row for each effect, and accuracy by number of bodies and of views.

    Raises MissingLibrary without matplotlib, BadConfig if the file cannot be written.
    """
    lines = _lines(figures["rows"])
    figure = new_chart(16, max(6.0, 1.9 + 0.27 * len(lines)))
    grid = figure.add_gridspec(2, 2, width_ratios=(2.35, 1))
    _dots(
        figure.add_subplot(grid[:, 0]),
        lines,
        {condition["name"]: condition["title"] for condition in figures["conditions"]},
    )
    for position, (name, label) in enumerate(_AMOUNTS.items()):
        _amounts(figure.add_subplot(grid[position, 1]), figures, name, label)
    figure.legend(handles=_handles(), loc="outside lower center", ncols=4, fontsize=10, frameon=False)
    figure.suptitle(_scale(figures["scale"]), x=0.005, ha="left", fontsize=10.5)
    save_chart(figure, path, dpi=110)


def _lines(rows: list[Tree]) -> list[Tree | str]:
    """Rows in the order of their groups, each group after its title."""
    found: list[Tree | str] = []
    for group, title in _GROUPS.items():
        members = [row for row in rows if row["group"] == group]
        found += [title, *members] if members else []
    return found


def _dots(axis: Any, lines: list[Tree | str], titles: dict[str, str]) -> None:
    axis.axvspan(-LEAST_POINTS, LEAST_POINTS, color="#efeff2", zorder=0)
    axis.axvline(0, color=_FAINT, linewidth=0.9, zorder=1)
    for y, line in enumerate(lines):
        if isinstance(line, str):
            continue
        axis.axhline(y, color=_GRID, linewidth=0.8, zorder=0)
        meant = [(line["worth"][name]["points"], name) for name in line["helps"] if name in line["worth"]]
        best = max((each for each in meant if each[1] != BASE), default=(0.0, None))[1]
        if best is not None:
            _dot(axis, y, line["worth"][best], _WHERE_MEANT, best in line["pays_on"])
        _dot(axis, y, line["worth"][BASE], _ON_ALL, BASE in line["pays_on"])
        note = "" if best is None else f"◆ {titles[best]}"
        axis.text(1.15, y, note, transform=axis.get_yaxis_transform(), va="center", fontsize=8.5, color="#444444")
        pays = line["verdict"] == "pays"
        axis.text(
            1.01, y, line["verdict"], transform=axis.get_yaxis_transform(), va="center", fontsize=9,
            fontweight="bold" if pays else "normal", color="black" if pays else "#666666",
        )  # fmt: skip
    names = [line if isinstance(line, str) else _name(line) for line in lines]
    axis.set_yticks(range(len(lines)), names, fontsize=9)
    for text, line in zip(axis.get_yticklabels(), lines, strict=True):
        text.set_fontweight("bold" if isinstance(line, str) else "normal")
    axis.set_ylim(len(lines) - 0.4, -0.6)
    axis.set_xscale("symlog", linthresh=_LINEAR, linscale=1.2)
    low, high = axis.get_xlim()
    ticks = [tick for tick in _TICKS if min(low, -1) <= tick <= max(high, 3)]
    axis.set_xlim(min(low, -1), max(high, 3))
    axis.set_xticks(ticks, [f"{tick:+g}" if tick else "0" for tick in ticks], fontsize=9)
    axis.minorticks_off()
    axis.tick_params(axis="y", length=0)
    axis.set_xlabel(
        "points of accuracy with it, less those without: to the right, worth having (logarithmic beyond 1 point)",
        fontsize=10,
    )
    axis.spines[["top", "right", "left"]].set_visible(False)
    axis.set_title("Gain of each effect", loc="left", fontsize=11)


def _dot(axis: Any, y: int, value: Tree, style: tuple[str, str], pays: bool) -> None:
    """A mark, filled if it counts, and a line of one standard deviation to either side."""
    colour, marker = style
    points, spread = value["points"], value["sd"] or 0.0
    axis.plot([points - spread, points + spread], [y, y], color=colour, linewidth=2.2, alpha=0.45, zorder=2)
    axis.plot(points, y, marker, color=colour, markersize=6.5, zorder=3, markerfacecolor=colour if pays else "white")


def _name(row: Tree) -> str:
    return f"+ {row['what']}" if row["added"] else row["what"]


def _amounts(axis: Any, figures: Tree, name: str, label: str) -> None:
    full = figures["base"][BASE]
    rows = [row for row in figures["rows"] if row["name"].startswith(f"{name}_")]
    points = [(row[name], row["accuracy"][BASE]) for row in rows]
    points = sorted([*points, (figures["scale"][f"train_{name}"], full)], key=lambda point: point[0])
    counts, means = [count for count, _ in points], [100 * value["mean"] for _, value in points]
    colour, marker = _ON_ALL
    axis.errorbar(
        counts, means, yerr=[100 * (value["sd"] or 0.0) for _, value in points], color=colour, marker=marker,
        linewidth=1.6, markersize=6, capsize=3,
    )  # fmt: skip
    near = 100 * full["mean"] - NEAR_POINTS
    axis.axhline(near, color=_FAINT, linewidth=1, linestyle=(0, (5, 3)), zorder=1)
    axis.set_xscale("log")
    axis.set_xticks(counts, [thousands(count) for count in counts], fontsize=9)
    axis.minorticks_off()
    axis.margins(x=0.08, y=0.15)
    axis.set_xlabel(label, fontsize=10)
    axis.set_ylabel("accuracy on all artifacts, %", fontsize=10)
    axis.grid(axis="y", color=_GRID, linewidth=0.6)
    axis.set_axisbelow(True)
    axis.spines[["top", "right"]].set_visible(False)
    axis.set_title(f"How many {name} suffice?\ndashed: {NEAR_POINTS:g} point below all", loc="left", fontsize=11)


def _handles() -> list[Any]:
    colour, marker = _ON_ALL
    other, diamond = _WHERE_MEANT
    plain: dict[str, Any] = {"linewidth": 2.2, "markersize": 7}
    return [
        legend_line("test images with all artifacts", color=colour, marker=marker, **plain),
        legend_line("those it is meant to help (named at the right)", color=other, marker=diamond, **plain),
        legend_line("filled: pays there", color="#444444", marker="o", markerfacecolor="#444444", linewidth=0),
        legend_line("± 1 standard deviation of the difference", color="#444444", linewidth=2.2, alpha=0.45),
    ]


def _scale(scale: Tree) -> str:
    steps, batch, seeds = scale["steps"], scale["images_a_step"], scale["seeds"]
    return (
        f"Each training has one effect left out (+: added) and {thousands(steps)} steps of {batch} images of "
        f"{thousands(scale['train_samples'])}; the base has {seeds} seed{'s' if seeds > 1 else ''}; "
        f"{thousands(scale['test_images'])} test images of each kind; average per-class accuracy"
    )
