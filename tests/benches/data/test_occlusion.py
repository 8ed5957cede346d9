"""The bench of shadow tests: its scenes, what it says must be stored, its baselines, what it counts and draws."""

from __future__ import annotations

import json
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benches.charts.fronts import pareto_front
from benches.data.occlusion import bench, crops
from benches.data.occlusion.baselines import DEFAULT, METHODS
from benches.data.occlusion.bench import bench_occlusion
from benches.data.occlusion.crops import _COLOURS
from benches.data.occlusion.figure import draw_occlusion
from benches.data.occlusion.stored import Storage
from benches.data.occlusion.tallies import SCENES
from benches.data.occlusion.views import GROUPS, ExactView, exact_view, grown
from folders import ROOT
from pictures import decoded, marks, part
from shapes import figure
from small_rig import SMALL

from bodyseg_data.artifacts import ShadowTest
from bodyseg_data.bodies import Body, BodyRef
from bodyseg_data.meshes import partition
from bodyseg_data.rendering.embree import EmbreeRenderer
from bodyseg_data.rigs import load_rig
from bodyseg_data.samples import View

RESULTS = ROOT / "docs" / "results"


@pytest.fixture(scope="module")
def seen() -> ExactView:
    mesh = figure()
    landmarks = np.random.default_rng(0).choice(len(mesh.vertices), 33, replace=False).astype(np.int64)
    parts = partition(mesh, landmarks)
    ref = BodyRef("A", "A", mesh.name, "standing", "train")
    body = Body(mesh, landmarks)
    return exact_view(load_rig(), EmbreeRenderer(mesh), body, ref, View(255, 20), parts=parts, scales=(1,))


@pytest.fixture(scope="module")
def storage(seen: ExactView) -> Storage:
    return Storage(seen, {1: ShadowTest(load_rig())})


def test_the_stored_front_is_still_measured() -> None:
    rows = json.loads((RESULTS / "occlusion.json").read_text())["methods"]
    maps = [row for row in rows if row["family"] != "exact mask"]
    measured = {(method.family, method.bias_mm, method.projector_scale, method.facing_bit) for method in METHODS}
    for row in pareto_front(maps, lambda row: (row["us_per_view"], row["wrong_pixels"])):
        assert (row["family"], row["bias"], row["projector_scale"], row["facing_bit"]) in measured
    assert {row["family"] for row in maps} == {method.family for method in METHODS}


def test_what_is_stored_gives_the_mask_of_the_whole_image(storage: Storage) -> None:
    view, fewer = storage.view, 0
    for method in METHODS:
        if method.projector_scale in storage.tests:
            test, whole, stored = storage.tests[method.projector_scale], storage.whole(method), storage.of(method)
            expected = method.lit(test, (view.range, whole.image, view.facing))
            np.testing.assert_array_equal(
                method.lit(test, (view.range, stored.image, view.facing)), expected, method.family
            )
            assert (method.stored == "whole") == (stored is whole)
            if method.stored == "coarse":
                fewer += 1
                assert len(np.unique(stored.image)) < len(np.unique(whole.image)) / 2
    assert fewer == 6


def test_the_default_is_the_shadow_test_on_what_shards_hold(storage: Storage) -> None:
    view, test = storage.view, storage.tests[1]
    assert storage.of(DEFAULT).image is view.sample.projector_range
    expected = test.lit(*view.images(1))
    np.testing.assert_array_equal(DEFAULT.lit(test, (view.range, storage.of(DEFAULT).image, view.facing)), expected)


def test_scenes_are_what_they_say(seen: ExactView) -> None:
    assert seen.grazing.any() and seen.thin.any() and seen.thin_shadow.any()
    for mask in (seen.grazing, seen.contact, seen.thin_shadow):
        assert not (mask & ~(seen.facing & seen.inside)).any()
    assert not (seen.contact & seen.lit).any()
    dark = seen.inside & ~seen.lit
    assert not (seen.thin_shadow & ~(grown(seen.lit, 2) & grown(dark, 2))).any()
    assert seen.grazing.sum() < seen.facing.sum() / 3
    thin_labels = set(np.unique(seen.sample.labels[seen.thin]))
    assert thin_labels <= {19, 20, 21, 22, 29, 30, 31, 32}


@pytest.fixture(scope="module")
def figures(quick_geodesics: None) -> dict[str, Any]:
    pytest.importorskip("anny")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bench, "load_rig", lambda: SMALL)
        patch.setattr(bench, "GROUPS", (GROUPS[0], GROUPS[1], GROUPS[4]))
        seen: list[tuple[int, int]] = []
        measured = bench_occlusion(1, lambda done, total: seen.append((done, total)))
    assert seen == [(step, 3) for step in range(1, 4)]
    return measured


def test_the_bench_writes_what_it_promises(figures: dict[str, Any]) -> None:
    json.dumps(figures)
    assert figures["default"]["wrong_pixels"] < 0.01 and figures["default"]["us_per_view"] > 0
    for row in figures["methods"]:
        assert {"name", "bias", "projector_scale", "wrong_pixels", "us_per_view", "bytes", "facing_bit"} <= set(row)
        assert 0 <= row["wrong_pixels"] < 0.1 and row["us_per_view"] > 0
        assert row["wrong_pixels"] == pytest.approx(row["false_lit"] + row["false_shadow"], abs=2e-6)
    *maps, mask = figures["methods"]
    assert mask["wrong_pixels"] == 0 and 0 < mask["bytes"] < 10_000
    for row in maps:
        assert set(row["scenes"]) == set(SCENES)
        assert row["scenes"]["ordinary views"] == row["wrong_pixels"]
        assert row["differing_pixels"] == 0
    finest = [row["wrong_pixels"] for row in maps if row["family"] == DEFAULT.family and row["facing_bit"]]
    assert min(finest) < figures["default"]["wrong_pixels"]
    assert figures["scenes"]["contact shadows, under 20 mm"]["pixels"] > 0
    forms = {row["form"] for row in maps}
    assert forms == ({"numpy", "compiled"} if find_spec("numba") else {"numpy"})
    assert figures["default"]["form"] == ("compiled" if find_spec("numba") else "numpy")


def test_chart_and_worst_errors_are_drawn(
    figures: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    few = {**figures, "worst_crops": figures["worst_crops"][:1]}
    monkeypatch.setattr(crops, "load_rig", lambda: SMALL)  # which the windows are of
    draw_occlusion(few, tmp_path / "chart.png")
    upper = part(decoded(tmp_path / "chart.png"), down=(0, 0.57))
    for half in ((0.0, 0.5), (0.5, 1.0)):
        panel = part(upper, across=half)
        (star, *_) = sorted(marks(panel, (0, 0, 0), 60), key=lambda mark: -mark.bottom)
        points = marks(panel, "#1f4fa8", 8, within=20)
        assert points and max(mark.bottom for mark in points) <= star.bottom, "the exact mask has the least error"
    errors = part(decoded(tmp_path / "chart_errors.png"), down=(0, 0.85))  # without the legend
    columns = [
        {name: marks(part(errors, (third / 9, (third + 1) / 9)), colour, 1) for name, colour in _COLOURS.items()}
        for third in range(3)
    ]
    assert all(found["lit"] and found["in shadow"] for found in columns)
    wrong = [bool(found["wrongly lit"] or found["wrongly dark"]) for found in columns]
    assert wrong == [False, False, True], "errors are marked in the third picture of a scene"
