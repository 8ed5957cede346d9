"""Draws what `tools/bench loader` measured: `--figure FILE.png`."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from benches.charts.scales import thousands
from bodyseg_data.drawing import new_chart, save_chart

_OURS: Final = "#1f5ac8"
_OTHERS: Final = "#6e6e76"
_TITLES: Final = {
    "ours_none": "bodyseg, none",
    "ours_occ": "bodyseg, occ",
    "ours_noise": "bodyseg, noise",
    "ours_md": "bodyseg, md",
    "ours_all": "bodyseg, all: made on the fly",
    "ours_all_batch_sampler": "the same, DataLoader, batch_sampler",
    "ours_all_dataloader": "the same, DataLoader, plain indices",
    "ours_all_wrapped": "the same, in a user's data set",
    "ours_all_transform": "the same, with flips",
    "ours_all_labels": "the same, with 14 classes",
    "memory": "float32 tensors in memory",
    "memory_threads": "the same, by threads",
    "mds_raw": "MosaicML Streaming, raw",
    "mds_zstd": "MosaicML Streaming, zstd",
    "litdata": "LitData, raw",
    "hf_parquet": "Hugging Face datasets, Parquet, raw",
    "webdataset_raw": "WebDataset, raw",
    "webdataset_raw_threads": "the same, in threads",
    "webdataset_zstd": "WebDataset, zstd",
    "webdataset_png": "WebDataset, PNG",
    "webdataset_png_threads": "the same, PNG in threads",
    "hf_webdataset": "Hugging Face datasets, tars, PNG",
    "png_files": "loose PNG files",
}
"""In the order of the rows, from the top."""


def draw_loader(figures: dict[str, Any], path: Path) -> None:
    """Write a PNG of `bench_loader`'s results: samples a second beside bytes a sample, a row for each loader.

    Raises MissingLibrary without matplotlib, BadConfig if the file cannot be written.
    """
    figure = new_chart(12.5, 7.6)
    speed, size = figure.subplots(1, 2, width_ratios=(3, 1.35), sharey=True)
    _speeds(speed, figures)
    _sizes(size, figures)
    for axis in (speed, size):
        axis.spines[["top", "right", "left"]].set_visible(False)
        axis.tick_params(axis="y", length=0)
    save_chart(figure, path, dpi=120)


def _speeds(axis: Any, figures: dict[str, Any]) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    speeds = figures["samples_per_second"]
    counts = list(next(iter(speeds.values())))
    for position, name in enumerate(_TITLES):
        colour = _colour(name)
        axis.axhline(position, color="#e4e4e8", linewidth=0.8, zorder=0)
        values = [speeds[name][count] for count in counts]
        if None in values:
            axis.text(0.02, position, "not installed", transform=axis.get_yaxis_transform(), va="center", fontsize=9)
            continue
        axis.plot(values, [position] * len(values), color=colour, linewidth=2.2, zorder=1)
        # The more workers, the darker the inside of a dot.
        for number, value in enumerate(values):
            full = number / max(1, len(values) - 1)
            axis.plot(value, position, "o", markersize=9, color=colour, fillstyle="full", zorder=2)
            axis.plot(value, position, "o", markersize=6, color="white", alpha=1 - full, zorder=3)
        order = sorted(values)
        axis.annotate(
            thousands(order[0]),
            (order[0], position),
            (-8, 0),
            textcoords="offset points",
            ha="right",
            va="center",
            fontsize=9,
        )
        if len(values) > 1:
            axis.annotate(
                thousands(order[-1]), (order[-1], position), (8, 0), textcoords="offset points", va="center", fontsize=9
            )
    axis.set_xscale("log")
    low, high = axis.get_xlim()
    axis.set_xlim(low / 1.25, high * 1.35)
    axis.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: thousands(value)))
    axis.xaxis.set_minor_formatter(NullFormatter())
    axis.set_yticks(range(len(_TITLES)), _TITLES.values(), fontsize=10)
    axis.set_ylim(len(_TITLES) - 0.5, -0.5)
    for label, name in zip(axis.get_yticklabels(), _TITLES, strict=True):
        label.set_fontweight("bold" if name == "ours_all" else "normal")
    shades = "hollow: no workers, full: 2" if counts == ["0", "2"] else f"hollow to full: {', '.join(counts)} workers"
    axis.set_title(f"Samples a second, batches of {figures['batch']} ({shades})", loc="left", fontsize=11)


def _sizes(axis: Any, figures: dict[str, Any]) -> None:
    kept, sent = figures["kept_bytes_per_sample"], figures["bytes_per_sample"]
    most = max(value for value in kept.values() if value is not None) / 1000
    for position, name in enumerate(_TITLES):
        if kept[name] is None:
            continue
        value = kept[name] / 1000
        axis.barh(position, value, color=_colour(name), height=0.5)
        text = f" {thousands(value)}"
        if kept[name] > 1.02 * sent[name]:
            text += f" ({thousands(sent[name] / 1000)} compressed)"
        inside = value > 0.55 * most
        axis.text(
            value, position, text + " " * inside, va="center", fontsize=9,
            ha="right" if inside else "left", color="white" if inside else "black",
        )  # fmt: skip
    axis.set_xlim(0, 1.05 * most)
    axis.set_title("kB a sample, on disk or in memory", loc="left", fontsize=11)


def _colour(name: str) -> str:
    return _OURS if name.startswith("ours") else _OTHERS
