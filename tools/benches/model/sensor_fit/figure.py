"""Draws what `tools/bench sensor_fit` measured: `--figure FILE.png`."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from benches.charts.legends import legend_line
from bodyseg_data.drawing import new_chart, save_chart

Tree = dict[str, Any]

_COLOURS: Final = ("#8a8a8a", "#c25a00", "#1f4fa8", "#5b8c3a")
_LIMIT: Final = 0.5  # larger errors, and artifacts that were not found, stand at the edge


def draw_sensor_fit(figures: Tree, path: Path) -> None:
    """Write a PNG of `bench_sensor_fit`'s results: the relative error of every figure in every scene.

    A hollow mark at the edge: not found, or farther off. Raises MissingLibrary without matplotlib, BadConfig if the
    file cannot be written.
    """
    rows = [(row["case"], row["scene"], each) for row in figures["rows"] for each in row["figures"]]
    names = list(dict.fromkeys(f"{case}: {each['figure']}" for case, _, each in rows))
    scenes = list(dict.fromkeys(scene for _, scene, _ in rows))
    figure = new_chart(8.5, 1.2 + 0.23 * len(names))
    axis = figure.subplots()
    axis.axvspan(-figures["within"], figures["within"], color="#e9eee4", zorder=0)
    axis.axvline(0, color="#8a8a8a", linewidth=0.8, zorder=1)
    for case, scene, each in rows:
        error, place = each["error"], scenes.index(scene)
        off = error is None or abs(error) > _LIMIT
        x = _LIMIT if error is None else max(-_LIMIT, min(_LIMIT, error))
        y = names.index(f"{case}: {each['figure']}") + 0.16 * (place - (len(scenes) - 1) / 2)
        colour = _COLOURS[place % len(_COLOURS)]
        axis.plot(x, y, "o", color=colour, markerfacecolor="white" if off else colour, markersize=4.5, zorder=3)
    axis.set_yticks(range(len(names)), names, fontsize=8)
    axis.set_ylim(len(names) - 0.4, -0.6)
    axis.set_xlim(-_LIMIT * 1.06, _LIMIT * 1.06)
    within = f"shaded: within {figures['within']:.0%}; hollow: not found, or farther off"
    axis.set_xlabel(f"relative error of the strength found ({within})")
    axis.grid(axis="y", color="#eeeeee", linewidth=0.6)
    axis.spines[["top", "right"]].set_visible(False)
    handles = [
        legend_line(_caption(scene), color=_COLOURS[place % len(_COLOURS)], marker="o", linestyle="")
        for place, scene in enumerate(scenes)
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=len(handles), frameon=False)
    save_chart(figure, path, dpi=110)


def _caption(scene: str) -> str:
    """A scene's name in the legend; of one frame, nothing can be said to move."""
    count = scene.split()[0]
    return "1 frame" if count == "1" else f"{scene.replace(' ', ' frames, ')}"
