"""Handles of legends."""

from __future__ import annotations

from typing import Any


def legend_mark(label: str, marker: str, face: str, edge: str, size: float) -> Any:
    """A marker without a line: its faces' and edges' colours, its size in points."""
    return legend_line(label, linestyle="", marker=marker, markerfacecolor=face, markeredgecolor=edge, markersize=size)


def legend_line(label: str, **style: Any) -> Any:
    """A line, or whatever its style makes of it, with matplotlib's names of styles."""
    from matplotlib.lines import Line2D

    return Line2D([], [], label=label, **style)
