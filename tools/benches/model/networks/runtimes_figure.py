"""Draws what `tools/bench runtimes` measured: `--figure FILE.png`."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from bodyseg_data.drawing import new_chart, save_chart

Tree = dict[str, Any]

_COLOURS: Final = {"float32": "#1f4fa8", "bfloat16": "#c25a00", "int8": "#2a8a5a"}


def draw_runtimes(figures: Tree, path: Path) -> None:
    """Write a PNG of `bench_runtimes`'s results: milliseconds of a frame that a body fills, all threads, and accuracy.

    Raises MissingLibrary without matplotlib, BadConfig if the file cannot be written.
    """
    row = [row for row in figures["times"] if row["frame"] == "filled"][-1]
    times = {name: row["networks"][name]["ms"] for name in figures["networks"]}
    figure = new_chart(8, 0.9 + 0.4 * len(times))
    axis = figure.subplots()
    axis.barh(list(times), list(times.values()), color=[_COLOURS[name.split(" ")[1]] for name in times], height=0.6)
    for name, facts in figures["networks"].items():
        text = f"{times[name]:.1f} ms, {100 * facts['average_per_class_accuracy']:.2f} % right"
        axis.annotate(text, (times[name], name), xytext=(5, 0), textcoords="offset points", fontsize=9, va="center")
    axis.invert_yaxis()
    axis.set_xlim(0, 1.35 * max(times.values()))
    axis.set_xlabel(f"ms from {figures['rows']} x {figures['columns']} ranges to labels, {row['threads']} threads")
    axis.set_title(f"% right: average per class, {figures['test_images']} images", loc="left", fontsize=10)
    axis.grid(axis="x", color="#e4e4e8")
    axis.set_axisbelow(True)
    axis.spines[["top", "right"]].set_visible(False)
    save_chart(figure, path, dpi=110)
