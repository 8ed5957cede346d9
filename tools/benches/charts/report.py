"""Content of a chart as plain JSON: for pages that quote it, and for their tests."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from benches.charts.choice import Choice, Panel
from benches.charts.fronts import Axis, Point, front, shortfalls


def described(choice: Choice, panels: Sequence[Panel], sources: Sequence[dict[str, str]]) -> dict[str, Any]:
    """A chart's axes, panels and sources.

    Values are in the units of the bench's figures; `factor` makes the chart's.
    """
    return {
        "title": choice.title,
        "x": _axis(choice.x),
        "y": _axis(choice.y),
        "panels": [_panel(choice, panel) for panel in panels],
        "sources": [*sources],
    }


def _axis(axis: Axis) -> dict[str, Any]:
    return {"title": axis.title, "better": "more" if axis.more_is_better else "less", "factor": axis.factor}


def _panel(choice: Choice, panel: Panel) -> dict[str, Any]:
    best = [point.name for point in front(panel.points, choice.x, choice.y)]
    default = next((point for point in panel.points if point.name == panel.default), None)
    falls = shortfalls(default, panel.points, choice.x, choice.y) if default is not None else ()
    return {
        "name": panel.name,
        "default": panel.default,
        "default_on_front": None if default is None else default.name in best,
        "default_beaten_by": [
            {
                "name": fall.better.name,
                "x_better_by_share": round(fall.x_share, 6),
                "y_better_by_share": round(fall.y_share, 6),
            }
            for fall in falls
        ],
        "front": best,
        "points": [_point(point, point.name in best) for point in panel.points],
        "limits": [{"name": limit.name, "x": float(limit.x)} for limit in panel.limits],
    }


def _point(point: Point, on_front: bool) -> dict[str, Any]:
    spread = {} if point.y_sd is None else {"y_sd": point.y_sd}
    label = point.label.replace("\n", " ")
    place = {"x": float(point.x), "y": float(point.y)}
    return {"name": point.name, "label": label, **place, **spread, "on_front": on_front}
