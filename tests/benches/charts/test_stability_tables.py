"""What stability.json says, as rows to read."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from benches.charts.stability_tables import tables
from benches.results.page import render_page

from bodyseg_data.core import BadConfig


def over_seeds(*values: float) -> dict[str, Any]:
    mean = sum(values) / len(values)
    return {"mean": mean, "sd": 0.01 if len(values) > 1 else None, "seeds": [*values]}


GROUP = {
    "clean": {"stored": over_seeds(0.8, 0.9)},
    "curves": {
        "noise": {"mean": [0.85, 0.5], "sd": [0.01, 0.02]},
        "tilt": {"mean": [0.8, 0.7], "sd": [0.01, 0.01]},
        "hard": {"mean": [0.5, 0.4], "sd": [None, None]},
    },
    "falls_below_bound_at": {
        "noise": {"mean": 72.5, "seeds": [71.5, 73.5]},
        "tilt": {"mean": None, "seeds": [None, None]},
        "hard": {"mean": 0, "seeds": [0, 0]},
    },
    "worst": {"sweep": "noise", "strength": 100, "accuracy": 0.5},
    "mce": None,
    "mrr": over_seeds(0.75),
}


SWEEPS = {
    "noise": {"title": "Noise", "axis": "sigma, mm", "strengths": [0, 100]},
    "tilt": {"title": "Looks down", "axis": "degrees", "strengths": [0, 30]},
    "hard": {"title": "Hard poses", "axis": "1: hard", "strengths": [0, 1]},
}
FIGURES = {"sweeps": SWEEPS, "groups": {"all": GROUP}}


def test_images_have_a_row_a_group_and_sweeps_a_row_a_sweep() -> None:
    assert tables(FIGURES) == {
        "images": [
            {
                "network": "all",
                "clean, %": "85.0 ± 1.0",
                "mCE": "–",
                "mRR": "0.750",
                "worst case": "Noise, 100: 50.0 ± 2.0 %",
            }
        ],
        "sweeps": [
            {"corruption": "Noise, sigma, mm", "strongest": "100", "all": "50.0 ± 2.0"},
            {"corruption": "Looks down, degrees", "strongest": "30", "all": "70.0 ± 1.0"},
            {"corruption": "Hard poses, 1: hard", "strongest": "1", "all": "40.0"},
        ],
        "falls": [
            {"corruption": "Noise, sigma, mm", "from, to": "0, 100", "all": "72.5 ± 1.4"},
            {"corruption": "Looks down, degrees", "from, to": "0, 30", "all": "never"},
            {"corruption": "Hard poses, 1: hard", "from, to": "0, 1", "all": "when clean"},
        ],
    }
    counted = {**GROUP, "gross_errors": {"noise": {"beyond_30_mm": {"mean": [0.05, 0.3], "sd": [0.01, 0.02]}}}}
    (row,) = tables({**FIGURES, "groups": {"all": counted}})["images"]
    assert row["clean, gross errors (30 mm), %"] == "5.0 ± 1.0"
    counted["gross_errors"] = dict.fromkeys(SWEEPS)  # without SciPy
    assert tables({**FIGURES, "groups": {"all": counted}})["images"] == tables(FIGURES)["images"]


def test_a_strength_has_no_spread_where_a_seed_never_falls() -> None:
    falls = {"noise": {"mean": 72.5, "seeds": [71.5, None]}}
    group = GROUP | {"falls_below_bound_at": GROUP["falls_below_bound_at"] | falls}
    assert tables(FIGURES | {"groups": {"all": group}})["falls"][0]["all"] == "72.5"


def test_motion_has_a_row_for_each_kind_of_frames() -> None:
    scores = {"tc": over_seeds(0.9), "vc": over_seeds(0.8, 0.8), "vc_right": over_seeds(0.7), "accuracy": None}
    scores |= {"vc_right_where_truth_stays": over_seeds(0.75), "pixel_accuracy": over_seeds(0.85)}
    assert tables({"temporal": {"groups": {"all": {"none": scores}}}})["motion"] == [
        {
            "network": "all",
            "frames": "none",
            "TC, %": "90.0",
            "VC₈ constant, %": "80.0 ± 1.0",
            "VC₈ constant and right, %": "70.0",
            "where the truth stays, %": "75.0",
            "accuracy, %": "–",
            "pixels right, %": "85.0",
        }
    ]


def test_a_page_has_them_for_files_of_stability_alone(tmp_path: Path) -> None:
    origin = {"command": "c", "commit": "d", "hardware": "h"}
    for name, kind in (("steady", "bodyseg stability 1"), ("other", "another 1")):
        (tmp_path / f"{name}.json").write_text(json.dumps(FIGURES | origin | {"format": kind}))
    assert "| all | 85.0 ± 1.0 |" in render_page("{{ steady.tables.images | table }}", tmp_path)
    with pytest.raises(BadConfig, match="line 1 of the template cannot be filled: .* no attribute 'tables'"):
        render_page("{{ other.tables.images | table }}", tmp_path)
