"""The bodies in drawn postures: their list, their joints, and some of them built."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from bodyseg_data.bodies import open_source
from bodyseg_data.bodies.sources.hard import HardBodies
from bodyseg_data.bodies.sources.open_bodies import ARMS, WIDE, OpenBodies, WideBodies, drawn_pose
from bodyseg_data.bodies.sources.open_bodies import WIDE_STANCES as STANCES


@pytest.fixture(scope="module")
def source() -> WideBodies:
    return WideBodies()


def test_the_open_bodies_come_first_and_the_others_are_for_training(source: WideBodies) -> None:
    opened = OpenBodies()
    found = source.bodies()
    assert source.name == "wide" == open_source("wide").name
    assert found[: -WIDE or None] == opened.bodies()
    assert source.figure(found[100]) == opened.figure(found[100])
    drawn = found[-WIDE:]
    assert {(ref.subset, ref.split) for ref in drawn} == {("wide", "train")}
    assert len({ref.subject for ref in drawn}) == WIDE
    assert set(Counter(ref.pose for ref in drawn).values()) == {WIDE // len(STANCES)}


def test_nobody_is_of_the_other_sets_and_no_posture_comes_twice(source: WideBodies) -> None:
    figures = [source.figure(ref) for ref in source.bodies()[-WIDE:]]
    hard = HardBodies()
    others = {hard.figure(ref).who.stature_m for ref in hard.bodies()}
    assert not others & {figure.who.stature_m for figure in figures}
    assert len({repr(figure.pose) for figure in figures}) == WIDE


def test_every_joint_lies_within_its_range() -> None:
    stances = [*STANCES.values()]
    arms = list(ARMS.values())
    for index in range(WIDE):
        pose, stance = drawn_pose(index), stances[index % len(stances)]
        for joint, (low, high) in stance.trunk.items():
            assert low - 5 <= getattr(pose.trunk, joint) <= high + 5
        for leg in (pose.left_leg, pose.right_leg):
            assert all(low <= getattr(leg, joint) <= high for joint, (low, high) in stance.leg.items())
        assert pose.left_leg == pose.right_leg or not stance.alike
        for arm in (pose.left_arm, pose.right_arm):
            assert any(all(low <= getattr(arm, joint) <= high for joint, (low, high) in kind.items()) for kind in arms)
    sides = [drawn_pose(index).trunk.roll for index in range(9, WIDE, 10)]
    assert all(85 <= abs(roll) <= 95 for roll in sides)
    assert min(sides) < 0 < max(sides)


def test_a_posture_is_the_same_whoever_asks() -> None:
    assert drawn_pose(17) == drawn_pose(17) != drawn_pose(27)


def test_lying_bodies_lie(source: WideBodies) -> None:
    pytest.importorskip("anny")
    for number, lies in ((10, False), (7, True), (8, True), (17, True)):  # none of them dressed
        vertices = source.build(source.bodies()[-WIDE + number]).mesh.vertices
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        assert low[1] == pytest.approx(0, abs=1e-6)
        across = float(np.hypot(*(high - low)[[0, 2]]))
        assert (across > high[1] - low[1]) == lies
