"""The pieces of `bench render`; the whole of it takes minutes and is run by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from benches.data.render import alone as render_alone
from benches.data.render import packing as render_packing
from benches.data.render import steps as render_steps
from benches.data.render.alone import PLAIN, measure_renderers, true_range
from benches.data.render.figure import _STAGES, draw_render
from benches.data.render.steps import STAGES, _Scene, _steps, measure_stages, measure_steps
from fakes import Figures
from people_on_disk import write_by_vertex, write_mesh
from pictures import decoded, marks
from small_rig import SMALL

from bodyseg_data.bodies import SOURCES
from bodyseg_data.meshes import Mesh
from bodyseg_data.packing import Packing
from bodyseg_data.rigs import PlacedCamera, axes_at
from bodyseg_data.samples import ViewGrid


@pytest.fixture(autouse=True)
def of_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(SOURCES, "open", Figures)


PACKING = Packing("open", meshes=1, views=ViewGrid(count=2), rig=SMALL)
VIEWS = list(PACKING.views)


def test_every_step_makes_the_same_images() -> None:
    """They differ in time and in what is stored of the projector, not in what the camera sees."""
    scene = _Scene(PACKING.rig, PACKING.opened(), PACKING.bodies()[0])
    chain = _steps()
    *rays, filled, packed = [step.images(scene, VIEWS[0]) for step in chain]
    (range_image, _), (projector, _), (labels, _) = rays[0]
    for number, ((ranges, _), (shading, _), (stored, _)) in enumerate(rays):
        assert np.array_equal(ranges, range_image) and np.array_equal(stored, labels)
        assert np.array_equal(shading, projector) == (number < 3)
        assert (projector[shading > 0] > 0).all()
    assert (filled[0][0] != range_image).sum() < 0.01 * (range_image > 0).sum()
    assert (filled[2][0] != labels).sum() < 10
    assert all(np.array_equal(one, other) for (one, _), (other, _) in zip(filled, packed, strict=True))
    sizes = [step.store(packed) for step in chain]
    assert sizes[0] == sizes[4] < sizes[5] == sizes[6] and sizes[7] < 0.8 * sizes[0]


def test_steps_and_stages_are_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(render_steps, "ROUNDS", 1)
    chain = measure_steps(PACKING, PACKING.bodies(), VIEWS[:1])
    assert [set(step) for step in chain] == [{"name", "ms_per_view", "bytes_per_view"}] * 8
    assert all(step["ms_per_view"] > 0 for step in chain)
    assert chain[3]["bytes_per_view"] < 0.85 * chain[0]["bytes_per_view"]
    stages = measure_stages(PACKING, PACKING.bodies(), VIEWS)
    assert list(stages) == list(STAGES) and all(ms > 0 for ms in stages.values())


def test_the_true_range_is_that_of_a_box() -> None:
    """A unit cube seen from the front: a square of one depth; from the corner: the depth of each ray's own face."""
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([half for a, b, c, d in sides for half in ((a, b, c), (a, c, d))])
    cube, device = Mesh("cube", corners, faces), PACKING.rig.camera
    front = true_range(cube, PlacedCamera(device, axes_at(0), np.array([0.0, 0.0, 2.5])))
    rays = device.pixel_rays()
    square = (np.abs(rays[..., :2]) * 2 < 0.5).all(axis=-1)
    np.testing.assert_allclose(front, np.where(square, 2.0, 0.0), rtol=0, atol=1e-12)

    placed = PlacedCamera(device, axes_at(30), axes_at(30).T @ np.array([0.0, 0.0, -2.5]))
    ways, start = rays @ placed.axes, placed.position
    ends = np.stack([(side - start) / ways for side in (-0.5, 0.5)])  # the slab between each pair of sides
    enters, leaves = ends.min(axis=0).max(axis=-1), ends.max(axis=0).min(axis=-1)
    np.testing.assert_allclose(true_range(cube, placed), np.where(enters < leaves, enters, 0), rtol=0, atol=1e-12)


def test_renderers_are_measured_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(render_alone, "ROUNDS", 1)
    told = measure_renderers(PACKING, PACKING.bodies(), VIEWS[:1], VIEWS[:1])
    assert told["default_renderer"] == "raster" and set(told["renderers"]) >= {"raster", "embree"}
    for name, row in told["renderers"].items():
        assert row["ms_per_view"] > 0 and row["worst_mm"] >= row["range_error_mm"] > 0
        if name == PLAIN:
            assert 0.4 < row["range_error_mm"] < 4 and 0.004 < row["silhouette_error"] < 0.08
        else:
            assert row["range_error_mm"] < 0.001 and row["silhouette_error"] < 0.001
    assert set(told["renderers"]) | set(told["renderers_missing"]) == {"raster", "embree", "opengl", PLAIN}


def test_a_figure_is_drawn_without_the_baseline(tmp_path: Path) -> None:
    figures = {
        "views_per_second": {"ours": 30.0, "plain": None},
        "bytes_per_view": {"ours": 60_000, "plain": None},
        "times_faster": None,
        "workers": 2,
        "stages": dict.fromkeys(STAGES, 2.0),
        "steps": [{"name": name, "ms_per_view": ms, "bytes_per_view": 9e4} for name, ms in (("a", 30.0), ("b", 20.0))],
    }
    draw_render(figures, tmp_path / "chart.png")
    picture = decoded(tmp_path / "chart.png")
    assert not marks(picture, "#9a9aa2"), "no bar for what cannot draw"
    stages = [marks(picture, colour, 400) for colour in _STAGES.values() if colour != "#1f5ac8"]
    assert {len(found) for found in stages} == {1} and max(m[0].width for m in stages) < 1.05 * min(
        m[0].width for m in stages
    )
    assert [found[0].left for found in stages] == sorted(found[0].left for found in stages)
    speed, camera, last = sorted(marks(picture, "#1f5ac8", 400), key=lambda mark: mark.top)
    (first,) = marks(picture, "#a9bfe8", 400)
    assert first.left == last.left and last.width / first.width == pytest.approx(20 / 30, rel=0.02)
    assert speed.left == pytest.approx(first.left, abs=2) and camera.left > stages[1][0].left


def test_packing_is_measured(tmp_path: Path) -> None:
    for name in ("one", "two"):  # of files, which workers render without loading the body model
        write_mesh(tmp_path / "people" / f"{name}.ply")
    write_by_vertex(tmp_path / "people" / "landmarks.json")
    packing, out = Packing("folder", tmp_path / "people", views=ViewGrid(count=2)), tmp_path / "shards"
    found = render_packing.measured(packing, out, 1)
    assert (found["samples"], found["workers"]) == (4, 1)
    assert found["bytes"] == sum(tar.stat().st_size for tar in out.glob("*.tar"))
