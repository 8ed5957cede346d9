"""The bench of ways to measure distance, on small bodies: what it breaks, counts, draws and refuses."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benches.data.surface import partition as bench
from benches.data.surface import partition_figure
from benches.data.surface.broken_bodies import CASES, scan, sound
from benches.data.surface.partition import METHODS, bench_partition, wrong_surface
from benches.data.surface.partition_figure import draw_partition
from benches.data.surface.rival_geodesics import rivals_installed
from pictures import decoded, marks, part
from shapes import ball

from bodyseg_data.bodies import Body, BodyRef
from bodyseg_data.core import BadConfig
from bodyseg_data.meshes import partition
from bodyseg_data.meshes.geodesics import Unanswerable, nearest_sources


def round_body(subdivisions: int = 4) -> Body:
    mesh = ball(subdivisions=subdivisions)
    return Body(mesh, np.random.default_rng(0).choice(len(mesh.vertices), 33, replace=False).astype(np.int64))


class Balls:
    """A source of two balls."""

    name = "balls"

    def bodies(self) -> list[BodyRef]:
        return [BodyRef("A", "A", f"ball-{size}", "standing", "train") for size in (3, 2)]

    def build(self, body: BodyRef) -> Body:
        return round_body(int(body.mesh[-1]))


@pytest.mark.parametrize("case", CASES)
def test_a_broken_body_is_a_body_whose_triangles_lie_in_the_sound_one(case: str) -> None:
    whole = round_body()
    step = CASES[case]
    options = {"triangles": 12_000, "noise_m": 0.0} if step is scan else {}
    broken = step(sound(whole), np.random.default_rng(3), **options)
    again = step(sound(whole), np.random.default_rng(3), **options)
    np.testing.assert_array_equal(broken.vertices, again.vertices)
    np.testing.assert_array_equal(broken.faces, again.faces)
    body = broken.body(case)
    np.testing.assert_allclose(body.mesh.vertices[body.landmarks], whole.mesh.vertices[whole.landmarks])
    inside = broken.parent >= 0
    middles = body.mesh.vertices[body.mesh.faces[inside]].mean(axis=1)
    weights = whole.mesh.barycentric(broken.parent[inside].astype(np.int32), middles)
    assert weights.min() > -1e-6
    normals = whole.mesh.normals[broken.parent[inside]]
    corner = whole.mesh.vertices[whole.mesh.faces[broken.parent[inside], 0]]
    assert np.abs(np.einsum("ni,ni->n", middles - corner, normals)).max() < 1e-9
    if case.startswith("scan"):
        assert len(broken.faces) == 12_000


def test_slivers_get_flaps_too() -> None:
    for seed in (0, 1, 2):
        broken = CASES["all of these"](sound(round_body()), np.random.default_rng(seed))
        assert np.isfinite(broken.vertices).all()


def test_wrong_surface_is_the_share_of_the_area() -> None:
    body = round_body(3)
    exact = partition(body.mesh, body.landmarks)
    parent = np.arange(len(body.mesh.faces))
    assert wrong_surface(body.mesh, exact, body.mesh, exact, parent) == 0
    turned = partition(body.mesh, np.roll(body.landmarks, 1))  # the same parts, every one with another name
    assert wrong_surface(body.mesh, turned, body.mesh, exact, parent) == 1
    south = body.mesh.vertices[body.mesh.faces].mean(axis=1)[:, 1] < 0.9
    near = wrong_surface(body.mesh, partition(body.mesh, body.landmarks, "edges"), body.mesh, exact, parent)
    assert 0 < near < 0.1
    assert wrong_surface(body.mesh, turned, body.mesh, exact, np.where(south, parent, -1)) == 1


@pytest.fixture(scope="module")
def figures() -> dict[str, Any]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bench, "open_source", lambda *name: Balls())
        patch.setattr(bench, "OPEN_BODIES", 2)
        patch.setattr(bench, "MIT_FRAMES", 1)
        patch.setattr(bench, "REPEATS", 1)
        cases = {"doubled faces": CASES["doubled faces"], "scan of 200 000 triangles": scan}
        patch.setattr(scan, "__defaults__", (3000, 0.0003))
        patch.setattr(bench, "CASES", cases)
        seen: list[tuple[int, int]] = []
        measured = bench_partition(Path("frames"), lambda done, total: seen.append((done, total)))
        assert seen == [(step, 5) for step in range(1, 6)]
        return measured


def test_every_method_is_measured_on_every_body(figures: dict[str, Any]) -> None:
    json.dumps(figures)
    assert list(figures["methods"]) == list(METHODS)
    assert figures["default"] == "exact"
    assert figures["methods"]["exact"]["wrong_surface"] == 0
    for name in METHODS[1:]:
        for methods in (figures["methods"], figures["mit"]["methods"]):
            assert 0 < methods[name]["wrong_surface"] < 0.2
            assert methods[name]["ms"] > 0 and methods[name]["distance_error_mm"] > 0
    doubled = figures["bodies"]["doubled faces"]["methods"]
    assert doubled["exact"]["as_it_is"].startswith("the method 'exact' cannot answer: a face needs three")
    assert doubled["exact"]["wrong_surface"] < 1e-3
    assert "50 faces with no more than two places left out, 550 doubled faces" in doubled["exact"]["note"]
    assert figures["bodies"]["scan of 200 000 triangles"]["methods"]["exact"]["wrong_surface"] == 0


def test_the_chart_is_drawn(figures: dict[str, Any], tmp_path: Path) -> None:
    draw_partition(figures, tmp_path / "chart.png")
    picture = decoded(tmp_path / "chart.png")
    for name in METHODS[1:]:
        assert marks(part(picture, down=(0, 0.52)), partition_figure._GREYS[name], 40), name
    table = part(picture, down=(0.52, 1))
    assert sum((table == 255).all(axis=-1).ravel()) < 0.9 * table[..., 0].size, "worse cells are darker"


def dented_ball() -> Any:
    """Vertices, faces and 20 sources."""
    mesh = ball(subdivisions=4)
    vertices = mesh.vertices.copy()
    vertices[:, 2] *= 1 + 0.3 * np.sin(9 * mesh.vertices[:, 1])
    return vertices, mesh.faces.astype(np.int64), np.random.default_rng(0).choice(len(vertices), 20, replace=False)


@pytest.mark.parametrize(("method", "error_m", "wrong"), [("marching", 9e-3, 0.03), ("heat", 6e-3, 0.02)])
def test_rivals_come_near_the_exact_answer_while_they_are_installed(method: Any, error_m: float, wrong: float) -> None:
    vertices, faces, sources = dented_ball()
    with rivals_installed():
        exact, answer = (nearest_sources(name, vertices, faces, sources) for name in ("exact", method))
    np.testing.assert_array_equal(answer.source[sources], np.arange(20))
    np.testing.assert_allclose(answer.distance[sources], 0, atol=1e-12)
    assert 0 < np.abs(answer.distance - exact.distance).mean() < error_m
    assert 0 < (answer.source != exact.source).mean() < wrong
    with pytest.raises(BadConfig, match=f"found '{method}'"):
        nearest_sources(method, vertices, faces, sources)


def test_what_a_rival_refuses_is_one_line() -> None:
    """An edge of three faces for fast marching; two balls that share one vertex for its library."""
    vertices, faces, sources = dented_ball()
    far, fin = np.append(vertices, [[0.0, 5, 0]], axis=0), np.append(faces, [[*faces[0, :2], len(vertices)]], axis=0)
    count = len(vertices)
    top, bottom = int(vertices[:, 1].argmax()), int(vertices[:, 1].argmin())
    other = vertices + np.array([0, np.ptp(vertices[:, 1]), 0])
    more = np.where(faces == bottom, top, faces + count)
    used, corners = np.unique(np.concatenate([faces, more]), return_inverse=True)
    with rivals_installed():
        assert np.isfinite(nearest_sources("heat", far, fin, sources).distance).all()  # type: ignore[arg-type]
        with pytest.raises(Unanswerable, match="the method 'marching' cannot answer: an edge may have two faces"):
            nearest_sources("marching", far, fin, sources)  # type: ignore[arg-type]
        both = np.concatenate([vertices, other])[used], corners.reshape(-1, 3)
        with pytest.raises(Unanswerable, match="the method 'marching' cannot answer: .*nonmanifold") as caught:
            nearest_sources("marching", *both, sources)  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)
