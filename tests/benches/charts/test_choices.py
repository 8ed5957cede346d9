from __future__ import annotations

import json
from dataclasses import replace

import pytest
from benches.charts.report import described
from chart_figures import BY_NAME, RENDERERS, SOURCE, figures_of, panels_of
from folders import ROOT

from bodyseg_data.core import BadConfig

RESULTS = ROOT / "docs" / "results"


# What is read out of the benches' figures


def test_every_choice_reads_its_points() -> None:
    (renderer,) = panels_of("renderer")
    assert [(point.x, point.y) for point in renderer.points] == [(10.0, 0.025), (40.0, 0.36)]
    assert renderer.default == "bodyseg shard" and "0.003 %" in renderer.points[0].label

    (shadow,) = panels_of("shadow_test")
    assert [(point.x, point.y) for point in shadow.points] == [(200, 0.003), (600, 0.003), (150, 0.004), (700, 0.02)]
    assert shadow.default == shadow.points[0].name and len({point.name for point in shadow.points}) == 4
    assert [(limit.name, limit.x) for limit in shadow.limits] == [("stored mask", 90.0)]
    assert [point.label for point in shadow.points] == ["four, 6 mm", "four, 6 mm, NumPy", "one, 20 mm, ×2",
                                                        "one, 20 mm, NumPy"]  # fmt: skip

    (partition,) = panels_of("partition")
    assert {point.name: (point.x, point.y) for point in partition.points} == {
        "exact": (250, 0), "edges": (80, 0.04), "heat": (260, 0.02),
    }  # fmt: skip
    assert partition.default == "exact" and partition.name == "open bodies (2)"

    whole, scan = panels_of("mesh_resolution")
    assert (whole.default, scan.default) == ("whole mesh", "whole mesh")
    assert {point.name: (point.x, point.y) for point in scan.points} == {
        "whole mesh": (250, 0), "25 % of the triangles": (100, 0.1), "within 0.2 mm": (125, 0.2),
    }  # fmt: skip
    assert scan.name == "scan with 0.3 mm noise, 200 000 triangles"

    (codec,) = panels_of("codec")
    assert {point.name: (point.x, point.y) for point in codec.points} == {
        "bsi, compiled": (0.25, 30_000), "PNG": (3, 60_000), "zstd 9": (0.14, 63_000),
    }  # fmt: skip

    none, two = panels_of("loader")
    assert {point.name: (point.x, point.y) for point in two.points} == {
        "ours_all": (2500, 33_000), "mds_raw": (1400, 630_000),
    }  # fmt: skip
    assert {limit.name: limit.x for limit in none.limits} == {"ours_none": 3000, "memory": 18_000}

    cpu, gpu = panels_of("networks")
    assert {point.name: (point.x, point.y, point.y_sd) for point in cpu.points} == {
        "compact": (20, 0.87, 0.01), "compact-half": (10, 0.84, 0.01),
        "fcn_alexnet": (450, 0.8, 0.01), "forest": (90, 0.55, 0.01),
    }  # fmt: skip
    assert cpu.default == "compact" and gpu.default is None and [point.name for point in gpu.points] == ["fcn_alexnet"]


def test_renderers_alone_have_a_panel_of_their_own() -> None:
    alone, files = panels_of("renderer", **RENDERERS)
    assert {point.name: (point.x, point.y) for point in alone.points} == {
        "raster": (5.0, 0.0001), "embree": (20.0, 0.0002),
    }  # fmt: skip
    assert (alone.default, files.default) == ("raster", "bodyseg shard")
    assert "embree\n(silhouette off by 0.004 %)" in [point.label for point in alone.points]
    with pytest.raises(BadConfig, match=r"^render.json: the default 'opengl' is not among: both images alone"):
        panels_of("renderer", **RENDERERS | {"default_renderer": "opengl"})


def test_where_pyrender_cannot_draw_only_renderers_are_left_to_compare() -> None:
    without = {"range_error_mm": None, "plain_errors": None}
    assert panels_of("renderer", **without) == ()
    assert [panel.default for panel in panels_of("renderer", **without, **RENDERERS)] == ["raster"]


def test_artifacts_are_compared_on_the_real_frames_that_were_measured() -> None:
    labels, views = panels_of("artifacts")
    assert (labels.name, labels.default) == ("right labels, Kinect v1", "all")
    assert [(point.name, point.x, point.y, point.y_sd) for point in labels.points] == [
        ("none", 0.9, 0.61, 0.01), ("md", 1.2, 0.66, 0.02), ("all", 1.6, 0.7, 0.01),
    ]  # fmt: skip
    assert [(point.name, point.y_sd) for point in views.points] == [("none", None), ("md", None)]
    assert views.default is None
    assert panels_of("artifacts", real={}) == ()


# What is wrong in a file


def test_a_default_that_was_not_measured_is_refused() -> None:
    with pytest.raises(BadConfig, match=r"^codec.json: the default 'zip' is not among: 60 samples"):
        panels_of("codec", default="zip")


def test_a_figure_that_is_missing_is_named() -> None:
    unmeasured = {name: {**row, "range_error_mm": None} for name, row in RENDERERS["renderers"].items()}
    message = r"^render.json: both images alone, processor time: 'range error, mm .*' of 'raster' must be a number, "
    with pytest.raises(BadConfig, match=message + "found None$"):
        panels_of("renderer", **RENDERERS | {"renderers": unmeasured})


@pytest.mark.parametrize("defaults", [0, 2])
def test_one_network_is_the_default(defaults: int) -> None:
    networks = figures_of("architectures")["networks"]
    for number, network in enumerate(networks.values()):
        network["default"] = number < defaults
    with pytest.raises(
        BadConfig, match=f"^architectures.json has not .*one of the networks must be the default, found {defaults}"
    ):
        panels_of("networks", networks=networks)


# What stands in charts.json


def test_a_description_holds_points_front_and_what_beats_the_default() -> None:
    choice = BY_NAME["mesh_resolution"]
    whole, scan = panels_of("mesh_resolution")
    told = json.loads(json.dumps(described(choice, (whole, replace(scan, default="within 0.2 mm")), [SOURCE])))
    whole, scan = told["panels"]
    assert told["sources"] == [SOURCE] and told["x"]["better"] == "less"
    assert (whole["default"], whole["default_on_front"], whole["default_beaten_by"]) == ("whole mesh", True, [])
    assert (scan["default_on_front"], scan["front"]) == (False, ["25 % of the triangles", "whole mesh"])
    assert scan["default_beaten_by"] == [
        {"name": "25 % of the triangles", "x_better_by_share": 0.2, "y_better_by_share": 0.5}
    ]
    assert scan["points"][2] == {
        "name": "within 0.2 mm", "label": "0.2 mm", "x": 125.0, "y": 0.2, "on_front": False,
    }  # fmt: skip
