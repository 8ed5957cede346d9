"""Draws what `tools/bench sensors` measured: `--figure FILE.png`."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from benches.charts.legends import legend_line
from bodyseg_data.drawing import new_chart, save_chart

Tree = dict[str, Any]

_COLOURS: Final = {"turned and scaled": "#1f4fa8", "scaled": "#c25a00", "as it is": "#4d4d4d"}
_DASHES: Final[tuple[Any, ...]] = ("-", (0, (4, 2)), (0, (1, 1.5)))
_ALL_IN_VIEW: Final = 0.99


def draw_sensors(figures: Tree, path: Path) -> None:
    """Write a PNG of `bench_sensors`'s results: accuracy over distance and over direction.

    A hollow mark: a part of the bodies is out of view. Raises MissingLibrary without matplotlib, BadConfig if the file
    cannot be written.
    """
    known, *scenes = figures["scenes"]
    names = list(dict.fromkeys(scene["sensor"] for scene in scenes))
    figure = new_chart(11.5, 5.4)
    left, right = figure.subplots(1, 2, sharey=True)
    aside = {scene["distance_m"] for scene in scenes if scene["turn_deg"]}
    _curves(left, [scene for scene in scenes if not scene["turn_deg"]], names, "distance_m")
    _curves(right, [scene for scene in scenes if scene["distance_m"] in aside], names, "turn_deg")
    left.set_xlabel("distance to the body's middle, m (it stands on the camera's axis)")
    right.set_xlabel(f"degrees between the camera's axis and the body ({', '.join(f'{far:g} m' for far in aside)})")
    left.set_ylabel("average per-class accuracy")
    top = max(known["accuracy"].values())
    for axis in (left, right):
        axis.axhline(top, color="#8a8a8a", linewidth=0.9, linestyle=(0, (6, 2)), zorder=1)
        axis.set_ylim(0, 1)
        axis.grid(axis="y", color="#e4e4e8", linewidth=0.8)
        axis.spines[["top", "right"]].set_visible(False)
    figure.legend(handles=_handles(names, known, top), loc="outside lower center", ncols=3, frameon=False)
    save_chart(figure, path, dpi=110)


def _curves(axis: Any, scenes: list[Tree], names: list[str], key: str) -> None:
    for name, dashes in zip(names, _DASHES, strict=False):
        row = sorted((scene for scene in scenes if scene["sensor"] == name), key=lambda scene: float(scene[key]))
        for method, colour in _COLOURS.items():
            x, y = [scene[key] for scene in row], [scene["accuracy"][method] for scene in row]
            axis.plot(x, y, color=colour, linestyle=dashes, linewidth=1.6, zorder=2)
            for scene in row:
                face = colour if scene["in_view"] >= _ALL_IN_VIEW else "white"
                axis.plot(scene[key], scene["accuracy"][method], "o", color=colour, markerfacecolor=face, zorder=3)


def _handles(names: list[str], known: Tree, top: float) -> list[Any]:
    lines = [legend_line(method, color=colour, linewidth=3) for method, colour in _COLOURS.items()]
    pairs = zip(names, _DASHES, strict=False)
    lines += [legend_line(name, color="#4d4d4d", linestyle=dashes) for name, dashes in pairs]
    reference = f"{known['sensor']} camera at {known['distance_m']:g} m: {top:.1%}"
    lines.append(legend_line(reference, color="#8a8a8a", linewidth=0.9, linestyle=(0, (6, 2))))
    hollow = legend_line("cut by the frame", color="#4d4d4d", marker="o", markerfacecolor="white", linestyle="")
    return [*lines, hollow]
