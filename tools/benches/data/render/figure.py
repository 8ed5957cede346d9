"""Draws what `tools/bench render` measured: `--figure FILE.png`."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from bodyseg_data.drawing import new_chart, save_chart

_OURS: Final = "#1f5ac8"
_PLAIN: Final = "#9a9aa2"
_STAGES: Final = {
    "build": "#c7b198",
    "partition": "#a58a6c",
    "camera": "#1f5ac8",
    "projector": "#6a9bf0",
    "labels": "#2e9e6b",
    "encode": "#e08a1e",
    "write": "#f3c173",
}


def draw_render(figures: dict[str, Any], path: Path) -> None:
    """Write a PNG of `bench_render`'s results: both ways' speed, the stages, the steps.

    Raises MissingLibrary without matplotlib, BadConfig if the file cannot be written.
    """
    figure = new_chart(11, 7.2)
    rows: Any = figure.subplots(3, 1, height_ratios=(2.3, 2.2, len(figures["steps"]) + 0.6))
    _speed(rows[0], figures)
    _stages(rows[1], figures)
    _steps(rows[2], figures["steps"])
    for axis in rows:
        axis.spines[["top", "right"]].set_visible(False)
    save_chart(figure, path, dpi=120)


def _speed(axis: Any, figures: dict[str, Any]) -> None:
    speed, size = figures["views_per_second"], figures["bytes_per_view"]
    names = {"ours": "bodyseg shard", "plain": "pyrender, three frames,\nPNG files"}
    for position, (way, colour) in enumerate((("ours", _OURS), ("plain", _PLAIN))):
        value = speed[way] or 0.0
        axis.barh(position, value, color=colour, height=0.62)
        text = f"{value:.1f}   ({size[way] / 1000:.0f} kB a view)" if speed[way] else "pyrender cannot draw here"
        axis.text(value, position, f" {text}", va="center", fontsize=10)
    axis.set_yticks([0, 1], names.values(), fontsize=10)
    axis.set_ylim(1.5, -0.5)
    axis.set_xlim(0, 1.25 * max(value or 0.0 for value in speed.values()))
    times = "" if figures["times_faster"] is None else f": {figures['times_faster']:.1f} times as fast"
    axis.set_title(
        f"Views a second, {figures['workers']} processes, from meshes to files{times}", loc="left", fontsize=11
    )


def _stages(axis: Any, figures: dict[str, Any]) -> None:
    left, stages = 0.0, figures["stages"]
    total = sum(stages.values())
    for name, colour in _STAGES.items():
        value = stages[name]
        axis.barh(0, value, left=left, color=colour, height=0.5, label=f"{name} {value:.1f}")
        left += value
    axis.set_yticks([])
    axis.set_ylim(-1.5, 0.45)
    axis.set_xlim(0, total)
    axis.legend(loc="lower left", ncols=4, fontsize=9, frameon=False, handlelength=1)
    axis.set_title(
        f"Where packing spends its {total:.1f} ms of processor a view (the body's share of a view in brown)",
        loc="left",
        fontsize=11,
    )
    axis.spines["left"].set_visible(False)
    axis.set_xticks([])
    axis.spines["bottom"].set_visible(False)


def _steps(axis: Any, steps: list[dict[str, Any]]) -> None:
    longest = max(step["ms_per_view"] for step in steps)
    for position, step in enumerate(steps):
        value = step["ms_per_view"]
        saved = value - steps[position - 1]["ms_per_view"] if position else 0.0
        axis.barh(position, value, color=_OURS if position == len(steps) - 1 else "#a9bfe8", height=0.62)
        change = f"  {saved:+.1f} ms" if position else ""
        axis.text(
            value, position, f" {value:.1f} ms{change}, {step['bytes_per_view'] / 1000:.0f} kB", va="center", fontsize=9
        )
    axis.set_yticks(range(len(steps)), [step["name"] for step in steps], fontsize=10)
    axis.set_ylim(len(steps) - 0.5, -0.6)
    axis.set_xlim(0, 1.28 * longest)
    axis.set_xlabel("ms of processor a view: rays, labels, encoding", fontsize=10)
    axis.set_title("What each saving brings, each step with those above it", loc="left", fontsize=11)
