"""Measuring how far skin goes through skin, on balls with known answers and on bodies."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from benches.data.surface.interpenetration import Depths, Skin, bench_interpenetration, groups_to_measure, penetration

from bodyseg_data.bodies.anny.people import SUBJECT_A
from bodyseg_data.bodies.anny.skeleton import Arm, Leg, Pose
from bodyseg_data.bodies.sources.hard import HardBodies
from bodyseg_data.bodies.sources.open_bodies import Figure, MadeBodies, OpenBodies
from bodyseg_data.meshes.mesh import Mesh

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


@pytest.fixture(scope="module")
def skin(open_bodies: OpenBodies) -> Skin:
    return Skin(open_bodies.build(next(ref for ref in open_bodies.bodies() if ref.pose == "a_pose")))


def made(open_bodies: OpenBodies, pose: Pose) -> MadeBodies:
    return MadeBodies("made", {open_bodies.bodies()[0]: lambda: Figure(SUBJECT_A, pose)})


def measured(skin: Skin, source: MadeBodies) -> Depths:
    mesh = source.build(source.bodies()[0]).mesh
    return skin.measured(mesh, mesh)


def test_a_stance_goes_through_nothing(open_bodies: OpenBodies, skin: Skin) -> None:
    found = measured(skin, open_bodies)
    assert found.contact == 0 and found.fold < 0.025


def test_an_arm_through_the_chest_is_a_contact(open_bodies: OpenBodies, skin: Skin) -> None:
    through = made(open_bodies, Pose(left_arm=Arm(flex=5, abduct=5, twist=-80, elbow=95)))
    found = measured(skin, through)
    assert found.contact > 0.025 and found.place.startswith("posture-00: ")


def test_a_bent_hip_is_a_fold(open_bodies: OpenBodies, skin: Skin) -> None:
    bent = made(open_bodies, Pose(left_leg=Leg(flex=110, knee=100, planted=0)))
    found = measured(skin, bent)
    assert found.fold > 0.02 and found.contact < 0.01


def test_motions_are_sampled_and_all_else_is_measured(open_bodies: OpenBodies) -> None:
    groups = groups_to_measure(open_bodies, HardBodies(), 5)
    counts = {name: len(bodies) for name, (_, bodies) in groups.items()}
    assert counts == {
        "A": 71, "B crane": 35, "B jumping": 30, "B march": 50, "B squat": 50, "C bouncing": 35, "C handstand": 35,
        "C march": 50, "C squat": 50, "people": 59, "hard": 60,
    }  # fmt: skip


def test_the_bench_reports_every_group(monkeypatch: pytest.MonkeyPatch, open_bodies: OpenBodies) -> None:
    groups = groups_to_measure(open_bodies, HardBodies(), 5)
    few = {name: (groups[name][0], groups[name][1][:1]) for name in ("A", "B squat")}
    monkeypatch.setattr("benches.data.surface.interpenetration.groups_to_measure", lambda *_: few)
    steps: list[tuple[int, int]] = []
    figures = bench_interpenetration(progress=lambda done, total: steps.append((done, total)))
    assert set(figures["groups"]) == {"A", "B squat"} and figures["bodies"] == 2 and figures["views"] == 5
    assert steps == [(1, 2), (2, 2)]
    assert figures["groups"]["A"] == {
        "bodies": 1, "fold_mm": pytest.approx(9, abs=15), "contact_mm": 0, "contact_at": None,
        "over_10_mm": 0.0, "over_20_mm": 0.0, "dressed_contact_mm": 0,
    }  # fmt: skip


def test_clothes_and_the_body_below_are_measured_apart(open_bodies: OpenBodies, skin: Skin) -> None:
    ref = next(ref for ref in open_bodies.bodies() if ref.mesh == "B-squat-010")
    bare, dressed = (open_bodies.build(ref, dressed=worn).mesh for worn in (False, True))
    assert skin.measured(bare, bare).contact < 0.01
    assert skin.measured(dressed, bare) != skin.measured(bare, bare)
