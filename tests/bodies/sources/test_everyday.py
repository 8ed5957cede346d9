"""The everyday bodies: their list, and drawn poses: joints, contacts, floor, and the same bits on every draw."""

from __future__ import annotations

from collections import Counter
from functools import cache

import numpy as np
import pytest
from shapes import mean_by_place

from bodyseg_data.bodies import BodyRef, open_source
from bodyseg_data.bodies.anny_model import Posable
from bodyseg_data.bodies.anny_people import person
from bodyseg_data.bodies.contact_poses import DEEPEST_M, DrawnContact
from bodyseg_data.bodies.limb_reaching import ARM, CROSSED_TWIST, LEG, LOADED_WRIST, Limb, PosedSkin
from bodyseg_data.bodies.motions.curves import angles
from bodyseg_data.bodies.skeleton import bone_rotations
from bodyseg_data.bodies.sources.hard import HardBodies
from bodyseg_data.bodies.sources.open_bodies import CANDIDATES, EVERYDAY, CandidateBodies, EverydayBodies, WideBodies
from bodyseg_data.bodies.stances import CANDIDATE_STANCES, STANCES, Places
from bodyseg_data.core import BadConfig
from bodyseg_data.meshes import vertex_normals

DRAWN = (2, 39, 73)
"""Bodies whose poses are drawn here: on one leg, standing, on all fours."""


class DrawnOnce(EverydayBodies):
    """The source, which keeps every pose that it has drawn: a pose takes up to two seconds, and tests take turns."""

    def __init__(self) -> None:
        super().__init__()
        self._found: dict[BodyRef, DrawnContact] = {}

    def drawn(self, body: BodyRef) -> DrawnContact:
        if body not in self._found:
            self._found[body] = super().drawn(body)
        return self._found[body]


@cache
def source() -> EverydayBodies:
    pytest.importorskip("anny")
    return DrawnOnce()


def drawn(index: int) -> DrawnContact:
    return source().drawn(source().bodies()[index])


def test_all_are_for_training_and_stances_take_turns() -> None:
    bodies = EverydayBodies().bodies()
    assert open_source("everyday").name == "everyday"
    assert len(bodies) == EVERYDAY == len({ref.subject for ref in bodies}) == len({ref.mesh for ref in bodies})
    assert {(ref.subset, ref.split) for ref in bodies} == {("everyday", "train")}
    assert set(Counter(ref.pose for ref in bodies).values()) == {EVERYDAY // len(STANCES)}


def test_nobody_is_of_another_set() -> None:
    others = set()
    for each in (HardBodies(), WideBodies()):
        subjects = {ref.subject: ref for ref in each.bodies()}
        others |= {each.figure(ref).who.stature_m for ref in subjects.values()}
    assert len(others) > 600 and not others & {person(3000 + index).stature_m for index in range(EVERYDAY)}


def test_a_pose_is_the_same_whoever_asks() -> None:
    ref = source().bodies()[2]  # whose pose is drawn in a quarter of the time of others
    assert EverydayBodies().drawn(ref) == drawn(2) != drawn(39)
    assert source().figure(ref).pose == drawn(2).pose


@pytest.mark.parametrize("index", DRAWN)
def test_joints_stay_within_their_ranges(index: int) -> None:
    pose = drawn(index).pose
    for arm in (pose.left_arm, pose.right_arm):
        for joint, (low, high) in (ARM | {"wrist": LOADED_WRIST}).items():
            assert low <= getattr(arm, joint) <= high, joint
    for leg in (pose.left_leg, pose.right_leg):
        for joint, (low, high) in (LEG | {"twist": CROSSED_TWIST}).items():
            assert low <= getattr(leg, joint) <= high, joint


@pytest.mark.parametrize("index", DRAWN)
def test_a_touching_hand_is_at_the_skin_and_no_limb_goes_deep(index: int) -> None:
    """The distances are measured anew on the built body, with the nearest vertices of the whole body."""
    found, ref = drawn(index), source().bodies()[index]
    assert found.deepest_m <= DEEPEST_M
    vertices = source().build(ref, dressed=False).mesh.vertices[: len(posable(index).modelled)]
    normals = vertex_normals(vertices, posable(index).faces)
    places = Places(posable(index))
    for side, contact in zip("LR", found.contacts, strict=True):
        by, _, at = contact.partition(" on ")
        limb = Limb(posable(index), "arm", side)  # type: ignore[arg-type]
        near = PosedSkin(vertices, normals, places.solid & ~limb.vertices).heights(vertices[limb.far])
        assert near.min() >= -DEEPEST_M - 1e-4
        if at == "the floor":
            assert vertices[limb.far, 1].min() < 0.07
        elif at and at != "the seat" and found.contacts[0] != found.contacts[1]:
            assert near.min() < 0.03, (by, at)


def test_both_soles_of_people_who_stand_are_on_the_floor() -> None:
    vertices = source().build(source().bodies()[39], dressed=False).mesh.vertices
    places = Places(posable(39))
    for side in "LR":
        assert vertices[places.on("sole", side), 1].min() < 0.03


@cache
def posable(index: int) -> Posable:
    return source().model.posable(person(3000 + index))


def test_people_to_be_posed_have_the_skin_of_the_model() -> None:
    pose = drawn(2).pose
    own = posable(2)
    vertices = own.vertices(*own.placed(bone_rotations(pose)))
    built = source().build(source().bodies()[2], dressed=False).mesh.vertices[: len(vertices)]
    offset = (vertices - built).mean(axis=0)
    np.testing.assert_allclose(vertices - offset, built, atol=2e-6)


def test_the_fingerprint_draws_no_pose_and_tells_bodies_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("anny")
    bodies = EverydayBodies()
    monkeypatch.setattr(bodies, "drawn", lambda body: pytest.fail("a pose was drawn"))
    first, second = (bodies.fingerprint(bodies.bodies()[start : start + 2]) for start in (0, 1))
    assert first != second == bodies.fingerprint(bodies.bodies()[1:3])


def test_a_body_of_another_source_is_refused() -> None:
    with pytest.raises(BadConfig, match="the source 'everyday' has no body"):
        EverydayBodies().drawn(BodyRef("wide", "W000", "wide-000", "upright", "train"))


@pytest.mark.parametrize(
    ("index", "contacts", "angle"),
    [
        (2, ("inner forearm on waist", "inner forearm on waist"), 16.796514),
        (39, ("in the air", "in the air"), 1.684104),
        (73, ("palm on the floor", "fingertips on chest"), 26.756245),
    ],
)
def test_drawn_poses_are_pinned(index: int, contacts: tuple[str, str], angle: float) -> None:
    """A failure here means that poses changed: raise POSES_VERSION, and write the new angles."""
    assert drawn(index).contacts == contacts
    assert mean_by_place(angles(drawn(index).pose)) == pytest.approx(angle, abs=1e-6)


def test_what_people_wear_is_drawn_from_their_names_and_goes_into_the_mesh() -> None:
    """Body 39 stands in a coat and shoes, with long hair."""
    ref = source().bodies()[39]
    attire = source().attire(ref)
    assert attire == EverydayBodies().attire(ref) and None not in (attire.drape, attire.hair, attire.shoes)
    built, bare = source().build(ref), source().build(ref, dressed=False)
    assert len(built.pieces) == 4 and not bare.pieces and len(bare.mesh.vertices) < len(built.mesh.vertices)
    assert built.mesh.vertices[:, 1].min() == 0
    assert mean_by_place(built.mesh.vertices) == pytest.approx(0.291973, abs=1e-6), "raise CLOTHES_VERSION"
    again = source().build(ref).mesh
    assert again.vertices.tobytes() == built.mesh.vertices.tobytes() and (again.faces == built.mesh.faces).all()


def test_candidates_are_others_one_of_each_stance_for_testing() -> None:
    bodies = open_source("candidates").bodies()
    assert len(bodies) == CANDIDATES == len({ref.mesh for ref in bodies})
    assert {(ref.subset, ref.split) for ref in bodies} == {("candidates", "train"), ("candidates", "test")}
    assert sorted(ref.pose for ref in bodies if ref.split == "test") == sorted(CANDIDATE_STANCES)
    assert not {int(ref.subject[1:]) for ref in bodies} & {int(ref.subject[1:]) for ref in source().bodies()}
    counts = Counter(ref.pose for ref in bodies)
    assert [*CANDIDATE_STANCES][: len(STANCES)] == [*STANCES] and set(counts) == set(CANDIDATE_STANCES)
    assert set(counts.values()) == {CANDIDATES // len(CANDIDATE_STANCES)}


def test_crossed_arms_hold_each_other_and_raised_hands_are_above_the_shoulders() -> None:
    candidates = CandidateBodies()
    by_name = {ref.mesh: ref for ref in candidates.bodies()}
    crossed, ref = by_name["candidates-1096"], by_name["candidates-1101"]
    contacts = candidates.drawn(crossed).contacts
    places = [contact.partition(" on ")[2] for contact in contacts]
    assert any(place in ("upper arm", "elbow", "forearm", "shoulder") for place in places), contacts
    assert (crossed.pose, ref.pose) == ("arms_crossed", "raised_knee_with_raised_arms")
    assert candidates.drawn(ref).contacts == ("in the air", "in the air")
    vertices = candidates.build(ref, dressed=False).mesh.vertices
    at = Places(posable(2))
    shoulder = min(vertices[at.on("shoulder", side), 1].mean() for side in "LR")
    assert min(vertices[at.on("palm", side), 1].mean() for side in "LR") > shoulder
