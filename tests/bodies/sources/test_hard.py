"""The hard bodies: their list, and some of them built and seen."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest
from shapes import mean_by_place

from bodyseg_data.bodies import Body, BodyRef, open_source
from bodyseg_data.bodies.anny_people import PEOPLE, person
from bodyseg_data.bodies.sources.hard import HardBodies
from bodyseg_data.bodies.sources.open_bodies import OpenBodies
from bodyseg_data.core import BadConfig
from bodyseg_data.labels import LANDMARKS
from bodyseg_data.rendering.embree import EmbreeRenderer
from bodyseg_data.rigs import load_rig
from bodyseg_data.samples import View

BUILT = {
    "sitting_upright": 0.2631188, "sitting_on_floor": 0.0640704, "kneeling": 0.2752065, "sitting_on_heels": 0.1806667,
    "lying_on_back": 0.0318227, "lying_on_front": 0.1214374, "lying_on_side": -0.025936, "touching_toes": 0.1673238,
    "hands_behind_back": 0.3751202, "arms_crossed": 0.3625604, "turned_000": 0.2898175, "turned_090": 0.2923956,
}  # fmt: skip


@pytest.fixture(scope="module")
def source() -> HardBodies:
    return HardBodies()


@pytest.fixture(scope="module")
def built(source: HardBodies) -> dict[str, Body]:
    return {ref.pose: source.build(ref) for ref in source.bodies() if ref.pose in BUILT}


def place(body: Body, landmark: str) -> np.ndarray:
    return body.mesh.vertices[body.landmarks[LANDMARKS.index(landmark)]]


def test_sixty_bodies_all_for_testing(source: HardBodies) -> None:
    found = source.bodies()
    assert len(found) == 60 and source.name == "hard" and source.missing() == ()
    assert {(ref.subset, ref.split) for ref in found} == {("hard", "test")}
    assert len({ref.mesh for ref in found}) == len({ref.pose for ref in found}) == 60
    assert [ref.mesh for ref in found[36:]] == [f"turned-{degrees:03d}" for degrees in range(0, 360, 15)]
    assert len({ref.subject for ref in found[:36]}) == 36 and len({ref.subject for ref in found[36:]}) == 1
    assert found == open_source("hard").bodies()
    for ref in found:
        for text in (ref.subset, ref.subject, ref.mesh, ref.pose):
            assert text and not set(text) & set("./\\ \n")


def test_the_poses_asked_of_it_are_there(source: HardBodies) -> None:
    poses = " ".join(ref.pose for ref in source.bodies())
    standing = ("crossed", "hands_on_hips", "behind_back", "at_face", "touching_toes", "turned_345")
    resting = ("sitting", "hugging_knees", "kneeling", "lying_on_back", "lying_on_side", "lying_on_front")
    for wanted in (*standing, *resting):
        assert wanted in poses


def test_its_people_are_in_no_other_set(source: HardBodies) -> None:
    figures = [source.figure(ref) for ref in source.bodies()]
    others = {person(index) for index in range(PEOPLE)}
    assert len({figure.who for figure in figures}) == 37 and not {figure.who for figure in figures} & others
    poses, ordinary = {figure.pose for figure in figures}, OpenBodies()
    assert len(poses) == 60 and not poses & {ordinary.figure(ref).pose for ref in ordinary.bodies()[:71]}
    assert 10 <= sum(figure.outfit is not None for figure in figures) <= 15
    assert len({figure.outfit for figure in figures}) >= 4
    statures = [figure.who.stature_m for figure in figures]
    assert max(statures) - min(statures) > 0.25


def test_bodies_sit_kneel_lie_and_bend(built: dict[str, Body]) -> None:
    height = {pose: float(body.mesh.vertices[:, 1].max()) for pose, body in built.items()}
    for body in built.values():
        assert body.mesh.vertices[:, 1].min() == 0
    for pose in ("lying_on_back", "lying_on_front", "lying_on_side"):
        low, high = built[pose].mesh.vertices.min(axis=0), built[pose].mesh.vertices.max(axis=0)
        assert height[pose] < 0.65 and max(high[0] - low[0], high[2] - low[2]) > 1.1
    assert place(built["lying_on_back"], "Sellion")[1] > place(built["lying_on_back"], "Nuchale")[1] + 0.1
    assert place(built["lying_on_front"], "10th Rib Midspine")[1] > place(built["lying_on_front"], "Substernale")[1]
    assert 0.35 < place(built["sitting_upright"], "Rt. Trochanterion")[1] < 0.65
    assert place(built["sitting_on_floor"], "Rt. Trochanterion")[1] < 0.25
    assert max(place(built["kneeling"], f"{side} Femoral Lateral Epicn")[1] for side in ("Lt.", "Rt.")) < 0.15
    toes = built["touching_toes"]
    assert place(toes, "Rt. Dactylion")[1] < 0.2 and place(toes, "Sellion")[1] < place(toes, "Rt. Trochanterion")[1]
    behind = built["hands_behind_back"]
    assert place(behind, "Lt. Dactylion")[2] < place(behind, "Lt. Trochanterion")[2]
    crossed = built["arms_crossed"]
    assert place(crossed, "Lt. Dactylion")[0] < place(crossed, "Rt. Radial Styloid")[0] + 0.15


def test_one_person_turns_on_the_spot(built: dict[str, Body]) -> None:
    """A quarter turn to the left takes the front to the left: (x, y, z) to (z, y, -x)."""
    first, second = built["turned_000"].mesh.vertices, built["turned_090"].mesh.vertices
    turned = first[:, [2, 1, 0]] * (1, 1, -1)
    turned -= (turned.min(axis=0) + turned.max(axis=0)) / 2 * (1, 0, 1)
    np.testing.assert_allclose(second, turned, atol=3e-6)


@pytest.mark.parametrize("pose", ["lying_on_side", "sitting_on_floor", "turned_090"])
def test_bodies_are_seen_from_all_sides(built: dict[str, Body], pose: str) -> None:
    mesh, rig = built[pose].mesh, load_rig()
    renderer = EmbreeRenderer(mesh)
    for azimuth in (0, 90, 200):
        camera, _ = rig.placed(mesh.centre, View(255, azimuth))
        seen = renderer.render(camera).face >= 0
        rows = np.flatnonzero(seen.any(axis=1))
        assert seen.sum() > 1500 and abs(rows.mean() - seen.shape[0] / 2) < 60


@pytest.mark.parametrize("pose", BUILT)
def test_bodies_stay_as_they_were(built: dict[str, Body], pose: str) -> None:
    """Others are other bytes of sets, though persons, poses and outfits are the same: raise `PACKING_VERSION`."""
    assert mean_by_place(built[pose].mesh.vertices) == pytest.approx(BUILT[pose], abs=1e-6)


def test_building_again_gives_the_same_bits(source: HardBodies, built: dict[str, Body]) -> None:
    ref = next(ref for ref in source.bodies() if ref.pose == "sitting_on_floor")
    again = HardBodies().build(ref).mesh
    assert hashlib.sha256(again.vertices.tobytes()).digest() == (
        hashlib.sha256(built["sitting_on_floor"].mesh.vertices.tobytes()).digest()
    )


def test_bodies_of_other_sources_are_refused(source: HardBodies) -> None:
    with pytest.raises(BadConfig, match="the source 'hard' has no body 'posture-00' of subset 'A'"):
        source.build(BodyRef("A", "A", "posture-00", "standing", "train"))
    with pytest.raises(BadConfig, match="'hard' makes its bodies"):
        open_source("hard", Path("/"))
