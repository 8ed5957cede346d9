"""Draws what `tools/bench segment` measured: `--figure FILE.png`."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from benches.model.segment.bench import STAGES
from bodyseg_data.drawing import new_chart, save_chart

Tree = dict[str, Any]

_COLOURS: Final = ("#8a8a8a", "#1f4fa8", "#5b8ad6", "#c25a00", "#3b7d4f", "#d8d8de")
"""Of the stages, in their order."""


def draw_segment(figures: Tree, path: Path) -> None:
    """Write a PNG of `bench_segment`'s results: for every size, time by stage beside people found and labels right.

    Raises MissingLibrary without matplotlib, BadConfig if the file cannot be written.
    """
    sizes = figures["sizes"]
    figure = new_chart(11, 1.2 + 2.8 * len(sizes))
    rows = figure.subplots(len(sizes), 2, gridspec_kw={"width_ratios": (2.2, 1)}, squeeze=False)
    for (times, shares), (name, size) in zip(rows, sizes.items(), strict=True):
        _stages(times, name, size["ways"])
        _accuracy(shares, size["ways"])
    handles, names = rows[0][0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=len(STAGES), frameon=False)
    save_chart(figure, path, dpi=110)


def _stages(axis: Any, name: str, ways: Tree) -> None:
    for position, way in enumerate(ways.values()):
        left = 0.0
        for stage, colour in zip(STAGES, _COLOURS, strict=True):
            beside = stage == "write"  # in a thread of its own
            mean = way["ms"][stage]["mean"]
            axis.barh(
                position + 0.3 * beside,
                mean,
                left=0.0 if beside else left,
                height=0.2 if beside else 0.4,
                color=colour,
                label="_" if position else "write, beside the next frame" if beside else stage,
            )
            left += 0.0 if beside else mean
        text = f" P95 {way['ms']['frame']['p95']:.0f} ms, {way['frames_per_second']:.0f} a second"
        axis.text(left, position, text, va="center", fontsize=8)
    axis.set_yticks(range(len(ways)), list(ways))
    axis.set_ylim(len(ways) - 0.4, -0.5)
    axis.set_xlim(0, 1.45 * max(way["ms"]["frame"]["mean"] for way in ways.values()))
    axis.set_title(f"{name}: mean ms from a frame to its labels (float32 unless named)", loc="left", fontsize=10)
    axis.spines[["top", "right"]].set_visible(False)


def _accuracy(axis: Any, ways: Tree) -> None:
    for position, way in enumerate(ways.values()):
        axis.plot(100 * way["right"], position, "o", color="#1f4fa8")
        found = f"found {way['found']} of {way['people']} people"
        axis.text(0.02, position + 0.32, found, fontsize=8, transform=axis.get_yaxis_transform())
    axis.set_ylim(len(ways) - 0.4, -0.5)
    axis.set_yticks([])
    axis.set_xlim(0, 100)
    axis.set_title("% of people's pixels labelled right", loc="left", fontsize=10)
    axis.grid(axis="x", color="#e4e4e8", linewidth=0.8)
    axis.spines[["top", "right"]].set_visible(False)
