"""Small figures of every bench that is charted, with numbers that are easy to follow by hand."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

from benches.charts.choice import Panel
from benches.charts.choices import CHOICES

BY_NAME = {choice.name: choice for choice in CHOICES}
SOURCE = {"command": "tools/bench it --views 3", "commit": "0123456789ab", "hardware": "1 core of a test"}


def _test(family: str, bias: float, us: float, wrong: float, form: str = "numpy", scale: float = 1) -> dict[str, Any]:
    settings = {"projector_scale": scale, "facing_bit": True, "stored": "coarse"}
    return {"name": family, "family": family, "bias": bias, "form": form, "us_per_view": us, "wrong_pixels": wrong} | (
        settings
    )


def _coarse(views_per_second: float, p95_mm: float, triangles: int, **kind: float) -> dict[str, Any]:
    return {**kind, "triangles": triangles, "views_per_second": views_per_second, "p95_mm": p95_mm}


def _network(family: str, cpu_ms: float, gpu_ms: float | None, mean: float, default: bool = False) -> dict[str, Any]:
    accuracy = {"mean": mean, "sd": 0.01, "seeds": [mean]}
    facts = {"family": family, "label": f"a {family}", "parameters": 1, "default": default}
    return facts | {"cpu_ms": cpu_ms, "gpu_ms": gpu_ms, "accuracy_all": accuracy}


def _shipped(ms: float, accuracy: float) -> dict[str, Any]:
    return {"ms": {"float32": ms}} | {test: {"accuracy": accuracy} for test in ("people", "hard", "open")}


RENDERERS = {
    "renderers": {
        "raster": {"ms_per_view": 5.0, "range_error_mm": 0.0001, "worst_mm": 0.2, "silhouette_error": 0.0},
        "embree": {"ms_per_view": 20.0, "range_error_mm": 0.0002, "worst_mm": 0.3, "silhouette_error": 0.00004},
    },
    "default_renderer": "raster",
}
"""What `bench render` also says, whether or not pyrender can draw."""

_DEFAULT_TEST = _test("four", 6.0, 200.0, 0.003, "compiled")

_FIGURES: dict[str, dict[str, Any]] = {
    "render": {
        "views_per_second": {"ours": 100.0, "plain": 25.0},
        "range_error_mm": 0.025,
        "silhouette_error": 0.00003,
        "plain_errors": {"range_mm": 0.36, "silhouette": 0.007, "labels": 0.08},
        "workers": 2,
    },
    "occlusion": {
        "default": _DEFAULT_TEST,
        "methods": [
            _DEFAULT_TEST,
            _test("four", 6.0, 600.0, 0.003),
            _test("one", 20.0, 150.0, 0.004, "compiled", 2),
            _test("one", 20.0, 700.0, 0.02),
            {"name": "stored mask", "family": "exact mask", "us_per_view": 90.0, "wrong_pixels": 0.0, "bias": None},
        ],
    },
    "partition": {
        "default": "exact",
        "open": ["a", "b"],
        "methods": {
            "exact": {"ms": 1.0, "partition_ms": 250.0, "wrong_surface": 0.0},
            "edges": {"ms": 1.0, "partition_ms": 80.0, "wrong_surface": 0.04},
            "heat": {"ms": 1.0, "partition_ms": 260.0, "wrong_surface": 0.02},
        },
        "mit": "not measured: no folder of frames was given (--mit)",
    },
    "reduction": {
        "default": {"tolerance_mm": 0.2, "within_percent": 95, "from_triangles": 150_000},
        "kinds": {
            "open": {
                "shares": [_coarse(50.0, 0.0, 20_000, share=1.0), _coarse(40.0, 1.0, 5_000, share=0.25)],
                "tolerances": [_coarse(30.0, 0.2, 9_000, tolerance_mm=0.2)],
            },
            "rough scan": {
                "shares": [_coarse(4.0, 0.0, 200_000, share=1.0), _coarse(10.0, 0.1, 50_000, share=0.25)],
                "tolerances": [_coarse(8.0, 0.2, 40_000, tolerance_mm=0.2)],
            },
        },
    },
    "codec": {
        "default": "bsi, compiled",
        "codecs": {
            "bsi, compiled": {"bytes": 30_000, "decode_ms": 0.25},
            "PNG": {"bytes": 60_000, "decode_ms": 3.0},
            "zstd 9": {"bytes": 63_000, "decode_ms": 0.14},
        },
        "views": 60,
    },
    "loader": {
        "samples_per_second": {
            "ours_none": {"0": 3000.0, "2": 5000.0},
            "ours_occ": {"0": 1700.0, "2": 2900.0},
            "ours_all": {"0": 1500.0, "2": 2500.0},
            "mds_raw": {"0": 2000.0, "2": 1400.0},
            "litdata": {"0": None, "2": None},
            "memory": {"0": 18_000.0, "2": 1900.0},
        },
        "kept_bytes_per_sample": {"ours_all": 33_000, "mds_raw": 630_000, "litdata": None},
    },
    "architectures": {
        "networks": {
            "compact": _network("compact", 20.0, None, 0.87, default=True),
            "compact-half": _network("compact", 10.0, None, 0.84),
            "fcn_alexnet": _network("fcn_alexnet", 450.0, 9.0, 0.80),
            "forest": _network("forest", 90.0, None, 0.55),
        }
    },
    "shipped": {"networks": {"compact": _shipped(20.0, 0.87), "large": _shipped(45.0, 0.89)}},
    "variants": {
        "loader": {"none": {"ms": 0.9}, "md": {"ms": 1.2}, "all": {"ms": 1.6}, "occ": {"ms": 1.1}},
        "real": {
            "none": {
                "kinect_v1, accuracy": {"mean": 0.61, "sd": 0.01},
                "structure_bust, same": {"mean": 0.8, "sd": None},
            },
            "md": {
                "kinect_v1, accuracy": {"mean": 0.66, "sd": 0.02},
                "structure_bust, same": {"mean": 0.9, "sd": None},
            },
            "all": {"kinect_v1, accuracy": {"mean": 0.7, "sd": 0.01}},
        },
    },
}
_FIGURES["smaller"] = _FIGURES["architectures"]


def figures_of(bench: str) -> dict[str, Any]:
    """A copy that may be changed."""
    return copy.deepcopy(SOURCE | _FIGURES[bench])


def write_figures_of(folder: Path, *benches: str) -> None:
    """BENCH.json of each into the folder; of all if none is named."""
    for bench in benches or tuple(_FIGURES):
        (folder / f"{bench}.json").write_text(json.dumps(figures_of(bench)))


def panels_of(name: str, **changes: Any) -> tuple[Panel, ...]:
    """What a choice reads out of its figures, with some fields changed."""
    choice = BY_NAME[name]
    return choice.panels(figures_of(choice.stem) | changes, Path(f"{choice.stem}.json"))
