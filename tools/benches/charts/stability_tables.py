"""Tables of `bodyseg stability` for people: each row is a record of text whose keys are the columns' titles."""

from __future__ import annotations

import statistics
from collections.abc import Mapping
from typing import Any, Final

FORMAT: Final = "bodyseg stability 1"
"""Of the files that tables are made of."""

Rows = list[dict[str, str]]
_NONE = "–"


def tables(figures: Mapping[str, Any]) -> dict[str, Rows]:
    """Make the tables of the parts that `figures`, the content of stability.json, has."""
    found = {}
    if "groups" in figures:
        found["images"] = [_images(label, group, figures) for label, group in figures["groups"].items()]
        found["sweeps"] = [_sweep(name, figures) for name in figures["sweeps"]]
        found["falls"] = [_falls(name, figures) for name in figures["sweeps"]]
    if "temporal" in figures:
        groups = figures["temporal"]["groups"].items()
        found["motion"] = [_motion(label, variant, row) for label, of in groups for variant, row in of.items()]
    return found


def _images(label: str, group: Mapping[str, Any], figures: Mapping[str, Any]) -> dict[str, str]:
    worst = group["worst"]
    sweep = figures["sweeps"][worst["sweep"]]
    accuracy = _percent(_at(group["curves"][worst["sweep"]], sweep["strengths"].index(worst["strength"])))
    return {
        "network": label,
        "clean, %": _percent(group["clean"].get("stored")),
        **_gross_errors(group),
        "mCE": _number(group["mce"]),
        "mRR": _number(group["mrr"]),
        "worst case": f"{sweep['title']}, {worst['strength']:g}: {accuracy} %",
    }


def _gross_errors(group: Mapping[str, Any]) -> dict[str, str]:
    """Column of clean gross errors, of files that have any."""
    curves = [curve for curve in group.get("gross_errors", {}).values() if curve is not None]
    return {"clean, gross errors (30 mm), %": _percent(_at(curves[0]["beyond_30_mm"], 0))} if curves else {}


def _sweep(name: str, figures: Mapping[str, Any]) -> dict[str, str]:
    """Accuracy at the greatest strength of one sweep, by group."""
    sweep = figures["sweeps"][name]
    return {
        "corruption": f"{sweep['title']}, {sweep['axis']}",
        "strongest": f"{sweep['strengths'][-1]:g}",
        **{label: _percent(_at(group["curves"][name], -1)) for label, group in figures["groups"].items()},
    }


def _falls(name: str, figures: Mapping[str, Any]) -> dict[str, str]:
    """Strength of one sweep at which accuracy falls below the bound, by group."""
    sweep = figures["sweeps"][name]
    clean, strongest = sweep["strengths"][0], sweep["strengths"][-1]
    row = {"corruption": f"{sweep['title']}, {sweep['axis']}", "from, to": f"{clean:g}, {strongest:g}"}
    for label, group in figures["groups"].items():
        falls = group["falls_below_bound_at"][name]
        row[label] = "never" if falls["mean"] is None else "when clean" if falls["mean"] == clean else _strength(falls)
    return row


def _strength(falls: Mapping[str, Any]) -> str:
    """Strength for the mean curve, and the standard deviation over seeds unless one never falls below the bound."""
    seeds = falls["seeds"]
    spread = "" if len(seeds) < 2 or None in seeds else f" ± {statistics.stdev(seeds):.2g}"
    return f"{falls['mean']:.3g}{spread}"


def _at(curve: Mapping[str, Any], index: int) -> dict[str, Any]:
    return {"mean": curve["mean"][index], "sd": curve["sd"][index]}


def _motion(label: str, variant: str, row: Mapping[str, Any]) -> dict[str, str]:
    return {
        "network": label,
        "frames": variant,
        "TC, %": _percent(row["tc"]),
        "VC₈ constant, %": _percent(row["vc"]),
        "VC₈ constant and right, %": _percent(row["vc_right"]),
        "where the truth stays, %": _percent(row["vc_right_where_truth_stays"]),
        "accuracy, %": _percent(row["accuracy"]),
        "pixels right, %": _percent(row["pixel_accuracy"]),
    }


def _percent(value: Mapping[str, Any] | None) -> str:
    return _NONE if value is None else _with_spread(100 * value["mean"], value["sd"] and 100 * value["sd"], 1)


def _number(value: Mapping[str, Any] | None) -> str:
    return _NONE if value is None else _with_spread(value["mean"], value["sd"], 3)


def _with_spread(mean: float, sd: float | None, decimals: int) -> str:
    return f"{mean:.{decimals}f}" + ("" if sd is None else f" ± {sd:.{decimals}f}")
