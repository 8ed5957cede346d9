"""Draws what `tools/bench quantisation` measured: `--figure FILE.png`."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from bodyseg_data.drawing import new_chart, save_chart

_DEFAULT: Final = "#1f5ac8"
_OTHERS: Final = "#77777f"
_LIMIT: Final = "#e08a1e"

_PANELS: Final = (
    ("bytes", 1e-3, "kB a sample, three images"),
    ("wrong_pixels", 100, "pixels with a wrong shadow, %"),
)
"""Figure of a step, factor to the unit drawn, caption."""


def draw_quantisation(figures: dict[str, Any], path: Path) -> None:
    """Write a PNG of `bench_quantisation`'s results: bytes and wrong shadows against the step.

    Raises MissingLibrary without matplotlib, BadConfig if the file cannot be written.
    """
    figure = new_chart(8, 4.2)
    axes: Any = figure.subplots(1, len(_PANELS))
    steps = {float(name): row for name, row in figures["steps"].items()}
    for axis, (key, factor, caption) in zip(axes, _PANELS, strict=True):
        values = {step: factor * row[key] for step, row in steps.items()}
        axis.plot(list(values), list(values.values()), color=_OTHERS, linewidth=1, zorder=1)
        for step, value in values.items():
            default = step == float(figures["default"])
            axis.scatter(step, value, s=70 if default else 28, color=_DEFAULT if default else _OTHERS, zorder=3)
            text = f"{value:.3g}"
            axis.annotate(text, (step, value), textcoords="offset points", xytext=(0, 8), ha="center", fontsize=9)
        top = max(values.values())
        if key == "wrong_pixels":
            top = max(top, factor * figures["limit"])
            axis.axhline(factor * figures["limit"], color=_LIMIT, linewidth=1.5)
        axis.set_xscale("log")
        axis.set_xticks(list(values), [f"{step:g}" for step in values], minor=False)
        axis.set_xticks([], minor=True)
        axis.set_xlabel("step of stored range, mm")
        axis.set_title(caption, loc="left", fontsize=10)
        axis.set_ylim(0, 1.2 * (top or 1))
        axis.spines[["top", "right"]].set_visible(False)
        axis.grid(alpha=0.25)
    figure.suptitle(
        f"Step of stored range, {figures['views']} views; blue: the default rig's; orange: the limit", fontsize=11
    )
    save_chart(figure, path, dpi=110)
