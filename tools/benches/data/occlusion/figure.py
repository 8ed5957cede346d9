"""Draws error against time and bytes of ways to make the shadow: `tools/bench occlusion --figure FILE.png`."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from benches.charts.fronts import pareto_front
from benches.charts.legends import legend_line, legend_mark
from benches.charts.scales import thousands
from benches.data.occlusion.baselines import DEFAULT
from benches.data.occlusion.crops import draw_crops
from bodyseg_data.drawing import new_chart, save_chart

Row = dict[str, Any]
Setting = tuple[Any, ...]

_FAMILIES: Final = {
    "nearest texel": ("o", "nearest texel"),
    "farthest of four texels": ("s", "farthest of four"),
    "plane through the texel": ("D", "plane through the texel"),
    "votes of four texels": ("^", "votes of four"),
    "interpolated range everywhere": ("v", "interpolated everywhere"),
    DEFAULT.family: ("P", "interpolated, votes at edges"),
}
"""Family -> marker, name in the legend."""

_SIZES: Final = {1: 32, 2: 62, 3: 100}
_NO_ERROR: Final = 0.0010  # where "none" is drawn, since a log axis has no zero
_TOP: Final = 0.056  # with room for the legend
_LIMIT: Final = 0.005
_ON_FRONT: Final = "#1f4fa8"
_BEHIND: Final = "#b9b9b9"
_GREY: Final = "#8a8a8a"
_EDGE: Final = "#4a4a4a"
_COMPILED: Final = "#f2c14e"
_AXES: Final = {
    "us_per_view": ("decoding and test, µs of processor a view", (30, 50, 100, 200, 500, 1000, 2000, 5000)),
    "bytes": ("added to a sample, bytes: projector image and facing bit", (200, 500, 1000, 2000, 5000, 20000, 100000)),
}
_ROOM: Final = 5.5  # to the left of all points, for names
_BY_SCENE: Final = (
    ("nearest texel", 10.0, 1, False, "nearest texel, 10 mm, no facing bit"),
    ("farthest of four texels", 10.0, 1, True, "farthest of four, 10 mm"),
    ("nearest texel", 20.0, 1, True, "nearest texel, 20 mm"),
    ("votes of four texels", 20.0, 1, True, "votes of four, 20 mm"),
    ("plane through the texel", 10.0, 1, True, "plane through the texel, 10 mm"),
    (DEFAULT.family, DEFAULT.bias_mm, 1, True, "default"),
    (DEFAULT.family, DEFAULT.bias_mm, 2, True, "default, image ×2"),
)
"""Those that are shown scene by scene: family, bias, scale, facing bit, name."""

_NAMED: Final = (
    (("nearest texel", 20.0, 1, True), "nearest texel, 20 mm", (-24, 12)),
    ((DEFAULT.family, DEFAULT.bias_mm, 1, True), "default", (-34, -8)),
    (("nearest texel", 20.0, 2, True), "nearest texel, 20 mm, ×2", (-30, -10)),
    ((DEFAULT.family, DEFAULT.bias_mm, 2, True), "default, ×2", (-30, -10)),
    ((DEFAULT.family, DEFAULT.bias_mm, 3, True), "default, ×3", (-30, -8)),
)
"""Settings, names, and where the names stand from their points."""

_SCENE_STYLES: Final = (
    ("o", "white", "#777777"),
    ("s", "#d0d0d0", "#555555"),
    ("o", "#9a9a9a", "#555555"),
    ("^", "#9a9a9a", "#555555"),
    ("D", "#d0d0d0", "#555555"),
    ("P", _ON_FRONT, "black"),
    ("P", "#8fb0ea", "black"),
)


def draw_occlusion(figures: Row, path: Path) -> None:
    """Write what `bench_occlusion` measured as a PNG, and beside it, as NAME_errors.png, the default's worst errors.

    Raises MissingLibrary without matplotlib, BadConfig if a file cannot be written.
    """
    rows = figures["methods"]
    maps = [row for row in rows if row["family"] in _FAMILIES and row["form"] == "numpy"]
    compiled = [row for row in rows if row["form"] == "compiled"]
    mask = next(row for row in rows if row["family"] not in _FAMILIES)
    figure = new_chart(14, 12)
    parts: Any = figure.subfigures(2, 1, height_ratios=(1.35, 1))
    upper, lower = parts
    axes: Any = upper.subplots(1, 2, sharey=True)
    for axis, cost in zip(axes, _AXES, strict=True):
        _scatter(axis, cost, maps, mask)
    _compiled(axes[0], compiled)
    axes[0].set_ylabel("foreground pixels wrong, against exact shadow rays", fontsize=10)
    _name_points(axes, figures, [*compiled, *maps])
    _legend(axes[0])
    _scenes(lower.subplots(), figures, maps)
    save_chart(figure, path, dpi=120)
    draw_crops(figures, path.with_name(f"{path.stem}_errors.png"))


def _front(rows: list[Row], *costs: str) -> list[Row]:
    return pareto_front(rows, lambda row: [row[cost] for cost in costs])


def _front_line(axis: Any, rows: list[Row], cost: str, style: str) -> None:
    line = [(row[cost], row["wrong_pixels"]) for row in _front(rows, cost, "wrong_pixels")]
    axis.plot(*zip(*line, strict=True), color="black", linewidth=1, linestyle=style, drawstyle="steps-post", zorder=2)


def _scatter(axis: Any, cost: str, maps: list[Row], mask: Row) -> None:
    best = _front(maps, "wrong_pixels", "us_per_view", "bytes")
    _front_line(axis, maps, cost, "--")
    for row in maps:
        shown = row in best
        colour, edge = (_ON_FRONT, "black") if shown else (_BEHIND, "#7d7d7d")
        axis.scatter(
            row[cost],
            row["wrong_pixels"],
            s=_SIZES[row["projector_scale"]],
            marker=_FAMILIES[row["family"]][0],
            facecolors=colour if row["facing_bit"] else "none",
            edgecolors=edge,
            linewidths=0.7,
            alpha=0.95 if shown else 0.7,
            zorder=4 if shown else 3,
        )
    axis.scatter(mask[cost], _NO_ERROR, s=150, marker="*", color="black", zorder=5)
    axis.annotate(
        "exact mask, stored: no error, one rig",
        (mask[cost], _NO_ERROR),
        (12, -3),
        textcoords="offset points",
        fontsize=10,
        weight="bold",
    )
    axis.axhline(_LIMIT, color="black", linewidth=0.7, linestyle=":", zorder=1)
    axis.set_xscale("log")
    axis.set_yscale("log")
    axis.set_ylim(_NO_ERROR / 1.25, _TOP)
    axis.set_yticks([_NO_ERROR, 0.002, 0.005, 0.01, 0.02, 0.05], ["none", "0.2 %", "0.5 %", "1 %", "2 %", "5 %"])
    label, ticks = _AXES[cost]
    low = min(mask[cost], *(row[cost] for row in maps)) / _ROOM
    high = max(row[cost] for row in maps) * 1.4
    axis.set_xlim(low, high)
    axis.minorticks_off()
    kept = [tick for tick in ticks if low <= tick <= high]
    axis.set_xticks(kept, [thousands(tick) for tick in kept])
    axis.set_xlabel(label, fontsize=10)
    axis.grid(color="#e2e2e2", linewidth=0.6)
    axis.set_axisbelow(True)
    axis.spines[["top", "right"]].set_visible(False)


def _compiled(axis: Any, rows: list[Row]) -> None:
    """Marks on white: the same points as their namesakes in NumPy, further to the left."""
    for row in rows:
        axis.scatter(
            row["us_per_view"],
            row["wrong_pixels"],
            s=_SIZES[row["projector_scale"]] * 1.3,
            marker=_FAMILIES[row["family"]][0],
            facecolors=_COMPILED,
            edgecolors="black",
            linewidths=0.8,
            zorder=5,
        )
    if rows:
        _front_line(axis, rows, "us_per_view", "-")


def _name_points(axes: Any, figures: Row, rows: list[Row]) -> None:
    default = figures["default"]
    for axis, cost in zip(axes, _AXES, strict=True):
        point = default[cost], default["wrong_pixels"]
        axis.scatter(*point, s=330, facecolors="none", edgecolors="black", linewidths=1.8, zorder=6)
        for setting, name, offset in _NAMED:
            row = _find(rows, setting)
            axis.annotate(
                f"{name}: {100 * row['wrong_pixels']:.2f} %",
                (row[cost], row["wrong_pixels"]),
                offset,
                textcoords="offset points",
                ha="right",
                va="center",
                fontsize=9.5,
                weight="bold" if name == "default" else "normal",
                arrowprops={"arrowstyle": "-", "color": "black", "linewidth": 0.7, "shrinkB": 4},
                bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.6},
                zorder=7,
            )


def _find(maps: list[Row], setting: Setting) -> Row:
    """The first row with this family, bias, scale and facing bit."""
    keys = "family", "bias", "projector_scale", "facing_bit"
    return next(row for row in maps if tuple(row[key] for key in keys) == setting)


def _legend(axis: Any) -> None:
    handles = [legend_mark(name, marker, _GREY, _EDGE, 7) for marker, name in _FAMILIES.values()]
    handles += [legend_mark(f"image ×{scale:g}", "o", _GREY, _EDGE, area**0.5) for scale, area in _SIZES.items()]
    handles += [
        legend_mark("no facing bit", "o", "none", _EDGE, 7),
        legend_mark("NumPy: none is better in all\nthree, error, time and bytes", "o", _ON_FRONT, "black", 7),
        legend_mark("compiled", "o", _COMPILED, "black", 7),
        legend_line("front of this panel, NumPy", color="black", linestyle="--", linewidth=1),
        legend_line("front of this panel, compiled", color="black", linewidth=1),
    ]
    axis.legend(handles=handles, loc="upper left", fontsize=9, framealpha=1, edgecolor="none", borderaxespad=0.2)


def _scenes(axis: Any, figures: Row, maps: list[Row]) -> None:
    names = list(figures["scenes"])
    for index, ((*setting, label), (marker, face, edge)) in enumerate(zip(_BY_SCENE, _SCENE_STYLES, strict=True)):
        row = _find(maps, tuple(setting))
        positions = [position + (index - len(_BY_SCENE) / 2 + 0.5) * 0.1 for position in range(len(names))]
        values = [row["scenes"][name] for name in names]
        axis.scatter(
            values,
            positions,
            s=90 if label == "default" else 55,
            marker=marker,
            facecolors=face,
            edgecolors=edge,
            linewidths=0.9,
            label=label,
            zorder=3,
        )
    axis.set_xscale("log")
    axis.set_xlim(0.0008, 1.2)
    axis.minorticks_off()
    axis.set_xticks([0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1], ["0.1 %", "0.3 %", "1 %", "3 %", "10 %", "30 %", "100 %"])
    axis.set_yticks(
        range(len(names)),
        [f"{name}\n({figures['scenes'][name]['pixels'] / 1e6:.3f} million pixels)" for name in names],
        fontsize=9,
    )
    axis.set_ylim(len(names) - 0.45, -0.55)
    for position in range(1, len(names)):
        axis.axhline(position - 0.5, color="#dddddd", linewidth=0.8)
    axis.axvline(_LIMIT, color="black", linewidth=0.7, linestyle=":")
    axis.grid(axis="x", color="#ececec", linewidth=0.6)
    axis.set_axisbelow(True)
    axis.spines[["top", "right"]].set_visible(False)
    axis.set_xlabel("pixels of the scene that are wrong", fontsize=10)
    axis.set_title("Where it is hard: error scene by scene", loc="left", fontsize=11)
    axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=9, frameon=False)
