"""Parts of the search for poses: draws, distances from skin, limbs, and reaching for a goal."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from shapes import mean_by_place, numbers_in

from bodyseg_data.bodies.anny_model import AnnyModel, Posable
from bodyseg_data.bodies.anny_people import SUBJECT_A
from bodyseg_data.bodies.limb_reaching import (
    ARM,
    Base,
    Goal,
    Limb,
    PosedSkin,
    Reach,
    chosen,
    deepest_m,
    mostly_middle,
    within,
)
from bodyseg_data.bodies.outfits import drawn_outfit
from bodyseg_data.bodies.skeleton import Arm, Leg, Pose, Trunk, bone_rotations
from bodyseg_data.bodies.stances import Places
from bodyseg_data.core import Draws
from bodyseg_data.meshes import Mesh, vertex_normals


@cache
def adult() -> Posable:
    pytest.importorskip("anny")
    return AnnyModel().posable(SUBJECT_A)


@cache
def places() -> Places:
    return Places(adult())


def draws() -> np.random.Generator:
    return Draws(0, 0, "tests/contacts").generator("draws")


def test_values_are_drawn_within_their_ranges_and_mostly_in_the_middle() -> None:
    random = draws()
    even = np.array([within({"a": (-3, 5)}, random)["a"] for _ in range(2000)])
    middle = np.array([mostly_middle({"a": (-3, 5)}, random)["a"] for _ in range(2000)])
    for values, spread in ((even, 8 / np.sqrt(12)), (middle, 8 / np.sqrt(24))):
        assert values.min() >= -3 and values.max() <= 5
        assert values.mean() == pytest.approx(1, abs=0.2)
        assert values.std() == pytest.approx(spread, rel=0.05)


def test_names_are_drawn_by_their_weights() -> None:
    random = draws()
    found = [chosen({"never": 0, "often": 3, "seldom": 1}, random) for _ in range(2000)]
    assert found.count("never") == 0
    assert found.count("often") == pytest.approx(1500, abs=80)


def test_heights_above_a_ball_are_those_of_geometry() -> None:
    golden = np.pi * (3 - np.sqrt(5)) * np.arange(4000)
    y = np.linspace(-1, 1, 4000)
    ball = np.stack([np.sqrt(1 - y**2) * np.cos(golden), y, np.sqrt(1 - y**2) * np.sin(golden)], axis=1)
    skin = PosedSkin(ball, ball, np.ones(4000, bool))
    found = skin.heights(np.array([[1.1, 0, 0], [0, 0, 0.9], [0.5, 3, 0]]))
    assert found[0] == pytest.approx(0.1, abs=0.01)
    assert found[1] == pytest.approx(-0.1, abs=0.01)
    assert np.isinf(found[2])


def test_normals_are_those_of_the_mesh() -> None:
    vertices = adult().vertices(*adult().placed(bone_rotations(Pose())))
    mesh = Mesh("adult", vertices, adult().faces)
    used = np.unique(adult().faces)
    np.testing.assert_allclose(vertex_normals(vertices, adult().faces)[used], mesh.vertex_normals[used], atol=1e-6)


@pytest.mark.parametrize("side", ["L", "R"])
@pytest.mark.parametrize("kind", ["arm", "leg"])
def test_a_limb_moves_as_the_whole_skeleton_does(kind: str, side: str) -> None:
    arms = Arm(40, 20, -30, 70, 10, 15, 0.4), Arm(-20, 60, 20, 30, -40, -15, 0.9)
    legs = Leg(50, 10, 20, 60), Leg(-10, 5, 10, 30, planted=0, ankle=20, toes=15)
    pose = Pose(Trunk(lean=20, roll=10, turn=30, bend=15, twist=10), *arms, *legs)
    turns, heads = adult().placed(bone_rotations(pose))
    limb = Limb(adult(), kind, side)  # type: ignore[arg-type]
    angles = getattr(pose, f"{'left' if side == 'L' else 'right'}_{kind}")
    base = Base(turns[limb.base_bone], heads[limb.base_bone], turns[0])
    normals = vertex_normals(adult().modelled, adult().faces)
    points = limb.points(limb.probes, normals[limb.probes])
    found = points.moved(*limb.bones(angles, base))
    # A point is moved with one bone, while the skin follows several.
    assert np.abs(found - adult().vertices(turns, heads)[limb.probes]).max() < 0.03
    assert np.linalg.norm(points.facing(limb.bones(angles, base)[0]), axis=1) == pytest.approx(1)


def test_every_place_is_on_the_body_and_its_two_sides_are_alike() -> None:
    at = adult().vertices(*adult().placed(bone_rotations(Pose())))
    for name in ("hip", "knee", "palm", "sole", "forearm", "side of the head"):
        left, right = at[places().on(name, "L")].mean(axis=0), at[places().on(name, "R")].mean(axis=0)
        np.testing.assert_allclose(left, right * (-1, 1, 1), atol=0.02)
        assert left[0] > 0.02
    front, behind = at[places().on("chest")].mean(axis=0), at[places().on("upper back")].mean(axis=0)
    assert front[2] > behind[2] + 0.1
    assert at[places().on("face"), 1].mean() > at[places().on("neck"), 1].max()


def test_a_palm_reaches_the_chest_within_its_joints_ranges_and_lies_on_it() -> None:
    turns, heads = adult().placed(bone_rotations(Pose()))
    vertices = adult().vertices(turns, heads)
    normals = vertex_normals(vertices, adult().faces)
    limb = Limb(adult(), "arm", "L")
    base = Base(turns[limb.base_bone], heads[limb.base_bone], turns[0])
    chest = places().on("chest")
    at, by = int(chest[np.abs(vertices[chest, 0]).argmin()]), int(places().on("palm", "L")[20])
    goal = Goal(by, vertices[at], np.ones(3), -normals[at])
    obstacles = PosedSkin(vertices, normals, places().solid & ~limb.vertices)
    still = vertex_normals(adult().modelled, adult().faces)
    reach = Reach(limb, base, still, [goal], obstacles, floor=-5)
    start = Arm(flex=45, abduct=6, twist=-50, elbow=100)
    found = reach(start, ARM)
    assert reach.miss_m(start) > 0.05
    assert found.miss_m < 0.01 and found.miss_m == reach.miss_m(found.angles)
    assert reach.depth_m(found.angles) < 0.012
    for joint, (low, high) in ARM.items():
        assert low <= getattr(found.angles, joint) <= high


def test_what_rests_on_the_floor_touches_it() -> None:
    turns, heads = adult().placed(bone_rotations(Pose()))
    vertices = adult().vertices(turns, heads)
    limb = Limb(adult(), "leg", "R")
    base = Base(turns[limb.base_bone], heads[limb.base_bone], turns[0])
    floor = float(vertices[:, 1].min()) + 0.1
    far = PosedSkin(vertices + 9, vertices, places().solid)
    still = vertex_normals(adult().modelled, adult().faces)
    reach = Reach(limb, base, still, [], far, floor, [places().on("foot", "R")])
    ranges = {"flex": (-20.0, 90.0), "knee": (0.0, 120.0)}
    found = reach(Leg(flex=20, knee=10, planted=0), ranges)
    assert found.miss_m < 0.01
    moved, at = limb.bones(found.angles, base)
    group = places().on("foot", "R")
    assert limb.points(group, still[group]).moved(moved, at)[:, 1].min() == pytest.approx(floor, abs=0.015)


def test_an_arm_through_the_trunk_is_deep_and_a_hanging_one_is_not() -> None:
    limbs = [Limb(adult(), "arm", "L"), Limb(adult(), "arm", "R")]

    def deepest(arm: Arm) -> float:
        vertices = adult().vertices(*adult().placed(bone_rotations(Pose(left_arm=arm))))
        return deepest_m(vertices, vertex_normals(vertices, adult().faces), limbs, places().solid)

    assert deepest(Arm(abduct=25)) == 0
    assert deepest(Arm(flex=10, abduct=-10, twist=-60, elbow=90)) > 0.03


def test_drawn_outfits_differ_and_close_ones_are_closer() -> None:
    random = draws()
    loose = [drawn_outfit(random, close=False) for _ in range(50)]
    close = [drawn_outfit(random, close=True) for _ in range(50)]
    assert len(set(loose)) == len(set(close)) == 50
    assert mean_by_place(numbers_in(loose + close)) == pytest.approx(0.2844974, abs=1e-6), "raise CLOTHES_VERSION"
    assert max(outfit.top_loose_m for outfit in close) < min(outfit.top_loose_m for outfit in loose)
    assert min(outfit.leg_taper for outfit in close) > max(outfit.leg_taper for outfit in loose)
