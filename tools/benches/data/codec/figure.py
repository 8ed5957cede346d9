"""Draws what `tools/bench codec` measured: `--figure FILE.png`."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from bodyseg_data.drawing import new_chart, save_chart

_OURS: Final = "#1f5ac8"
_OTHERS: Final = "#77777f"
_FRONT: Final = "#e08a1e"
_BESIDE: Final = {"xytext": (7, -3), "ha": "left"}
_LEFT: Final = {"xytext": (-7, -3), "ha": "right"}
_PLACES: Final = {
    "bsi, compiled": {"xytext": (-8, -18), "ha": "left"},
    "bsi, NumPy": {"xytext": (0, -18), "ha": "center"},
    "zstd 9": _LEFT,
    "two-way zigzag, bytes, zstd 1": _LEFT,
}
"""Where names go that others stand beside."""


def draw_codec(figures: dict[str, Any], path: Path) -> None:
    """Write a PNG of `bench_codec`'s results: bytes against decoding time, with the front.

    Raises MissingLibrary without matplotlib, BadConfig if the file cannot be written.
    """
    figure = new_chart(10.5, 7)
    axis: Any = figure.subplots()
    rows = figures["codecs"]
    ends = sorted((rows[name]["decode_ms"], rows[name]["bytes"] / 1000) for name in figures["front"])
    axis.step(*zip(*ends, strict=True), _FRONT, where="post", linewidth=6, alpha=0.35, label="the front", zorder=1)
    for name, row in rows.items():
        ours = name.startswith("bsi")
        point = row["decode_ms"], row["bytes"] / 1000
        axis.scatter(*point, s=70 if ours else 28, color=_OURS if ours else _OTHERS, zorder=3)
        text = f"{name} (the default)" if name == figures["default"] else name
        place = _PLACES.get(name, _BESIDE)
        axis.annotate(text, point, textcoords="offset points", fontsize=9, color=_OURS if ours else "black", **place)
    axis.set_xscale("log")
    axis.set_xlabel("decoding a sample's three images, ms of processor")
    axis.set_ylabel("kB a sample, three images")
    axis.set_ylim(0, 1.08 * max(row["bytes"] for row in rows.values()) / 1000)
    low, high = (pick(row["decode_ms"] for row in rows.values()) for pick in (min, max))
    axis.set_xlim(0.7 * low, 2.6 * high)
    axis.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axis.set_title(f"Lossless codecs on {figures['views']} samples of bare and dressed bodies", loc="left", fontsize=12)
    axis.spines[["top", "right"]].set_visible(False)
    axis.grid(alpha=0.25)
    axis.legend(loc="lower left", frameon=False)
    save_chart(figure, path, dpi=120)
