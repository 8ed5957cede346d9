"""Draws what `tools/bench runtimes` measured: `--figure FILE.png`."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from bodyseg_data.drawing import new_chart, save_chart

Tree = dict[str, Any]

_MARKS: Final = {"torch": "o", "onnxruntime": "s", "openvino": "^"}
_COLOURS: Final = {"float32": "#1f4fa8", "bfloat16": "#c25a00", "int8": "#2a8a5a"}


def draw_runtimes(figures: Tree, path: Path) -> None:
    """Write a PNG of `bench_runtimes`'s results: accuracy over milliseconds of a frame that a body fills, all threads.

    Raises MissingLibrary without matplotlib, BadConfig if the file cannot be written.
    """
    row = [row for row in figures["times"] if row["frame"] == "filled"][-1]
    figure = new_chart(8, 4.6)
    axis = figure.subplots()
    points = sorted(
        (row["networks"][name]["ms"], facts["average_per_class_accuracy"], name)
        for name, facts in figures["networks"].items()
    )
    for number, (ms, accuracy, name) in enumerate(points):
        backend, precision = name.split(" ")
        axis.plot(ms, accuracy, _MARKS[backend], color=_COLOURS[precision], markersize=8)
        away = -17 if number % 2 else 9  # names of neighbours stand above and below
        axis.annotate(name, (ms, accuracy), xytext=(0, away), textcoords="offset points", fontsize=9, ha="center")
    axis.margins(y=0.15)
    axis.set_xlim(0, 1.15 * points[-1][0])
    axis.set_xlabel(f"ms from {figures['rows']} x {figures['columns']} ranges to labels, {row['threads']} threads")
    axis.set_ylabel(f"average per-class accuracy, {figures['test_images']} images")
    axis.grid(color="#e4e4e8")
    save_chart(figure, path, dpi=110)
