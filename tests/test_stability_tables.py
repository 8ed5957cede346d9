"""What stability.json says, as rows to read."""

from __future__ import annotations

from typing import Any

from bodyseg_model.stability.tables import tables


def over_seeds(*values: float) -> dict[str, Any]:
    mean = sum(values) / len(values)
    return {"mean": mean, "sd": 0.01 if len(values) > 1 else None, "seeds": [*values]}


GROUP = {
    "clean": {"stored": over_seeds(0.8, 0.9)},
    "curves": {"noise": {"mean": [0.85, 0.5]}, "tilt": {"mean": [0.8, 0.7]}},
    "falls_below_bound_at": {"noise": {"mean": 72.5}, "tilt": {"mean": None}},
    "worst": {"sweep": "noise", "strength": 100, "accuracy": 0.5},
    "mce": None,
    "mrr": over_seeds(0.75),
}


def test_images_have_a_row_a_group_and_sweeps_a_row_a_sweep() -> None:
    figures = {
        "bound": 0.6,
        "sweeps": {"noise": {"strengths": [0, 100]}, "tilt": {"strengths": [0, 30]}},
        "groups": {"all": GROUP},
    }
    assert tables(figures) == {
        "images": [
            {
                "network": "all",
                "clean, %": "85.0 ± 1.0",
                "mCE": "–",
                "mRR": "0.750",
                "worst": "noise at 100: 50.0 %",
                "falls below 60% at": "noise 72.5",
            }
        ],
        "sweeps": [
            {"sweep": "noise", "strongest": "100", "all": "50.0"},
            {"sweep": "tilt", "strongest": "30", "all": "70.0"},
        ],
    }


def test_motion_has_a_row_for_each_kind_of_frames() -> None:
    scores = {"tc": over_seeds(0.9), "vc": over_seeds(0.8, 0.8), "vc_right": over_seeds(0.7), "accuracy": None}
    assert tables({"temporal": {"groups": {"all": {"none": scores}}}})["motion"] == [
        {
            "network": "all",
            "frames": "none",
            "TC, %": "90.0",
            "VC₈ constant, %": "80.0 ± 1.0",
            "VC₈ constant and right, %": "70.0",
            "accuracy, %": "–",
        }
    ]


def test_arithmetic_says_why_a_number_is_missing() -> None:
    figures = {
        "numerical": {
            "all": {
                "ways": {
                    "bf16": {"changed": 0.0123, "accuracy_change": -0.001},
                    "fp16": {"changed": None, "accuracy_change": None, "reason": "not on this processor"},
                },
                "batches": {
                    "1": {"batch": {"changed": 0.0, "accuracy_change": 0.0}},
                    "7": {"batch": {"changed": 0.5, "accuracy_change": 0.25}},
                },
            }
        }
    }
    rows = [[*row.values()][1:] for row in tables(figures)["arithmetic"]]
    assert rows == [
        ["bf16", "1.230", "-0.10"],
        ["fp16", "–", "not on this processor"],
        ["7 images together", "50.000", "+25.00"],
    ]
