"""Measuring how far skin goes through skin, on balls with known answers and on bodies."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from benches.data.surface import interpenetration
from benches.data.surface.interpenetration import bench_interpenetration, groups_to_measure, penetration

from bodyseg_data.bodies.sources.hard import HardBodies
from bodyseg_data.bodies.sources.open_bodies import OpenBodies
from bodyseg_data.meshes import Mesh

pytestmark = pytest.mark.usefixtures("quick_geodesics")

RADIUS = 0.3


def balls(gap: float, second: float = RADIUS) -> tuple[Mesh, np.ndarray]:
    """Two balls in one mesh, their centres so far apart, and how deep each vertex is in the other ball."""
    ball = trimesh.creation.icosphere(4, 1.0)
    parts = [ball.vertices * RADIUS, ball.vertices * second + [gap, 0, 0]]
    faces = np.concatenate([ball.faces, ball.faces + len(ball.vertices)]).astype(np.int32)
    depths = [second - np.linalg.norm(parts[0] - [gap, 0, 0], axis=1), RADIUS - np.linalg.norm(parts[1], axis=1)]
    return Mesh("balls", np.concatenate(parts), faces), np.maximum(np.concatenate(depths), 0)


def test_balls_apart_do_not_touch() -> None:
    mesh, _ = balls(0.7)
    depths, faces = penetration(mesh)
    assert depths.max() == 0 and (faces == -1).all()


@pytest.mark.parametrize("overlap", [0.01, 0.05, 0.1, 0.3])
def test_overlapping_balls_are_as_deep_as_they_overlap(overlap: float) -> None:
    mesh, true = balls(2 * RADIUS - overlap)
    depths, faces = penetration(mesh)
    assert ((depths > 0) == (true > 0)).mean() > 0.997
    assert depths.max() == pytest.approx(true.max(), abs=0.003) == pytest.approx(overlap, abs=0.003)
    # The way along the normal is a little longer than the shortest way to the other ball.
    within = true > 0.002
    assert (depths[within] > 0.9 * true[within] - 0.001).all()
    first = np.flatnonzero(within & (np.arange(len(true)) < len(true) // 2))
    assert (mesh.faces[faces[first]] >= len(true) // 2).mean() > 0.9  # they come out of the other ball


def test_a_ball_wholly_inside_is_as_deep_as_it_is_thick_at_most() -> None:
    mesh, _ = balls(0.0, second=0.02)
    depths, _ = penetration(mesh)
    half = len(depths) // 2
    assert depths[:half].max() == 0 and (depths[half:] > 0.035).all() and depths.max() < 0.041


@pytest.fixture(scope="module")
def open_bodies() -> OpenBodies:
    return OpenBodies()


def test_the_bench_reports_every_group(monkeypatch: pytest.MonkeyPatch, open_bodies: OpenBodies) -> None:
    groups = groups_to_measure(open_bodies, HardBodies(), 5)
    few = {name: (groups[name][0], groups[name][1][:1]) for name in ("A", "B squat")}
    monkeypatch.setattr(interpenetration, "groups_to_measure", lambda *_: few)
    monkeypatch.setattr(interpenetration, "_SOURCE_STEP", 400)
    steps: list[tuple[int, int]] = []
    figures = bench_interpenetration(progress=lambda done, total: steps.append((done, total)))
    assert set(figures["groups"]) == {"A", "B squat"} and figures["bodies"] == 2 and figures["views"] == 5
    assert steps == [(1, 2), (2, 2)]
    assert figures["groups"]["A"] == {
        "bodies": 1, "fold_mm": pytest.approx(9, abs=15), "contact_mm": 0,
        "over_10_mm": 0.0, "over_20_mm": 0.0, "dressed_contact_mm": 0,
    }  # fmt: skip
