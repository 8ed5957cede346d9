"""Draws what `tools/bench workers` measured: `--figure FILE.png`."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from benches.charts.scales import thousands
from bodyseg_data.drawing import new_chart, save_chart

_METHODS: Final = {
    "none": ("no workers", "#6e6e76"),
    "thread": ("threads (the default)", "#1f5ac8"),
    "fork": ("processes, fork", "#d9822b"),
    "forkserver": ("processes, forkserver", "#8c4a9e"),
}


def draw_workers(figures: dict[str, Any], path: Path) -> None:
    """Write a PNG of `bench_workers`' results: speed, processor time and peak memory, a bar for each loader.

    Raises MissingLibrary without matplotlib, BadConfig if the file cannot be written.
    """
    variants = list(dict.fromkeys(row["variant"] for row in figures["rows"]))
    panels = {
        "samples_per_second": "Samples a second",
        "processor_ms_per_sample": "Processor time, ms a sample",
        "peak_mb": "Peak memory with workers, MB",
    }
    figure = new_chart(12, 1.2 + 2.6 * len(variants))
    axes = figure.subplots(len(variants), len(panels), squeeze=False)
    for line, variant in zip(axes, variants, strict=True):
        rows = [row for row in figures["rows"] if row["variant"] == variant]
        for axis, (field, title) in zip(line, panels.items(), strict=True):
            _bars(axis, rows, field)
            axis.set_title(f"{title}: variant {variant}", loc="left", fontsize=11)
    handles, labels = axes[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(_METHODS), frameon=False)
    save_chart(figure, path, dpi=120)


def _bars(axis: Any, rows: list[dict[str, Any]], field: str) -> None:
    counts = sorted({row["workers"] for row in rows})
    named = set()
    for place, count in enumerate(counts):
        here = [row for row in rows if row["workers"] == count]
        for number, row in enumerate(here):
            name, colour = _METHODS[row["method"]]
            value = row[field] or 0.0
            left = place + (number - (len(here) - 1) / 2) * 0.27
            axis.bar(left, value, 0.25, color=colour, label=None if name in named else name)
            text = f"{value:.2f}" if field.startswith("processor") else thousands(value)
            axis.annotate(text, (left, value), (0, 2), textcoords="offset points", ha="center", fontsize=8)
            named.add(name)
    axis.set_xticks(range(len(counts)), [f"{count or 'no'} workers" for count in counts])
    axis.spines[["top", "right"]].set_visible(False)
    axis.margins(y=0.12)
